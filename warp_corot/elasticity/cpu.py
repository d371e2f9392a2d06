"""Forces on the CPU: subtrees and elements eight at a time in the lanes of its vector registers, and threads."""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from dataclasses import replace
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import warp as wp

from warp_corot.discretization.elements import Elements
from warp_corot.discretization.plan import Plan, Sharing
from warp_corot.discretization.planner import places_on
from warp_corot.elasticity.divided import Piece
from warp_corot.elasticity.model import ROTATED, FastForces, Kept
from warp_corot.inputs.cpu_threads import Team, launch, part_of
from warp_corot.inputs.loading import LoadedKernel, load
from warp_corot.kernels.elements.constitutive import IsotropicMaterial, RotatedMaterial
from warp_corot.kernels.elements.cpu import (
    GROUPS,
    GroupedMaterial,
    order_elements,
    rest_matrices,
    scatter_elements,
    scatter_grouped_elements,
)
from warp_corot.kernels.elements.dilatation import Dilatation
from warp_corot.kernels.elements.elements import ForestElements, GeneralElements
from warp_corot.kernels.elements.forces import repair_forces
from warp_corot.kernels.elements.simd8 import LANES, IsotropicLaw, NativeLaw, elastic
from warp_corot.kernels.subtrees.cpu import (
    DilatingMaterial,
    ToleranceMaterial,
    scatter_law_subtrees,
    scatter_subtrees,
    scatter_subtrees_shared,
    scatter_subtrees_tolerance,
)
from warp_corot.kernels.subtrees.degenerate import repair_flagged, repair_own, repair_shared, robust_own_stress

if TYPE_CHECKING:
    from warp_corot.discretization.discretization import Discretization


