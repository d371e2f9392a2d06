"""Forces on CUDA: complete subtrees, elements in clusters, and elements one by one; see ``kernels.subtrees``."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext
from typing import TYPE_CHECKING, Any, NamedTuple

import warp as wp

from warp_corot.discretization.elements import Elements
from warp_corot.discretization.plan import GROUPED_LEAVES, Batch, FlatLeaves, Plan, Sharing
from warp_corot.discretization.planner import places_on
from warp_corot.elasticity.clusters import ChangingClusterScatter, ClusterScatter, divided, grouped_and_others
from warp_corot.elasticity.model import FastForces
from warp_corot.inputs.loading import LoadedKernel
from warp_corot.kernels.clusters.laws import isotropic_law
from warp_corot.kernels.corotated.corotated import corotated_stress
from warp_corot.kernels.elements.constitutive import IsotropicMaterial
from warp_corot.kernels.elements.forces import scatter_chosen, scatter_forces
from warp_corot.kernels.subtrees.cuda import FLAT, WorkRange, scatter_body, scatter_subtrees_own
from warp_corot.kernels.subtrees.degenerate import (
    COUNT_STRIDE,
    LIST_BLOCK,
    LISTS,
    NO_LIST,
    DegenerateList,
    repair_listed_own,
    repair_shared,
)
from warp_corot.kernels.subtrees.memory import BLOCK
from warp_corot.kernels.tables.cluster_layout import PairLayout

if TYPE_CHECKING:
    from warp_corot.elasticity.model import ForceField


class CudaLaw(NamedTuple):
    """A law as the launches of ``CudaForces`` take it.

    Attributes:
        stress: The law of single elements, as ``kernels.elements.forces`` takes it.
        material: Gives the struct that it reads.
        Material: The type of this struct.
        subtrees: Gives the kernel of subtrees of a shape, in groups or not, and of a sharing of rotations.
        cluster: The law of ``kernels.clusters.laws``; None: there are no clusters.
        fast: Gives the struct that a batch of subtrees reads, or clusters for None; None: ``material``.
        FastMaterial: The type of this struct for clusters.
        layout: The layout of clusters; None: the one for isotropic laws.
        repair: The kernel of leaves that subtrees with own rotations leave out; None: they leave out none.
        repaired: Gives the struct that it reads; None: ``material``.
    """

    stress: wp.Function
    material: Callable[[], Any]
    Material: type
    subtrees: Callable[[int, bool, Sharing], wp.Kernel]
    cluster: wp.Function | None = None
    fast: Callable[[Batch | None], Any] | None = None
    FastMaterial: type = IsotropicMaterial
    layout: PairLayout | None = None
    repair: wp.Kernel | None = None
    repaired: Callable[[], Any] | None = None


def no_subtrees(shape: int, grouped: bool, sharing: Sharing) -> wp.Kernel:
    """For laws whose plans have no subtrees."""
    raise NotImplementedError


class CudaForces(FastForces):
    """The forces of a law: of subtrees, batch by batch, and of other elements in clusters, if these never change and
    sums may have any order, or one by one.

    Args:
        field: The field.
        law: The law.
    """

    def __init__(self, field: ForceField, law: CudaLaw):
        self._field, self._law, kind = field, law, field.discretization.element_kind
        self._of_elements, self._of_flat = (
            factory(kind, law.Material, law.stress) for factory in (scatter_forces, scatter_chosen)
        )
        self.follow()

    def follow(self) -> None:
        field, law = self._field, self._law
        self._batches, self._clusters = list(field.plan.batches), None
        if law.cluster is not None:
            given = law.cluster, law.FastMaterial, law.layout
            self._batches, self._clusters = divided(field.discretization, field.plan, *given)
        self._kernels = [law.subtrees(batch.shape, batch.grouped, batch.sharing) for batch in self._batches]
        self.in_clusters = None
        if self._clusters is not None and law.FastMaterial is IsotropicMaterial:
            self.in_clusters = self._clusters, self._batches

    @property
    def kernels(self) -> list[LoadedKernel]:
        found: list[LoadedKernel] = [(kernel, BLOCK) for kernel in self._kernels]
        if self._clusters is not None:
            return [*found, self._clusters.kernel]
        return [*found, self._of_flat] if len(self._field.plan.flat) else found or [self._of_elements]

    @property
    def later_kernels(self) -> list[LoadedKernel]:
        of_subtrees = [(self._law.subtrees(*kind), BLOCK) for kind in self._field.plan.kinds]
        return [self._of_elements, self._of_flat, *of_subtrees, *([self._law.repair] if self._law.repair else [])]

    def scatter_forces(self, u: wp.array, f: wp.array) -> None:
        field, law, flat = self._field, self._law, self._field.plan.flat
        fast, elements = law.fast or (lambda _: law.material()), field.elements
        for batch, kernel in zip(self._batches, self._kernels, strict=True):
            inputs, outputs = [batch.subtrees, fast(batch), u], [f, batch.flagged, NO_LIST]
            wp.launch(kernel, batch.count, inputs, outputs, device=field.device, block_dim=BLOCK)
            if law.repair is not None and batch.count:
                self._repair(batch, law.repair, u, f)
        if self._clusters is not None:
            self._clusters(fast(None), u, f)
        elif len(flat):
            field.launch(self._of_flat, len(flat), [elements, flat.leaves, law.material(), u], [f])
        elif not self._batches:
            field.launch(self._of_elements, field.element_count, [elements, law.material(), u], [f])

    def _repair(self, batch: Batch, repair: wp.Kernel, u: wp.array, f: wp.array) -> None:
        """Add the forces of the leaves that a batch has left out, in order if sums have a fixed one."""
        field, flags, first = self._field, batch.flags_by_eights, batch.subtrees.first
        lanes, material = 1 if field.deterministic else 8, (self._law.repaired or self._law.material)()
        where = [lanes, flags, first]
        if batch.sharing is Sharing.ROOT:
            repair, where = repair_shared, [*where, batch.subtrees.code, places_on(field.device.alias).subtree]
        if batch.sharing is not Sharing.ABOVE:
            field.launch(repair, lanes * len(flags), [*where, field.elements, material, u], [f])


# --- corotated forces of a whole body in one or two launches, if sums may have any order ------------------------------


#: Thread blocks for each multiprocessor: as many as fit at the same time, so that a launch over an empty list ends
#: soon.
BLOCKS = 6


class DegenerateLeaves:
    """The lists of leaves that launches leave out.

    Args:
        counts: The numbers of subtrees and single leaves of each launch.
        device: The device.

    Attributes:
        lists: These lists, whose room is enough for all subtrees; thread blocks take the lists in turn.
    """

    #: The kernel for leaves on lists.
    kernel = (repair_listed_own, LIST_BLOCK)

    def __init__(self, counts: list[int], device: wp.Device):
        self.lists = DegenerateList()
        self.lists.counts = wp.zeros((LISTS + 1) * COUNT_STRIDE, dtype=wp.int32, device=device)
        self.lists.room = BLOCK * sum(-(-count // (BLOCK * LISTS)) for count in counts)
        self.lists.entries = wp.zeros(LISTS * self.lists.room, dtype=wp.vec2i, device=device)
        self._threads = LIST_BLOCK * BLOCKS * max(device.sm_count, 1) if device.is_cuda else 1
        self._device = device

    def repair(self, elements: Elements, material: IsotropicMaterial, u: wp.array, f: wp.array) -> None:
        """Add the forces of the leaves on the lists to f, and empty them."""
        if self.lists.room:
            inputs = [self._threads, elements, material, u, self.lists]
            wp.launch(repair_listed_own, self._threads, inputs, [f], device=self._device, block_dim=LIST_BLOCK)


#: Number of leaves of a uniform forest from which subtrees have a launch: clusters are faster for fewer leaves, above
#: all if some are inverted (H200: 73,728 take 6.0 us at rest and 6.3 under their weight; by subtrees 9.6 and 14.4).
UNIFORM_LEAVES = 1 << 18


class OwnForces(FastForces):
    """Corotated forces of a forest whose leaves all have their own rotations.

    If the mesh never changes, the leaves outside subtrees and the subtrees outside groups go in clusters. If few
    subtrees are in groups, all leaves go in clusters: then there is one launch, which leaves out none. If the mesh
    changes and many subtrees are in groups, one launch computes subtrees and single leaves. Leaves that are left out
    have another launch.

    Args:
        field: The field.
    """

    def __init__(self, field: ForceField):
        self._field, self._device = field, field.device
        self._uniform = field.discretization.material_stride == 0
        self._law = isotropic_law(corotated_stress)
        #: Adds the forces of all leaves, also of those that come later.
        self._changing = ChangingClusterScatter.of(field.discretization, field.plan, self._law)
        self.follow()

    def derive(self) -> None:
        if self._changing is not None:
            self._changing.derive()

    def follow(self) -> None:
        plan, device, awaited = self._field.plan, self._device, self._field.discretization.awaited
        batches, changing = list(plan.batches), self._changing
        self._clusters: ClusterScatter | ChangingClusterScatter | None = None
        if plan.counts is None:
            batches, leaves = grouped_and_others(plan, _fewest_grouped(plan))
            if len(leaves):
                self._clusters = ClusterScatter(plan.elements, self._law, chosen=leaves)
        elif changing is not None and 8 * sum(batch.count for batch in batches if batch.grouped) < GROUPED_LEAVES:
            batches, self._clusters = [], changing
        #: Batches of one type have a separate kernel, which is faster.
        self._is_single = self._clusters is not None or not len(plan.flat)
        self._is_single = self._is_single and [batch.grouped for batch in batches] == [True]
        is_divided = awaited is not None and self._is_single
        if awaited is not None and self._is_single:
            awaited.is_used = True
            batches = list(awaited.divided(batches[0]))
        # The structs hold only addresses: the arrays must live as long as the structs.
        self._batches = tuple(batches)
        flat = None if self._clusters is not None else plan.flat
        self._rows, self._blocks = ([], 0) if self._is_single else _ranges(batches, flat)
        self._ranges = wp.array(self._rows, dtype=WorkRange, device=device) if self._rows else None
        counts = [batch.count for batch in batches] if self._is_single else [self._blocks * BLOCK]
        self._degenerate = DegenerateLeaves(counts, device)
        self.in_clusters = None
        if isinstance(self._clusters, ClusterScatter) and not is_divided:
            self.in_clusters = self._clusters, self._batches

    @property
    def kernels(self) -> list[LoadedKernel]:
        found: list[LoadedKernel] = [(self._kernel(batch), BLOCK) for batch in self._batches if self._is_single]
        found += [] if self._ranges is None else [(scatter_body(self._uniform), BLOCK)]
        found += [self._clusters.kernel] if isinstance(self._clusters, ClusterScatter) else []
        return [*found, DegenerateLeaves.kernel]

    @property
    def later_kernels(self) -> list[LoadedKernel]:
        return [(scatter_body(self._uniform), BLOCK), DegenerateLeaves.kernel]

    def scatter_forces(self, u: wp.array, f: wp.array) -> None:
        field, material, awaited = self._field, self._field.isotropic, self._field.discretization.awaited
        if self._is_single:
            self._launch(self._batches[0], u, f)
            with nullcontext() if awaited is None else awaited.later():
                for late in self._batches[1:]:
                    self._launch(late, u, f)
                if self._clusters is not None:
                    self._clusters(material, u, f)
        elif self._ranges is not None:
            inputs = [self._ranges, field.elements, field.plan.flat.leaves, material, u]
            outputs, threads = [f, self._degenerate.lists], self._blocks * BLOCK
            wp.launch(scatter_body(self._uniform), threads, inputs, outputs, device=self._device, block_dim=BLOCK)
        if self._clusters is not None and not self._is_single:
            self._clusters(material, u, f)
        self._degenerate.repair(field.elements, material, u, f)

    def _launch(self, batch: Batch, u: wp.array, f: wp.array) -> None:
        inputs, outputs = [batch.subtrees, self._field.isotropic, u], [f, batch.flagged, self._degenerate.lists]
        wp.launch(self._kernel(batch), batch.count, inputs, outputs, device=self._device, block_dim=BLOCK)

    def _kernel(self, batch: Batch) -> wp.Kernel:
        return scatter_subtrees_own(batch.shape, True, self._uniform, True)


def _fewest_grouped(plan: Plan) -> int:
    """Number of leaves in groups from which these have a separate launch."""
    return UNIFORM_LEAVES if len(plan.batches) == 1 and len(plan.flat) == 0 else GROUPED_LEAVES


def _ranges(batches: list[Batch], flat: FlatLeaves | None) -> tuple[list[WorkRange], int]:
    """The ranges of work of neighbouring thread blocks, and the number of blocks."""
    rows, begin = [], 0
    for batch in batches:
        one = WorkRange()
        one.begin, one.count = begin, batch.count
        one.shape, one.grouped = batch.shape, int(batch.grouped)
        one.subtrees, one.flagged = batch.subtrees, batch.flagged
        rows.append(one)
        begin += -(-batch.count // BLOCK)
    if flat is not None and len(flat):
        one = WorkRange()
        one.begin, one.count, one.shape = begin, len(flat), FLAT
        rows.append(one)
        begin += -(-len(flat) // BLOCK)
    return rows, begin
