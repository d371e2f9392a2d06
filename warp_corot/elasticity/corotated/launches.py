"""Forces of a whole body on CUDA in one or two launches, and leaves that these leave out; see ``kernels.subtrees``."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext

import warp as wp

from warp_corot.discretization.elements import Elements
from warp_corot.discretization.plan import GROUPED_LEAVES, Awaited, Batch, FlatLeaves, Plan, Sharing
from warp_corot.discretization.planner import places_on
from warp_corot.elasticity.clusters import ChangingClusterScatter, ClusterScatter, grouped_and_others
from warp_corot.inputs.loading import LoadedKernel
from warp_corot.kernels.clusters.laws import isotropic_law
from warp_corot.kernels.corotated.corotated import corotated_stress
from warp_corot.kernels.elements.constitutive import IsotropicMaterial
from warp_corot.kernels.subtrees.cuda import FLAT, WorkRange, scatter_body, scatter_subtrees_own
from warp_corot.kernels.subtrees.degenerate import (
    COUNT_STRIDE,
    LIST_BLOCK,
    LISTS,
    NO_LIST,
    DegenerateList,
    repair_listed_own,
    repair_listed_shared,
)
from warp_corot.kernels.subtrees.memory import BLOCK

#: Thread blocks for each multiprocessor: as many as fit at the same time, so that a launch over an empty list ends
#: soon.
BLOCKS = 6


class DegenerateLeaves:
    """Lists of all leaves with own rotations, and of each batch that shares its roots' rotations.

    Args:
        own: The numbers of subtrees and single leaves of each launch that finds own rotations.
        shared: The batches that share their roots' rotations.
    """

    def __init__(self, own: list[int], shared: list[Batch], device: wp.Device):
        self.own = _empty_lists(own, device)
        self._has_own = sum(own) > 0
        self._shared = [(batch, _empty_lists([batch.count], device)) for batch in shared]
        self._threads = LIST_BLOCK * BLOCKS * max(device.sm_count, 1) if device.is_cuda else LIST_BLOCK
        self._device = device

    @classmethod
    def of(cls, plan: Plan, device: wp.Device) -> DegenerateLeaves:
        """The lists of a plan."""
        own = [batch.count for batch in plan.batches if batch.sharing is Sharing.OWN]
        return cls([*own, len(plan.flat)], [batch for batch in plan.batches if batch.sharing is Sharing.ROOT], device)

    #: The kernel for leaves with own rotations.
    kernel = (repair_listed_own, LIST_BLOCK)

    def list_of(self, batch: Batch) -> DegenerateList:
        """The list that a batch's kernel appends to."""
        if batch.sharing is Sharing.OWN:
            return self.own
        return next((listed for other, listed in self._shared if other is batch), NO_LIST)

    def repair(self, elements: Elements, material: IsotropicMaterial, u: wp.array, f: wp.array) -> None:
        """Add the forces of the leaves on the lists to f, and empty them."""
        inputs = [elements, material, u]
        if self._has_own:
            self._launch(repair_listed_own, [*inputs, self.own], f)
        for batch, listed in self._shared:
            of_batch = [batch.subtrees.first, batch.subtrees.code, places_on(self._device.alias).subtree]
            self._launch(repair_listed_shared, [*of_batch, *inputs, listed], f)

    def _launch(self, kernel: wp.Kernel, inputs: list, f: wp.array) -> None:
        wp.launch(
            kernel,
            dim=self._threads if self._device.is_cuda else 1,
            inputs=[self._threads if self._device.is_cuda else 1, *inputs],
            outputs=[f],
            device=self._device,
            block_dim=LIST_BLOCK,
        )