class Lanes:
    """Launches that add the forces of elements: first eight at a time, then those left out one by one.

    Args:
        elements: The mesh's elements, of either kind.
        general: The chosen elements as general ones.
        scatter: Kernel that computes the general ones eight at a time and lists those that it leaves out.
        repair: Kernel that computes the listed ones among ``elements``; None if none are left out or listed.
    """

    def __init__(self, elements: Elements, general: Elements, *, scatter: wp.Kernel, repair: wp.Kernel | None = None):
        self.count, self.nodes = len(general.nodes), general.nodes
        self._elements, self._general = elements, general
        self.kernels: list[LoadedKernel] = [scatter] if repair is None else [scatter, repair]
        #: How many, then which.
        self._degenerate = wp.zeros(self.count + 1 if repair else 0, dtype=wp.int32, device="cpu")

    def scatter_forces(self, material: Any, u: wp.array, f: wp.array) -> None:
        """Add the forces of displacements u to f, both vec4 [N]; ``material`` is the struct of all elements that
        kernels read."""
        scatter, *repairs = cast("list[wp.Kernel]", self.kernels)
        inputs = [self._general, self.count, material, u]
        launch(scatter, -(-self.count // LANES), inputs, [f, self._degenerate], device="cpu")
        for repair in repairs:
            launch(repair, 1, [self._elements, material, u], [self._degenerate, f], device="cpu")

    def part(self, begin: int, end: int) -> Lanes:
        """The launches of some of the elements."""
        part, general = copy(self), part_of(self._general, begin, end)
        if not general.numbers:
            general.numbers = wp.array(np.arange(begin, end), dtype=wp.int32, device="cpu")
        part.count, part.nodes, part._general = end - begin, general.nodes, general
        part._degenerate = wp.zeros_like(self._degenerate)
        return part


def as_general(elements: Elements, kernel: wp.Kernel, inputs: list) -> GeneralElements:
    """Elements of either kind as general ones; ``kernel`` finds their rest matrices and volumes from ``inputs``."""
    count, device, general = len(elements.nodes), elements.nodes.device, GeneralElements()
    general.nodes = general.targets = elements.nodes
    general.rest_inverse = wp.empty(count, dtype=wp.mat33, device=device)
    general.volume = wp.empty(count, dtype=wp.float32, device=device)
    wp.launch(kernel, count, inputs, [general.rest_inverse, general.volume], device=device)
    return general


# --- a shared dilatation, whose forces a law's launches add ----------------------------------------------------------


class Dilating:
    """The shared dilatation of subtrees, and of other elements in groups, which are computed group after group.

    Args:
        of: The shared dilatation.
        lam: Gives lambda [Pa] as elements hold it.
        plan: The plan whose elements are grouped.
        kind: The struct of these elements.
        starts, members, live: The groups in the form of ``kernels.elements.dilatation.share_in_groups``.

    Attributes:
        count: Number of groups in launches.
    """

    def __init__(
        self,
        of: Dilatation,
        lam: Callable[[], wp.array],
        plan: Plan,
        kind: type,
        starts: wp.array,
        members: wp.array,
        live: wp.array,
    ):
        self.of, self.count = of, 0
        self._lam, self._plan, self._order = lam, plan, order_elements(kind)
        self._of_subtrees = Kept(DilatingMaterial, "isotropic", "lam", "tolerance")
        load(["elements.cpu"], wp.get_device("cpu"), [self._order])
        self._starts, self._live, most = starts, live, len(members)
        general = self._general = GeneralElements()
        general.nodes = general.targets = wp.zeros(most, dtype=wp.vec4i, device="cpu")
        general.rest_inverse = wp.zeros(most, dtype=wp.mat33, device="cpu")
        general.volume, general.numbers = wp.zeros(most, dtype=wp.float32, device="cpu"), members
        self._of_groups = Kept(GroupedMaterial, "isotropic", "lam", "starts", "live")
        #: How many, then which.
        self._degenerate = wp.zeros(most + 1, dtype=wp.int32, device="cpu")

    def material(self, isotropic: IsotropicMaterial, tolerance: float | None = None) -> DilatingMaterial:
        """The struct of subtrees.

        Args:
            isotropic: The material, without lambda.
            tolerance: For the corotated law, the largest angle at which the root's rotation is used [rad]; None: never.
        """
        return self._of_subtrees(isotropic, self._lam(), tolerance or 0.0)

    def parts(self, team: Team, worlds: int) -> list[Dilating]:
        """The same, each with some of the groups of all worlds, if the mesh does not change."""
        if not self.count:
            return [self] * team.parts
        return [self._part(*bounds) for bounds in team.bounds(self.count, GROUPS, worlds)]

    def _part(self, begin: int, end: int) -> Dilating:
        part = copy(self)
        part.count, part._starts = end - begin, self._starts[begin : end + 1]
        part._of_groups = copy(self._of_groups)
        part._degenerate = wp.zeros_like(self._degenerate)
        return part

    @property
    def nodes(self) -> wp.array:
        """The nodes of the elements in groups, vec4i."""
        starts = self._starts.numpy()
        return self._general.nodes[int(starts[0]) : int(starts[-1])]

    def derive(self) -> None:
        """Launch the sorting of the groups' elements; may be recorded."""
        inputs = [self._plan.elements, self._starts, self._live]
        wp.launch(self._order, len(self._general.nodes), inputs, [self._general], device="cpu")

    def kernel(self, law: IsotropicLaw) -> wp.Kernel:
        """The kernel that adds the forces of groups under a law."""
        return scatter_grouped_elements(law, self.of)

    def scatter_groups(
        self, law: IsotropicLaw, isotropic: IsotropicMaterial, u: wp.array, f: wp.array, repair: wp.Kernel | None = None
    ) -> None:
        """Add the forces of groups at displacements u to f, both vec4 [N].

        Args:
            law: A law of ``kernels.elements.simd8``.
            isotropic: The material of all elements, without lambda.
            repair: Computes the elements that the law leaves out, if any.
        """
        if not self.count:
            return
        inputs = [self._general, self.count, self._of_groups(isotropic, self._lam(), self._starts, self._live), u]
        launch(self.kernel(law), -(-self.count // GROUPS), inputs, [f, self._degenerate], device="cpu")
        if repair is not None:
            launch(repair, 1, [self._plan.elements, isotropic, u], [self._degenerate, f], device="cpu")


# --- any law: complete subtrees, and other elements ------------------------------------------------------------------


class SimdForces(FastForces):
    """The forces of a law on the CPU: of complete subtrees, and of other elements.

    With a shared dilatation the elements outside subtrees are in groups, and these launches add its forces, too.

    Args:
        discretization: The mesh.
        plan: The units of work.
        law: A law of ``kernels.elements.simd8``.
        material: Gives the struct that it reads.
        Material: The type of this struct.
        repair: The law as ``kernels.elements.forces`` takes it, right for every F, for the elements that it leaves out.
        tolerance: For the corotated law, the largest angle at which the root's rotation is used [rad]; None: never.
    """

    def __init__(
        self,
        discretization: Discretization,
        plan: Plan,
        law: IsotropicLaw | NativeLaw,
        material: Callable[[], Any],
        Material: type = IsotropicMaterial,
        repair: wp.Function | None = None,
        tolerance: float | None = None,
    ):
        self._kind, self._worlds = discretization.element_kind, discretization.worlds
        self.plan: Any = plan
        self._name: Any = law
        self._shares_rotations = law == "corotated"
        self._law = law if isinstance(law, NativeLaw) else elastic(law)
        self._Material, self._material, self._tolerance = Material, material, tolerance
        self._repairs: tuple[wp.Kernel, ...] = ()
        if repair is not None:
            of_subtrees = repair_own if repair is robust_own_stress else repair_flagged(Material, repair)
            self._repairs = of_subtrees, repair_forces(self._kind, Material, repair)
        self._dilating: Dilating | None = None
        self._near = Kept(ToleranceMaterial, "isotropic", "tolerance")
        self._rotated = Kept(RotatedMaterial, *ROTATED)
        #: The rotations of the plan's units, for batches that share those from further up.
        self.rotations, self._no_unit = (wp.empty(0, dtype=kind, device="cpu") for kind in (wp.mat33, wp.int32))
        self.follow()

    def share_dilatation(self, dilating: Dilating) -> bool:
        """Add the forces of a shared dilatation, too, from now on; return whether the law is an isotropic one."""
        if isinstance(self._name, NativeLaw):
            return False
        self._dilating = dilating
        self.derive()
        self.follow()
        return True

    def derive(self) -> None:
        if self._dilating is not None:
            self._dilating.derive()

    def follow(self) -> None:
        plan = self.plan
        self._flat, self._lanes, elements = plan.flat, None, plan.elements
        shares = self._shares_rotations and plan.units is not None
        if self._dilating is not None or shares or (plan.kinds and not len(plan.flat)):
            return
        general = plan.flat.general or elements
        if general is elements and self._kind is ForestElements:
            general = as_general(elements, rest_matrices, [elements])
        repair = self._repairs[1] if self._repairs else None
        self._lanes = Lanes(elements, general, scatter=self._of_elements, repair=repair)

    @property
    def _of_elements(self) -> wp.Kernel:
        return scatter_elements(self._law, self._Material)

    @property
    def kernels(self) -> list[LoadedKernel]:
        """The kernels that launches take, or may take later if the mesh changes."""
        found: list[LoadedKernel] = [self._kernel(shape, sharing) for shape, _, sharing in self.plan.kinds]
        dilating = self._dilating
        if dilating is None and self._lanes is None and self.plan.counts is None:
            return found
        found.append(self._of_elements if dilating is None else dilating.kernel(self._name))
        return [*found, *self._repairs[1:]]

    def _kernel(self, shape: int, sharing: Sharing) -> wp.Kernel:
        if self._shares_rotations and sharing is not Sharing.OWN:
            return scatter_subtrees_shared(shape, sharing is Sharing.ABOVE)
        shared = None if self._dilating is None else self._dilating.of
        if self._tolerance is not None:
            return scatter_subtrees_tolerance(shape, shared)
        if shared is not None:
            return scatter_law_subtrees(shape, self._name, shared)
        return scatter_subtrees(shape, self._Material, self._law)

    def scatter_forces(self, u: wp.array, f: wp.array) -> None:
        if self._flat is not self.plan.flat:
            self.follow()
        material = given = self._material()
        if self._dilating is not None:
            material = self._dilating.material(given, self._tolerance)
        elif self._tolerance is not None:
            material = self._near(given, self._tolerance)
        for batch in self.plan.batches:
            if not batch.count:
                continue
            own = not self._shares_rotations or batch.sharing is Sharing.OWN
            first, threads = batch.subtrees.first, -(-batch.count // LANES)
            unit = self._no_unit if batch.unit is None else batch.unit
            of_batch = material if own else self._rotated(given, self.rotations, unit)
            inputs, kernel = [batch.subtrees, batch.count, of_batch, u], self._kernel(batch.shape, batch.sharing)
            launch(kernel, threads, inputs, [f, batch.flagged], device="cpu")
            if self._repairs and (own or batch.sharing is Sharing.ROOT):
                flags, inputs = batch.flags_by_eights, [self.plan.elements, given, u]
                repair, where = self._repairs[0], [1, flags, first]
                if not own:
                    repair, where = repair_shared, [*where, batch.subtrees.code, places_on("cpu").subtree]
                launch(repair, len(flags), [*where, *inputs], [f], device="cpu")
        if self._dilating is not None:
            self._dilating.scatter_groups(self._name, given, u, f, *self._repairs[1:])
        elif self._lanes is not None:
            self._lanes.scatter_forces(given, u, f)

    def pieces(self, team: Team) -> list[Piece]:
        """See ``ForceField``: copies, each with some of the subtrees and of the other elements."""
        if self.plan.counts is not None or (self._shares_rotations and self.plan.units is not None):
            return []

        def parts_of(whole: Any) -> list[Any]:
            return [whole.part(*bounds) for bounds in team.bounds(whole.count, LANES, self._worlds)]

        batches = [parts_of(batch) for batch in self.plan.batches]
        dilating = self._dilating and self._dilating.parts(team, self._worlds)
        lanes = self._lanes and parts_of(self._lanes)
        pieces: list[Any] = [copy(self) for _ in range(team.parts)]
        for part, piece in enumerate(pieces):
            piece.plan = replace(self.plan, batches=tuple(batch[part] for batch in batches))
            piece._dilating, piece._lanes = dilating and dilating[part], lanes and lanes[part]
        return pieces

    @property
    def nodes(self) -> list[wp.array]:
        """See ``Piece``."""
        nodes = [batch.subtrees.nodes for batch in self.plan.batches]
        if self._dilating is not None:
            return [*nodes, self._dilating.nodes] if self._dilating.count else nodes
        return nodes if self._lanes is None else [*nodes, self._lanes.nodes]
