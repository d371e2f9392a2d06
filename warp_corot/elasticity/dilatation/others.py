"""Elements outside complete subtrees, which share their dilatation in groups."""

from __future__ import annotations

import warp as wp

from warp_corot.discretization.changing.groups import ChangingGroups
from warp_corot.discretization.changing.plan import DevicePlan
from warp_corot.discretization.discretization import Discretization
from warp_corot.discretization.groups import Groups
from warp_corot.discretization.plan import Plan
from warp_corot.elasticity.paths.grouped import GroupedLanes
from warp_corot.elasticity.paths.lanes import as_general
from warp_corot.errors import InputError
from warp_corot.kernels.elements import dilatation_lanes as lanes
from warp_corot.kernels.elements import shared_dilatation as kernels
from warp_corot.kernels.elements.constitutive import IsotropicMaterial
from warp_corot.kernels.elements.dilatation import Dilatation
from warp_corot.kernels.elements.elements import GeneralElements
from warp_corot.kernels.elements.general_cpu import rest_matrices
from warp_corot.kernels.elements.lanes import LANES
from warp_corot.mesh import TetForest


class Others:
    """The elements of a plan that are outside complete subtrees.

    Their groups are found again whenever a forest changes.

    Call ``follow`` before anything is launched, once it is known whether they are joined.

    Args:
        discretization: The mesh.
        plan: The field's units of work.
        of: The shared dilatation.

    Attributes:
        count: Number of elements in launches.
        grouped: The elements in groups on the CPU, for the law's own launches.
        are_joined: Whether the law's own launches add their forces.

    Raises:
        InputError: The forest changes, and the law computes forces leaf by leaf.
    """

    def __init__(self, discretization: Discretization, plan: Plan, of: Dilatation):
        self._discretization, self._plan, self._of = discretization, plan, of
        self._device, self._kind = discretization.device, discretization.element_kind
        self._none = wp.empty(0, dtype=wp.int32, device=self._device)
        self._still = wp.empty(0, dtype=wp.vec4, device=self._device)
        mesh = discretization.mesh
        self._groups: Groups | ChangingGroups
        if isinstance(plan, DevicePlan):
            if not plan.kinds:
                raise InputError(
                    "this model computes forces leaf by leaf, where elements of a body that is remeshed cannot share "
                    "their dilatation; take dilatation='element', or the model's default rotations and stiffness"
                )
            self._groups = ChangingGroups(plan)
        elif isinstance(mesh, TetForest):
            leaves = plan.flat.leaves.numpy()
            leaves = leaves[: len(leaves) // discretization.worlds]
            self._groups = Groups.of_leaves(mesh, leaves, self._device, discretization.worlds)
        else:
            self._groups = Groups.of_elements(mesh, self._device, discretization.worlds)
        self.grouped: GroupedLanes | None = None
        self.count, self.are_joined = 0, False
        groups = self._groups
        if not self._device.is_cuda:
            live = groups.live if isinstance(groups, ChangingGroups) else self._none
            self.grouped = GroupedLanes(plan, self._kind, of, groups.starts, groups.members, live)
        self.derive()

    def derive(self) -> None:
        """Launch the search for groups if the mesh changes; may be recorded."""
        if isinstance(self._groups, ChangingGroups):
            self._groups.launch()

    def follow(self) -> None:
        """Update to the elements of the present plan."""
        plan, flat = self._plan, self._plan.flat
        self._places, live = self._none, None
        if plan.kinds or len(flat):
            self.count, self._elements, self._places, live = len(flat), flat.elements, flat.leaves, flat.live
        else:
            self.count, self._elements = self._discretization.sizes.launch_elements, plan.elements
        self._live = self._none if live is None else live
        if self.grouped is not None:
            self.grouped.count = sum(count for *_, count in self.groups)
        self._general = None
        if self.count and not self.are_joined and not self._device.is_cuda:
            self._general = self._elements if self._kind is GeneralElements else flat.general
            self._general = self._general or as_general(self._elements, rest_matrices, [self._elements])

    @property
    def kernels(self) -> list[wp.Kernel]:
        """All kernels that forces may launch."""
        if self.are_joined:
            return []
        if self._device.is_cuda:
            passes = [kernels.measure_elements(self._kind, self._of), kernels.scatter_pressures(self._kind, self._of)]
        else:
            passes = [lanes.measure_in_lanes(self._of), lanes.scatter_in_lanes(self._of)]
        return [*passes, kernels.share_in_groups(self._kind, kernels.law_at(self._of))]

    def scatter(self, material: IsotropicMaterial, u: wp.array, shared: wp.array, f: wp.array) -> None:
        """Add the forces of displacements u to f; ``shared`` has room for all elements of the mesh."""
        if self._device.is_cuda:
            where = [self._elements, self._places, self._live]
            self._launch(kernels.measure_elements(self._kind, self._of), [*where, u, self._still], [shared])
        else:
            blocks, where = -(-self.count // LANES), [self._general, self.count, self._places, self._live]
            self._launch(lanes.measure_in_lanes(self._of), [*where, u], [shared], blocks)
        starts, members, live, count = self.groups[0]
        inputs = [starts, members, live, self._plan.elements, material]
        self._launch(kernels.share_in_groups(self._kind, kernels.law_at(self._of)), inputs, [shared], count)
        if self._device.is_cuda:
            kernel = kernels.scatter_pressures(self._kind, self._of)
            self._launch(kernel, [*where, material, u, shared], [f])
        else:
            self._launch(lanes.scatter_in_lanes(self._of), [*where, material, u, shared], [f], blocks)

    @property
    def groups(self) -> list[tuple[wp.array, wp.array, wp.array, int]]:
        """The groups in the form of ``kernels.share_in_groups``, and their number; empty without elements."""
        groups = self._groups
        if not self.count:
            return []
        if isinstance(groups, ChangingGroups):
            return [(groups.starts, groups.members, groups.live, self.count)]
        return [(groups.starts, groups.members, self._none, len(groups))]

    def _launch(self, kernel: wp.Kernel, inputs: list, outputs: list, count: int | None = None) -> None:
        wp.launch(kernel, self.count if count is None else count, inputs, outputs, device=self._device)
