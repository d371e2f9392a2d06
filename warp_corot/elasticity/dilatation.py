"""Laws whose elements share their dilatation, so that nearly incompressible tissue does not lock; see
``kernels.elements.dilatation``."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.discretization.discretization import Discretization, deviatoric, discretization_of
from warp_corot.discretization.groups import Members
from warp_corot.discretization.plan import Batch, Plan
from warp_corot.elasticity.cpu import Dilating
from warp_corot.elasticity.groups import ClusteredGroups, ElementGroups, elements_of, group_numbers
from warp_corot.elasticity.model import ForceField, Kept, SmallForces
from warp_corot.elasticity.tangents import DefiniteTangent, ElementTangent, Tangent
from warp_corot.errors import InputError
from warp_corot.inputs.arguments import forwards
from warp_corot.inputs.checks import checked_choice, shown
from warp_corot.inputs.choices import AUTO, ELEMENT, SHARED
from warp_corot.inputs.loading import LoadedKernel, load
from warp_corot.kernels.elements import dilatation as kernels
from warp_corot.kernels.elements import mean_dilatation_rows as rows
from warp_corot.kernels.elements.definite import with_dilatation
from warp_corot.kernels.elements.dilatation import SMALL, VOLUME, Dilatation, DilatedMaterial
from warp_corot.kernels.elements.mean_dilatation_rows import NO_LIMIT
from warp_corot.kernels.elements.simd8 import LANES, STRESSLESS
from warp_corot.kernels.subtrees import cpu as subtree_cpu
from warp_corot.kernels.subtrees import cuda as subtree_cuda
from warp_corot.kernels.subtrees.degenerate import NO_LIST
from warp_corot.kernels.subtrees.memory import BLOCK
from warp_corot.materials.anisotropic import Anisotropic
from warp_corot.mesh import TetForest

if TYPE_CHECKING:
    from warp_corot.discretization.discretization import Discretized


class SharedTangent(Tangent):
    """K of a field whose elements share their dilatation in groups.

    Args:
        field: The field.
        exact: As for ``ForceField.tangent``.
        definite: Whether what elements have by themselves is without negative parts, if the law has principal axes.

    Attributes:
        shear: The tangent of the law's field, or of all that elements have by themselves.
        shared: The change of h' and w' of the elements, see ``kernels.elements.dilatation``, vec4 [T].
    """

    field: DilatationField

    def __init__(self, field: DilatationField, exact: bool, definite: bool = False):
        super().__init__(field)
        own, law = kernels.own_differential(field.of), field.shear.stress_law
        # The differential of the gradient of a dilatation acts in each element separately.
        self._turns = (exact or field.of is not VOLUME) and field.of is not SMALL
        self._of_elements: ElementTangent | None = None
        if definite and law is not None and getattr(field.shear, "has_principal_axes", False):
            Both, differential = with_dilatation(law.Material, law.differential, own)
            self._both = Kept(Both, "law", "dilated")
            self.shear: Tangent = DefiniteTangent(field, differential, self._both_materials, Both)
        else:
            self.shear = field.shear.tangent(exact=exact)
            self._of_elements = ElementTangent(field, own, self._material, DilatedMaterial)
        self._holds = field.of.is_held
        self._version = -1
        self.shared = wp.zeros(0, dtype=wp.vec4, device=field.device)

    @property
    def kernels(self) -> list[wp.Kernel]:
        return [*self.shear.kernels, rows.write_rows(self.field.kind, self.field.of)]

    def prepare(self, u: wp.array) -> None:
        super().prepare(u)
        self.shear.prepare(u)
        if self._of_elements is not None:
            self._of_elements.displacements = self.displacements
        field, version = self.field, self.field.discretization.sizes.version
        if self._version != version:
            self._version = version
            self.shared = wp.zeros(field.element_count, dtype=wp.vec4, device=field.device)
            self._members = field.members()
            self._rows = rows.GroupRows()
            self._rows.rows = wp.zeros(self._members.entries, dtype=wp.vec4, device=field.device)
            self._rows.factors = wp.zeros(self._members.count, dtype=wp.vec2, device=field.device)

    def take(self, u: wp.array) -> None:
        super().take(u)
        field = self.field
        inputs = [0, 0, 0, self._members.arrays, field.elements, self.displacements, field.isotropic, NO_LIMIT]
        outputs = [self._rows, self.shared]
        field.launch(rows.write_rows(field.kind, field.of), (1, self._members.count), inputs, outputs)
        self.shear.take(u)

    def add_product(self, p: wp.array, y: wp.array) -> None:
        self.shear.add_product(p, y)
        field = self.field
        lanes = rows.THREADS if field.device.is_cuda else 1
        groups, count = [self._members.arrays, self._rows], self._members.count
        field.launch(rows.add_row_products, lanes * count, [lanes, *groups, p], [y])
        if self._of_elements is None:
            return
        if self._turns:
            self._of_elements.add_product(p, y)
        elif self._holds:
            inputs = [field.elements, self.displacements, p, *groups, self.shared]
            field.launch(rows.add_held(field.kind, field.of), count, inputs, [y])

    def add_diagonal(self, blocks: wp.array) -> None:
        self.shear.add_diagonal(blocks)
        field = self.field
        field.launch(rows.add_row_blocks, self._members.count, [self._members.arrays, self._rows], [blocks])
        if self._of_elements is not None and (self._turns or self._holds):
            self._of_elements.add_diagonal(blocks)

    def _material(self) -> DilatedMaterial:
        material = DilatedMaterial()
        material.isotropic, material.shared = self.field.isotropic, self.shared
        material.turning = float(self._turns)
        return material

    def _both_materials(self) -> Any:
        law = self.field.shear.stress_law
        assert law is not None
        return self._both.made(law.material, self._material())


# --- the force field -------------------------------------------------------------------------------------------------


@forwards("shear", "state", "reset", "energy_count", "divide")
class DilatationField(ForceField):
    """A law's force field without lambda's part, and that part with a dilatation that elements share.

    In a forest the eight leaves of each complete subtree share one, and so do groups of the other leaves. In a
    general mesh groups of neighbours do. The von Mises stress is each element's own.

    Args:
        discretization: The mesh and the material.
        bind: Makes the law's field of a discretization.
        of: What is shared.
        deterministic: As for every field.

    Attributes:
        shear: The law's field without lambda's part.
        of: What is shared.
    """

    shares_dilatation = True
    takes_anisotropic = True  # the law has checked that

    def __init__(
        self,
        discretization: Discretization,
        bind: Callable[[Discretization], ForceField],
        of: Dilatation,
        deterministic: bool = False,
    ):
        self.shear = bind(deviatoric(discretization))
        super().__init__(discretization, deterministic)
        self.of = of
        self._all, self._still = (wp.empty(0, dtype=kind, device=self.device) for kind in (wp.int32, wp.vec4))
        groups = self._groups = ElementGroups(discretization, self.plan)
        #: Elements in groups on the CPU, and whether the law's own launches add the forces of subtrees and groups.
        self._lanes: Dilating | None = None
        self._joined = False
        #: On CUDA, clusters that add their forces, and the subtrees outside them.
        self._clustered: tuple[ClusteredGroups, Sequence[Batch]] | None = None
        if self.device.is_cpu:
            given = groups.starts, groups.members, groups.live
            self._lanes = Dilating(of, lambda: self.discretization.lam, self.plan, self.kind, *given)
        self.join_launches()
        self._make_room()
        #: All elements, and slots for the forces of each by itself; the plan's own slots are those of its units.
        plan = self if self.slots is None else discretization.plan(subtrees=False, deterministic=True)
        self._by_itself = plan.elements, plan.slots

    def plan_of(self, discretization: Discretization) -> Plan:
        """The given plan if it has subtrees, or leaves outside of these, or if the mesh changes, because only one plan
        is kept up to date."""
        plan = self.shear.plan
        has_leaves = bool(plan.kinds) or len(plan.flat) > 0
        if has_leaves or plan.counts is not None or not isinstance(discretization.mesh, TetForest):
            return plan
        return discretization.plan(deterministic=self.deterministic)

    def join_launches(self) -> None:
        """Let the law's own launches add all forces if they can."""
        if self._lanes is not None:
            self._count_groups()
            self._joined = self.plan is self.shear.plan and self.shear.share_dilatation(self._lanes)
            if not self._joined:
                self._lanes.derive()
            return
        found = self.shear.in_clusters
        if found is not None and self.slots is None:
            scatter, kept = found
            there = [batch for batch in self.plan.batches if not any(batch is other for other in kept)]
            batches = self._groups.of_subtrees(there) + self._groups.of_others
            groups, lam = [group for batch in batches for group in elements_of(*batch)], lambda: self.discretization.lam
            self._clustered = ClusteredGroups(scatter, self.element_count, groups, self.of, lam), kept

    def _count_groups(self) -> None:
        if self._lanes is not None:
            self._lanes.count = sum(count for *_, count in self._groups.of_others)

    @property
    def _batches(self) -> Sequence[Batch]:
        """The subtrees whose forces of the dilatation are not added by the law's own launches."""
        if self._joined:
            return ()
        return self.plan.batches if self._clustered is None else self._clustered[1]

    @property
    def kernels(self) -> list[LoadedKernel]:
        own: list[LoadedKernel] = [(self._kernel(batch.shape, batch.grouped), self._block) for batch in self._batches]
        own += [] if self._clustered is None else [self._clustered[0].kernel]
        return [*self.shear.kernels, *own, self._measure, self._share_in_groups, *self._of_others]

    def load_kernels(self) -> None:
        self.shear.load_kernels()
        kinds = [] if self._joined else self.plan.kinds
        own = [(self._kernel(shape, grouped), self._block) for shape, grouped, _sharing in kinds]
        load((), self.device, [*own, *self._of_others])

    @property
    def _of_others(self) -> list[LoadedKernel]:
        """The kernels of forces outside subtrees that the law's own launches do not add."""
        if self._joined or self._clustered is not None:
            return []
        if self._lanes is not None:
            return [self._lanes.kernel(STRESSLESS)]
        return [self._measure, self._share_in_groups, kernels.scatter_pressures(self.kind, self.of)]

    def derive(self) -> None:
        self._groups.derive()
        if self._lanes is not None and not self._joined:
            self._lanes.derive()
        self.shear.derive()

    def follow(self) -> None:
        self._count_groups()
        self._make_room()
        self.shear.follow()

    # --- forces ------------------------------------------------------------------------------------------------------

    def add_forces(self, u: wp.array, f: wp.array) -> None:
        self._add_up(u)
        self.shear.add_forces(u, f)
        if self.slots is None:
            self._scatter(u, f)
        else:
            self.slots.values.zero_()
            self._scatter(u, self.slots.values)
            self.slots.gather(f)

    def scatter_forces(self, u: wp.array, f: wp.array) -> None:
        self._add_up(u)
        self.shear.scatter_forces(u, f)
        self._scatter(u, f)

    def _add_up(self, u: wp.array) -> None:
        if self._clustered is not None:
            self._clustered[0].add_up(self.discretization.material_stride, u)

    def _scatter(self, u: wp.array, f: wp.array) -> None:
        for batch in self._batches:
            kernel = self._kernel(batch.shape, batch.grouped)
            if self._lanes is None:
                inputs, outputs, threads = [batch.subtrees, self.isotropic, u], [f, batch.flagged, NO_LIST], batch.count
            else:
                material = self._lanes.material(self.shear.isotropic)
                inputs, outputs = [batch.subtrees, batch.count, material, u], [f, batch.flagged]
                threads = -(-batch.count // LANES)
            wp.launch(kernel, threads, inputs, outputs, device=self.device, block_dim=self._block)
        if self._lanes is None and self._clustered is None:
            self._scatter_others(u, f)
        elif self._lanes is not None and not self._joined:
            self._lanes.scatter_groups(STRESSLESS, self.shear.isotropic, u, f)

    def _scatter_others(self, u: wp.array, f: wp.array) -> None:
        """Add the forces of elements outside subtrees, in three passes (CUDA)."""
        plan, flat, isotropic = self.plan, self.plan.flat, self.isotropic
        where, count = [self.elements, self._all, self._all], self.element_count
        if plan.kinds or len(flat):
            where, count = [self.elements, flat.leaves, self._all if flat.live is None else flat.live], len(flat)
        self.launch(self._measure, count, [*where, u, self._still], [self._shared])
        for starts, members, live, groups in self._groups.of_others:
            inputs = [starts, members, live, self.elements, isotropic]
            self.launch(self._share_in_groups, groups, inputs, [self._shared])
        pressures = kernels.scatter_pressures(self.kind, self.of)
        self.launch(pressures, count, [*where, isotropic, u, self._shared], [f])

    def _kernel(self, shape: int, grouped: bool) -> wp.Kernel:
        if self.device.is_cuda:
            return subtree_cuda.scatter_dilatation(shape, grouped, self.discretization.material_stride == 0, self.of)
        return subtree_cpu.scatter_law_subtrees(shape, STRESSLESS, self.of)

    @property
    def _block(self) -> int:
        return BLOCK if self.device.is_cuda else 256

    def tangent(self, *, exact: bool = False) -> Tangent:
        """See ``ForceField.tangent``. The K of the corotated law is the paper's unless it is ``exact``: then it has the
        derivatives of the rotations and of the gradient of J, too, and may be indefinite.
        """
        return SharedTangent(self, exact)

    def definite_tangent(self) -> Tangent:
        return SharedTangent(self, exact=False, definite=True)

    @property
    def stiffest(self) -> SmallForces:
        return Unshared(self)

    def unshare(self, u: wp.array, f: wp.array) -> None:
        """Change the forces f of displacements u to those of separate dilatations."""
        elements, slots = self._by_itself
        if slots is not None:
            slots.values.zero_()
        inputs, outputs = [elements, self._material_at(u), u], [f if slots is None else slots.values]
        self.launch(self._unshared, self.element_count, inputs, outputs)
        if slots is not None:
            slots.gather(f)

    # --- energies and stresses ---------------------------------------------------------------------------------------

    def write_energies(self, u: wp.array, energies: wp.array) -> None:
        self.shear.write_energies(u, energies)
        self._add_shared_energies(u, energies)

    def write_potentials(self, u: wp.array, energies: wp.array) -> None:
        self.shear.write_potentials(u, energies)
        self._add_shared_energies(u, energies)

    def _add_shared_energies(self, u: wp.array, energies: wp.array) -> None:
        self._launch_over_elements(self._energies, self._material_at(u), u, energies)

    def write_von_mises(self, u: wp.array, stress: wp.array) -> None:
        self.shear.write_von_mises(u, stress)

    # --- what is shared ----------------------------------------------------------------------------------------------

    @property
    def kind(self) -> type:
        return self.discretization.element_kind

    def _make_room(self) -> None:
        """Allocate the arrays of all elements that one pass leaves for the next."""
        self._shared = wp.zeros(self.element_count, dtype=wp.vec4, device=self.device)

    def groups(self) -> list[npt.NDArray[np.int32]]:
        """The elements of each group that shares a dilatation, of all worlds."""
        return [group for batch in self._groups.all for group in elements_of(*batch)]

    def group_numbers(self) -> npt.NDArray[np.int32]:
        """The number of each element's group, int32 [T] of all worlds."""
        return group_numbers(self.groups(), self.element_count)

    @property
    def find_members(self) -> Callable[[int], Members]:
        return self.members

    def members(self, below: int | None = None) -> Members:
        """The nodes of groups, of all elements or those below a number; waits for the device."""
        return Members.of(self.of, self._groups.all, self.elements.nodes, below)

    def share_weights(self, u: wp.array, p: wp.array) -> wp.array:
        """Data of the shared dilatation for derivatives with respect to elements' weights, vec4 [T]; see
        ``kernels.elements.dilatation.weight_law_at``.
        """
        return self._share(u, p, kernels.share_in_groups(self.kind, kernels.weight_law_at(self.of)))

    def _share(self, u: wp.array, p: wp.array, share_in_groups: wp.Kernel) -> wp.array:
        """Launch the first two passes of ``kernels.elements.dilatation`` for all elements."""
        self._regions.launch_over(
            self._measure,
            self.element_count,
            lambda _, own: ([own(self.elements), self._all, self._all, u, p], [own(self._shared)]),
            u.ptr,
            p.ptr,
        )
        for starts, members, live, count in self._groups.all:
            inputs = [starts, members, live, self.elements, self.isotropic]
            self.launch(share_in_groups, count, inputs, [self._shared])
        return self._shared

    def _material_at(self, u: wp.array) -> DilatedMaterial:
        """The material at displacements u, whose dilatation is found by launches."""
        material = DilatedMaterial()
        material.isotropic, material.shared = self.isotropic, self._share(u, self._still, self._share_in_groups)
        return material

    @property
    def _measure(self) -> wp.Kernel:
        return kernels.measure_elements(self.kind, self.of)

    @property
    def _share_in_groups(self) -> wp.Kernel:
        return kernels.share_in_groups(self.kind, kernels.law_at(self.of))

    @property
    def _unshared(self) -> wp.Kernel:
        return kernels.unshare(self.kind, self.of)

    @property
    def _energies(self) -> wp.Kernel:
        return kernels.add_energies(self.kind, self.of)


def law_of(field: ForceField) -> tuple[ForceField, DilatationField | None]:
    """The field of the law itself, and the field around it if elements share their dilatation; then the law's field has
    no lambda.
    """
    return (field.shear, field) if isinstance(field, DilatationField) else (field, None)


class Unshared:
    """The law with a separate dilatation in every element: at rest it is at least as stiff, and the field approaches it
    in crushed states.

    Args:
        field: The field with the shared dilatation.
    """

    def __init__(self, field: DilatationField):
        self._field, self.state_kept = field, field.state_kept

    def add_forces(self, u: wp.array, f: wp.array) -> None:
        """Add the forces [N] of displacements u to f; both vec4 [worlds * N]."""
        self._field.add_forces(u, f)
        self._field.unshare(u, f)


# --- the option ``dilatation`` of models -----------------------------------------------------------------------------


#: Poisson's ratio in any element from which "auto" means "shared".
SHARED_FROM = 0.45


def check_dilatation(dilatation: str) -> None:
    """Check the option of a model.

    Raises:
        InputError: It is none of the values.
    """
    checked_choice(dilatation, "dilatation", (AUTO, ELEMENT, SHARED))


def refuse_shared(dilatation: str, model: str) -> None:
    """Check the option of a model of springs, which has no dilatation to share.

    Raises:
        InputError: It is not "element".
    """
    if not isinstance(dilatation, str) or dilatation != ELEMENT:
        raise InputError(f"dilatation is {shown(dilatation)}; for {model}, which has springs, it must be {ELEMENT!r}")


def shares_dilatation(dilatation: str, discretization: Discretization) -> bool:
    """Whether the elements of a discretization share their dilatation under an option of the model.

    Raises:
        InputError: They should, and the material is anisotropic.
    """
    inseparable = isinstance(discretization.material, Anisotropic)
    if dilatation == SHARED and inseparable:
        name = type(discretization.material).__name__
        raise InputError(f"dilatation is {SHARED!r} and the material is {name}; it must be {AUTO!r} or {ELEMENT!r}")
    if dilatation != AUTO or inseparable:
        return dilatation == SHARED
    # The limit as a float32 number counts, too.
    return float(np.max(discretization.material.poisson)) > SHARED_FROM - 1e-6


def bind_law(
    bind: Callable[[Discretization, bool], ForceField],
    of: Dilatation,
    dilatation: str,
    body: Discretized | Discretization,
    deterministic: bool,
) -> ForceField:
    """The field of a law on a body, with a dilatation of each element or a shared one.

    Args:
        bind: Makes the law's field of a discretization; the other argument is ``deterministic``.
        of: The shared dilatation.
        dilatation: The option of the model.
        body, deterministic: As for every field.

    Raises:
        InputError: The dilatation should be shared, and the material is anisotropic.
    """
    discretization = discretization_of(body)
    if shares_dilatation(dilatation, discretization):
        return DilatationField(discretization, lambda part: bind(part, deterministic), of, deterministic)
    return bind(discretization, deterministic)
