"""Laws whose elements share their dilatation, so that nearly incompressible tissue does not lock."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import warp as wp

from warp_corot.discretization.discretization import Discretization, discretization_of
from warp_corot.discretization.elements import ElementKind, Elements
from warp_corot.discretization.plan import Plan
from warp_corot.discretization.shear_only import ShearOnly
from warp_corot.discretization.subtrees import Batch
from warp_corot.errors import InputError
from warp_corot.inputs.checks import shown
from warp_corot.kernels.elements import dilatation as nodal
from warp_corot.kernels.elements.constitutive import IsotropicMaterial
from warp_corot.kernels.elements.dilatation import Dilatation
from warp_corot.kernels.elements.lanes import LANES
from warp_corot.kernels.subtrees import dilatation as subtrees
from warp_corot.kernels.subtrees.cuda import BLOCK
from warp_corot.mesh import TetForest

from .model import ForceField
from .tangent import Tangent

if TYPE_CHECKING:
    from warp_corot.discretization.discretization import Discretized

ELEMENT, SHARED = "element", "shared"


def check_dilatation(dilatation: str) -> None:
    """Check the option of a model.

    Raises:
        InputError: It is none of the values.
    """
    if dilatation not in (ELEMENT, SHARED):
        raise InputError(f"dilatation is {shown(dilatation)}; it must be {ELEMENT!r} or {SHARED!r}")


def refuse_shared(dilatation: str, model: str) -> None:
    """Check the option of a model of springs, which has no dilatation to share.

    Raises:
        InputError: It is not "element".
    """
    if dilatation != ELEMENT:
        raise InputError(f"dilatation is {shown(dilatation)}; for {model}, which has springs, it must be {ELEMENT!r}")


def shares_dilatation(dilatation: str, discretization: Discretization) -> bool:
    """Whether the elements of a discretization share their dilatation under an option of the model.

    Raises:
        InputError: They should, and the material is anisotropic.
    """
    if dilatation == SHARED and discretization.is_anisotropic:
        name = type(discretization.material).__name__
        raise InputError(f"dilatation is {SHARED!r} and the material is {name}; it must be {ELEMENT!r}")
    return dilatation == SHARED


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
        of: What is shared.
        dilatation: The option of the model.
        body, deterministic: As for every field.

    Raises:
        InputError: The dilatation should be shared, and the material is anisotropic.
    """
    discretization = discretization_of(body)
    if shares_dilatation(dilatation, discretization):
        return DilatationField(discretization, lambda part: bind(part, deterministic), of, deterministic)
    return bind(discretization, deterministic)