def _empty_lists(launches: list[int], device: wp.Device) -> DegenerateList:
    """Empty lists with room for all subtrees of these launches, whose thread blocks take the lists in turn."""
    listed = DegenerateList()
    listed.counts = wp.zeros((LISTS + 1) * COUNT_STRIDE, dtype=wp.int32, device=device)
    listed.room = BLOCK * sum(-(-count // (BLOCK * LISTS)) for count in launches)
    listed.entries = wp.zeros(LISTS * listed.room, dtype=wp.vec2i, device=device)
    return listed


# --- a whole body in one or two launches -----------------------------------------------------------------------------


#: Number of leaves of a uniform forest from which subtrees have a launch: clusters are faster for fewer leaves, above
#: all if some are inverted (H200: 73,728 take 6.0 us at rest and 6.3 under their weight; by subtrees 9.6 and 14.4).
UNIFORM_LEAVES = 1 << 18


class OwnLaunches:
    """The launches of a plan whose leaves all have their own rotations.

    If the mesh never changes, the leaves outside subtrees and the subtrees outside groups go in clusters. If few
    subtrees are in groups, all leaves go in clusters: then there is one launch, which leaves out none. If the mesh
    changes and many subtrees are in groups, one launch computes subtrees and single leaves.

    Args:
        plan: The units of work.
        material: Lamé's parameters.
        changing: Adds the forces of all leaves in clusters if the mesh changes.
        awaited: Nodes whose values arrive later; None if all are present.

    Attributes:
        batches: The subtrees that are launched as subtrees.
    """

    def __init__(
        self,
        plan: Plan,
        material: IsotropicMaterial,
        changing: ChangingClusterScatter | None = None,
        awaited: Awaited | None = None,
    ):
        self._device = plan.elements.nodes.device
        self._material = material
        batches, self._flat, self._elements = list(plan.batches), plan.flat, plan.elements
        self._clusters: Callable[[IsotropicMaterial, wp.array, wp.array], None] | None = None
        if plan.counts is None:
            batches, leaves = grouped_and_others(plan, _fewest_grouped(plan))
            if len(leaves):
                self._clusters = ClusterScatter(plan.elements, isotropic_law(corotated_stress), chosen=leaves)
        elif changing is not None and 8 * sum(batch.count for batch in batches if batch.grouped) < GROUPED_LEAVES:
            batches, self._clusters = [], changing
        self._awaited = awaited
        #: Batches of one type have a separate kernel, which is faster.
        self._is_single = self._clusters is not None or not len(plan.flat)
        self._is_single = self._is_single and [batch.grouped for batch in batches] == [True]
        if awaited is not None and self._is_single:
            awaited.is_used = True
            batches = list(awaited.divided(batches[0]))
        # The structs hold only addresses: the arrays must live as long as the structs.
        self.batches = tuple(batches)
        flat = None if self._clusters is not None else plan.flat
        self._rows, self._blocks = ([], 0) if self._is_single else _ranges(batches, flat)
        self._ranges = wp.array(self._rows, dtype=WorkRange, device=self._device) if self._rows else None
        #: Numbers of subtrees and single leaves of each launch that may leave some out, with gaps.
        self.places = [batch.count for batch in batches] if self._is_single else [self._blocks * BLOCK]

    @property
    def in_clusters(self) -> tuple[ClusterScatter, tuple[Batch, ...]] | None:
        """The clusters of a mesh that never changes, and the subtrees outside them, if the plan has them."""
        is_divided = self._awaited is not None and self._awaited.is_used
        return (self._clusters, self.batches) if isinstance(self._clusters, ClusterScatter) and not is_divided else None

    @property
    def kernels(self) -> list[LoadedKernel]:
        """The kernels that launches take."""
        found: list[LoadedKernel] = [(self._kernel(batch), BLOCK) for batch in self.batches if self._is_single]
        if self._ranges is not None:
            found.append((scatter_body(self._material.stride == 0), BLOCK))
        return [*found, *([self._clusters.kernel] if isinstance(self._clusters, ClusterScatter) else [])]

    @staticmethod
    def later_kernel(uniform: bool) -> LoadedKernel:
        """The kernel that launches over a changing mesh take."""
        return scatter_body(uniform), BLOCK

    def scatter_forces(self, u: wp.array, f: wp.array, degenerate: DegenerateList) -> None:
        """Add the forces of displacements u to f, both vec4, and put subtrees with leaves left out on a list."""
        material = self._material
        if self._is_single:
            self._scatter_single(u, f, degenerate)
            return
        if self._ranges is not None:
            wp.launch(
                scatter_body(material.stride == 0),
                dim=self._blocks * BLOCK,
                inputs=[self._ranges, self._elements, self._flat.leaves, material, u],
                outputs=[f, degenerate],
                device=self._device,
                block_dim=BLOCK,
            )
        if self._clusters is not None:
            self._clusters(material, u, f)

    def _scatter_single(self, u: wp.array, f: wp.array, degenerate: DegenerateList) -> None:
        self._launch(self.batches[0], u, f, degenerate)
        with nullcontext() if self._awaited is None else self._awaited.later():
            for late in self.batches[1:]:
                self._launch(late, u, f, degenerate)
            if self._clusters is not None:
                self._clusters(self._material, u, f)

    def _launch(self, batch: Batch, u: wp.array, f: wp.array, degenerate: DegenerateList) -> None:
        inputs, outputs = [batch.subtrees, self._material, u], [f, batch.flagged, degenerate]
        wp.launch(self._kernel(batch), batch.count, inputs, outputs, device=self._device, block_dim=BLOCK)

    def _kernel(self, batch: Batch) -> wp.Kernel:
        return scatter_subtrees_own(batch.shape, True, self._material.stride == 0, True)


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
