"""The force field of a law whose elements share their dilatation; see ``kernels.elements.dilatation``."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.discretization.discretization import Discretization
from warp_corot.discretization.elements import with_targets
from warp_corot.discretization.members import Members
from warp_corot.discretization.plan import Plan
from warp_corot.discretization.shear_only import ShearOnly
from warp_corot.discretization.slots import Slots
from warp_corot.discretization.subtrees import Batch
from warp_corot.elasticity.model import ForceField, SmallForces
from warp_corot.elasticity.paths.dilating import Dilating
from warp_corot.elasticity.tangent import Tangent
from warp_corot.inputs.loading import LoadedKernel, load
from warp_corot.kernels.elements import shared_diagonal
from warp_corot.kernels.elements import shared_dilatation as kernels
from warp_corot.kernels.elements.dilatation import VOLUME, Dilatation
from warp_corot.kernels.elements.lanes import LANES
from warp_corot.kernels.subtrees import dilatation as subtrees
from warp_corot.kernels.subtrees.cpu import scatter_dilatation_lanes
from warp_corot.kernels.subtrees.memory import BLOCK
from warp_corot.mesh import TetForest

from .clustered import ClusteredGroups
from .others import Others
from .tangent import SharedTangent


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
        self.shear = bind(ShearOnly(discretization))
        super().__init__(discretization, deterministic)
        self.of = of
        self._all, self._still = (wp.empty(0, dtype=kind, device=self.device) for kind in (wp.int32, wp.vec4))
        self._others = Others(discretization, self.plan, of)
        #: Whether the law's own launches add the forces of subtrees and groups, and whether clusters add theirs.
        self._joined = False
        self._clustered: ClusteredGroups | None = None
        self.join_launches()
        self._make_room()
        #: All elements, and slots for the forces of each by itself; the plan's own slots are those of its units.
        self._by_itself = (self.elements, None) if self.slots is None else _with_slots(discretization)

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
        if self.plan is self.shear.plan:
            dilating = Dilating(self.of, lambda: self.discretization.lam, self._others.grouped)
            self._joined = self.shear.share_dilatation(dilating)
        self._others.are_joined = self._joined and self._others.grouped is not None
        self._others.follow()
        self._clustered = self._join_clusters()

    def _join_clusters(self) -> ClusteredGroups | None:
        """Let the launch of elements in clusters add the forces of their shared dilatation, if there is one (CUDA)."""
        found = self.shear.in_clusters
        if found is None or self.slots is not None:
            return None
        scatter, kept = found
        there = [batch for batch in self.plan.batches if not any(batch is other for other in kept)]
        self._kept, self._others.are_joined = kept, True
        batches = self._of_subtrees(there) + self._others.groups
        return ClusteredGroups(scatter, len(self.elements.nodes), batches, self.of, lambda: self.discretization.lam)

    @property
    def _batches(self) -> Sequence[Batch]:
        """The subtrees whose forces of the dilatation are not added by the law's own launches."""
        if self._joined:
            return ()
        return self.plan.batches if self._clustered is None else self._kept

    @property
    def kernels(self) -> list[LoadedKernel]:
        own: list[LoadedKernel] = [(self._kernel(batch.shape, batch.grouped), self._block) for batch in self._batches]
        own += [] if self._clustered is None else [self._clustered.kernel]
        in_groups = kernels.share_in_groups(self.kind, kernels.law_at(self.of))
        own += [kernels.measure_elements(self.kind, self.of), in_groups, *self._others.kernels]
        return [*self.shear.kernels, *own]

    def load_kernels(self) -> None:
        self.shear.load_kernels()
        kinds = [] if self._joined else self.plan.kinds
        own = [(self._kernel(shape, grouped), self._block) for shape, grouped, _sharing in kinds]
        load((), self.device, [*own, *self._others.kernels])

    def derive(self) -> None:
        self._others.derive()
        self.shear.derive()

    def take_material(self) -> None:
        self.shear.take_material()

    def follow(self) -> None:
        self._others.follow()
        self._make_room()
        self.shear.follow()

    @property
    def state(self) -> dict[str, wp.array]:
        return self.shear.state

    def reset(self, chosen: wp.array) -> None:
        self.shear.reset(chosen)

    def divide(self) -> None:
        self.shear.divide()

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
            self._clustered.add_up(self.discretization.material_stride, u)

    def _scatter(self, u: wp.array, f: wp.array) -> None:
        for batch in self._batches:
            kernel, subtree = self._kernel(batch.shape, batch.grouped), batch.subtrees
            if self.device.is_cuda:
                inputs = [subtree, self.discretization.lam, u]
                wp.launch(kernel, batch.count, inputs, [f], device=self.device, block_dim=BLOCK)
            else:
                inputs = [subtree, batch.count, self.isotropic, u]
                self.launch(kernel, -(-batch.count // LANES), inputs, [f, batch.flagged])
        if self._others.count and not self._others.are_joined:
            self._others.scatter(self.isotropic, u, self._shared, f)

    def _kernel(self, shape: int, grouped: bool) -> wp.Kernel:
        if self.device.is_cuda:
            return subtrees.scatter_dilatation(shape, grouped, self.discretization.material_stride == 0, self.of)
        return scatter_dilatation_lanes(shape, self.of)

    @property
    def _block(self) -> int:
        return BLOCK if self.device.is_cuda else 256

    # --- stiffness ---------------------------------------------------------------------------------------------------

    def add_stiffness(self, u: wp.array, p: wp.array, y: wp.array, *, exact: bool | None = None) -> None:
        """Add K(u) p to y [N].

        Args:
            u, p, y: As for every field.
            exact: None: the law's own K. For the corotated law this is the paper's, without the derivatives of the
                rotations and of the gradient of J, which is positive semidefinite; True: the exact derivative.
        """
        self._law("add_stiffness", exact)(u, p, y)
        inputs = [self.elements, self.isotropic, u, p, self._share(u, p), self.turning(exact)]
        self.launch(kernels.add_product(self.kind, self.of), self.element_count, inputs, [y])

    def add_diagonal(self, u: wp.array, blocks: wp.array, *, exact: bool | None = None) -> None:
        """Add the 3x3 blocks on the diagonal of the same K(u) to those of the nodes [N/m]; see ``add_stiffness``."""
        self._law("add_diagonal", exact)(u, blocks)
        turning, shared = self.turning(exact), self._share(u, self._still)
        kernel = shared_diagonal.add_diagonal_of_groups(self.kind, self.of)
        for starts, members, live, count in self.batches_of_groups():
            inputs = [starts, members, live, self.elements, self.isotropic, u, shared, turning]
            self.launch(kernel, count, inputs, [blocks])

    def tangent(self, *, exact: bool = False) -> Tangent:
        return SharedTangent(self, exact)

    def _law(self, name: str, exact: bool | None) -> Callable[..., None]:
        method = getattr(self.shear, name)
        if exact is None or not self._has_rotations:
            return method
        return lambda *arrays: method(*arrays, exact=exact)

    def turning(self, exact: bool | None) -> float:
        return 0.0 if self._has_rotations and not exact else 1.0

    @property
    def _has_rotations(self) -> bool:
        """Whether the law's K is the exact derivative only on request."""
        return self.of is VOLUME

    @property
    def stiffest(self) -> SmallForces:
        return Unshared(self)

    def unshare(self, u: wp.array, f: wp.array) -> None:
        """Change the forces f of displacements u to those of separate dilatations."""
        shared = self._share(u, self._still)
        self.launch(kernels.unshare(self.kind, self.of), self.element_count, [self.elements, u], [shared])
        elements, slots = self._by_itself
        if slots is not None:
            slots.values.zero_()
        inputs = [elements, self._all, self._all, self.isotropic, u, shared]
        outputs = [f if slots is None else slots.values]
        self.launch(kernels.scatter_pressures(self.kind, self.of), self.element_count, inputs, outputs)
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
        kernel, shared = kernels.add_energies(self.kind, self.of), self._share(u, self._still)
        self._launch_over_elements(kernel, self.isotropic, u, energies, shared)

    @property
    def energy_count(self) -> int:
        return self.shear.energy_count

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
        found = []
        for starts, members, live, count in self.batches_of_groups():
            begins, of_groups = starts.numpy(), members.numpy()
            # Launches over a mesh that changes go beyond its groups.
            for g in range(min(count, int(live.numpy()[0])) if len(live) else count):
                if len(of_groups):
                    found.append(of_groups[begins[g] : begins[g + 1]])
                else:
                    found.append(np.arange(begins[g], begins[g] + 8, dtype=np.int32))
        return found

    def group_numbers(self) -> npt.NDArray[np.int32]:
        """The number of each element's group, int32 [T] of all worlds."""
        groups = self.groups()
        numbers = np.empty(self.element_count, np.int32)
        numbers[np.concatenate(groups)] = np.repeat(np.arange(len(groups)), [len(group) for group in groups])
        return numbers

    def batches_of_groups(self) -> list[tuple[wp.array, wp.array, wp.array, int]]:
        """Subtrees and other groups in the form of ``kernels.share_in_groups``, and their numbers."""
        return self._of_subtrees(self.plan.batches) + self._others.groups

    def _of_subtrees(self, batches: Sequence[Batch]) -> list[tuple[wp.array, wp.array, wp.array, int]]:
        return [(b.subtrees.first, self._all, b.live or self._all, b.count) for b in batches]

    @property
    def find_members(self) -> Callable[[int], Members]:
        return self.members

    def members(self, below: int | None = None) -> Members:
        """The nodes of groups, of all elements or those below a number; waits for the device."""
        return Members.of(self.of, self.batches_of_groups(), self.elements.nodes, below)

    def share_weights(self, u: wp.array, p: wp.array) -> wp.array:
        """Data of the shared dilatation for derivatives with respect to elements' weights, vec4 [T]; see
        ``kernels.elements.shared_dilatation.weight_law_at``.
        """
        return self._share(u, p, kernels.weight_law_at(self.of))

    def _share(self, u: wp.array, p: wp.array, law: wp.Function | None = None) -> wp.array:
        """Launch the second pass of ``kernels.elements.shared_dilatation`` for all elements."""
        shared, law = self._shared, law or kernels.law_at(self.of)
        measure = kernels.measure_elements(self.kind, self.of)
        self._regions.launch_over(
            measure,
            self.element_count,
            lambda _, own: ([own(self.elements), self._all, self._all, u, p], [own(shared)]),
            u.ptr,
            p.ptr,
        )
        kernel = kernels.share_in_groups(self.kind, law)
        for starts, members, live, count in self.batches_of_groups():
            self.launch(kernel, count, [starts, members, live, self.elements, self.isotropic], [shared])
        return shared


def _with_slots(discretization: Discretization) -> tuple[Any, Slots]:
    """All elements, of which each has slots of its own."""
    mesh = discretization.mesh
    slots, targets = Slots.of_units(mesh.tets, len(mesh.points), discretization.device, discretization.worlds)
    numbers = wp.array(targets, dtype=wp.vec4i, device=discretization.device)
    return with_targets(discretization.elements, numbers), slots


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