class DilatationField(ForceField):
    """A law's force field without lambda's part, and that part with a dilatation that elements share.

    In a forest the eight leaves of each complete subtree share one, and other leaves have one at each node; so have all
    elements of a general mesh. See ``kernels.elements.dilatation``. The von Mises stress is each element's own.

    Args:
        discretization: The mesh and the material.
        bind: Makes the law's field of a discretization.
        of: What is shared.
        deterministic: As for every field.

    Attributes:
        shear: The law's field without lambda's part.
    """

    def __init__(
        self,
        discretization: Discretization,
        bind: Callable[[Discretization], ForceField],
        of: Dilatation,
        deterministic: bool = False,
    ):
        self.shear = bind(ShearOnly(discretization))
        super().__init__(discretization, deterministic)
        self._of, self._none = of, wp.empty(0, dtype=wp.vec4, device=self.device)
        self._sums = wp.empty(0, dtype=wp.vec4, device=self.device)
        self._slot_sums = None if self.slots is None else wp.zeros_like(self.slots.values)

    def plan_of(self, discretization: Discretization) -> Plan:
        """The same plan where that has subtrees, and where the mesh changes: one plan is kept up to date there."""
        plan = self.shear.plan
        if plan.kinds or plan.counts is not None or not isinstance(discretization.mesh, TetForest):
            return plan
        return discretization.plan(deterministic=self.deterministic)

    def load_kernels(self) -> None:
        self.shear.load_kernels()
        for shape, grouped, _sharing in self.plan.kinds:
            wp.load_module(self._kernel(shape, grouped).module, self.device, block_dim=self._block)
        for kernel in (nodal.sum_at_nodes(self._kind, self._of), nodal.scatter_from_nodes(self._kind, self._of)):
            wp.load_module(kernel.module, self.device)

    def derive(self) -> None:
        self.shear.derive()

    def follow(self) -> None:
        self.shear.follow()

    @property
    def state(self) -> dict[str, wp.array]:
        return self.shear.state

    def reset(self, chosen: wp.array) -> None:
        self.shear.reset(chosen)

    # --- forces ------------------------------------------------------------------------------------------------------

    def add_forces(self, u: wp.array, f: wp.array) -> None:
        self.shear.add_forces(u, f)
        if self.slots is None:
            self._scatter(u, f)
        else:
            self.slots.values.zero_()
            self._scatter(u, self.slots.values)
            self.slots.gather(f)

    def scatter_forces(self, u: wp.array, f: wp.array) -> None:
        self.shear.scatter_forces(u, f)
        self._scatter(u, f)

    def _scatter(self, u: wp.array, f: wp.array) -> None:
        discretization = self.discretization
        for batch in self.plan.batches:
            kernel, subtree = self._kernel(batch.shape, batch.grouped), batch.subtrees
            if self.device.is_cuda:
                inputs = [subtree, discretization.lam, u]
                wp.launch(kernel, batch.count, inputs, [f], device=self.device, block_dim=BLOCK)
            else:
                inputs = [subtree, batch.count, self.isotropic, u]
                self.launch(kernel, -(-batch.count // LANES), inputs, [f, batch.flagged])
        count, elements, material = self._others()
        if count:
            sums, kernel = self._sum_at_nodes(u, self._none), nodal.scatter_from_nodes(self._kind, self._of)
            self.launch(kernel, count, [elements, material, u, sums], [f])

    def _kernel(self, shape: int, grouped: bool) -> wp.Kernel:
        if self.device.is_cuda:
            return subtrees.scatter_dilatation(shape, grouped, self.discretization.material_stride == 0, self._of)
        return subtrees.scatter_in_lanes(shape, self._of)

    @property
    def _block(self) -> int:
        return BLOCK if self.device.is_cuda else 256

    # --- stiffness ---------------------------------------------------------------------------------------------------

    def add_stiffness(self, u: wp.array, p: wp.array, y: wp.array, *, exact: bool | None = None) -> None:
        """Add K(u) p to y [N].

        Args:
            u, p, y: As for every field.
            exact: None: the law's own K. Of corotated that is the paper's: without the turning of the rotations, and
                without the turning of the gradient of J, which is positive semidefinite; True: the derivative.
        """
        self._law("add_stiffness", exact)(u, p, y)
        self.add_shared_product(u, p, y, exact)

    def add_shared_product(self, u: wp.array, p: wp.array, y: wp.array, exact: bool | None = None) -> None:
        """The part of ``add_stiffness`` that comes from the shared dilatation."""
        turning = self._turning(exact)
        for batch in self.plan.batches:
            kernel = subtrees.add_product_of_subtrees(self._of)
            self.launch(kernel, batch.count, [*self._leaves(batch), u, p, turning], [y])
        count, elements, material = self._others()
        if count:
            sums, kernel = self._sum_at_nodes(u, p), nodal.add_product_from_nodes(self._kind, self._of)
            self.launch(kernel, count, [elements, material, u, p, sums, turning], [y])

    def add_diagonal(self, u: wp.array, blocks: wp.array, *, exact: bool | None = None) -> None:
        """Add the 3x3 blocks on the diagonal of the same K(u) to those of the nodes [N/m]; see ``add_stiffness``.

        Where dilatations are at nodes the blocks are larger than those of K.
        """
        self._law("add_diagonal", exact)(u, blocks)
        self.add_shared_diagonal(u, blocks, exact)

    def add_shared_diagonal(self, u: wp.array, blocks: wp.array, exact: bool | None = None) -> None:
        """The part of ``add_diagonal`` that comes from the shared dilatation."""
        turning = self._turning(exact)
        for batch in self.plan.batches:
            kernel = subtrees.add_diagonal_of_subtrees(self._of)
            self.launch(kernel, batch.count, [*self._leaves(batch), u, turning], [blocks])
        count, elements, material = self._others()
        if count:
            sums, kernel = self._sum_at_nodes(u, self._none), nodal.add_diagonal_from_nodes(self._kind, self._of)
            self.launch(kernel, count, [elements, material, u, sums, turning], [blocks])

    def tangent(self, *, exact: bool = False) -> Tangent:
        return SharedTangent(self, exact)

    def _law(self, name: str, exact: bool | None) -> Callable[..., None]:
        method = getattr(self.shear, name)
        if exact is None or not self._has_rotations:
            return method
        return lambda *arrays: method(*arrays, exact=exact)

    def _turning(self, exact: bool | None) -> float:
        return 0.0 if self._has_rotations and not exact else 1.0

    @property
    def _has_rotations(self) -> bool:
        """Whether the law's K is not the exact derivative unless that is asked for."""
        return self._of is nodal.VOLUME

    # --- energies and stresses ---------------------------------------------------------------------------------------

    def write_energies(self, u: wp.array, energies: wp.array) -> None:
        self.shear.write_energies(u, energies)
        for batch in self.plan.batches:
            kernel = subtrees.add_energies_of_subtrees(self._of)
            self.launch(kernel, batch.count, [*self._leaves(batch), u], [energies])
        count, elements, material = self._others()
        if count:
            sums, kernel = self._sum_at_nodes(u, self._none), nodal.add_energies_from_nodes(self._kind, self._of)
            self.launch(kernel, count, [elements, self.plan.flat.leaves, material, sums], [energies])

    @property
    def energy_count(self) -> int:
        return self.shear.energy_count

    def write_von_mises(self, u: wp.array, stress: wp.array) -> None:
        self.shear.write_von_mises(u, stress)

    # --- pieces ------------------------------------------------------------------------------------------------------

    @property
    def _kind(self) -> ElementKind:
        return self.discretization.element_kind

    def _leaves(self, batch: Batch) -> list:
        """First leaves of a batch's subtrees, all leaves, and their material."""
        return [batch.subtrees.first, self.elements, self.isotropic]

    def _others(self) -> tuple[int, Elements, IsotropicMaterial]:
        """The elements that have their dilatation at nodes: how many, which, and their material."""
        flat = self.plan.flat
        if self.plan.kinds or len(flat):
            return len(flat), flat.elements, self.isotropic_of(flat)
        return self.element_count, self.elements, self.isotropic

    def prepare_sums(self, u: wp.array) -> None:
        """Make room for sums at the nodes of displacements u; not while launches are recorded."""
        if len(self._sums) < len(u):
            self._sums = wp.empty_like(u)

    def _sum_at_nodes(self, u: wp.array, p: wp.array) -> wp.array:
        """Sums of ``kernels.elements.dilatation.sum_at_nodes`` for all nodes."""
        self.prepare_sums(u)
        sums = self._sums[: len(u)]
        sums.zero_()
        kernel = nodal.sum_at_nodes(self._kind, self._of)
        to = sums
        if self._slot_sums is not None:
            to = self._slot_sums
            to.zero_()
        count, elements, material = self._others()
        self.launch(kernel, count, [elements, material, u, p], [to])
        if self._slot_sums is not None:
            assert self.slots is not None
            self.slots.gather(sums, self._slot_sums)
        return sums


class SharedTangent(Tangent):
    """K of a field with a shared dilatation.

    Args:
        field: The field.
        exact: As for ``ForceField.tangent``.
    """

    field: DilatationField

    def __init__(self, field: DilatationField, exact: bool):
        super().__init__(field)
        self.shear, self._exact = field.shear.tangent(exact=exact), exact

    def prepare(self, u: wp.array) -> None:
        super().prepare(u)
        self.shear.prepare(u)
        self.field.prepare_sums(u)

    def take(self, u: wp.array) -> None:
        super().take(u)
        self.shear.take(u)

    def add_product(self, p: wp.array, y: wp.array) -> None:
        self.shear.add_product(p, y)
        self.field.add_shared_product(self.displacements, p, y, self._exact)

    def add_diagonal(self, blocks: wp.array) -> None:
        self.shear.add_diagonal(blocks)
        self.field.add_shared_diagonal(self.displacements, blocks, self._exact)
