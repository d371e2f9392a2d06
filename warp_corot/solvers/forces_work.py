"""The work of forces besides elasticity, node by node."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import warp as wp

from warp_corot.kernels.stepping.work import COUNT_CONSTRAINTS, COUNT_WORK, separate_forces
from warp_corot.solvers.steps.pace import Pace

if TYPE_CHECKING:
    from warp_corot.body.soft_body import SoftBody


class ForcesWork:
    """Counts the work of a system's forces and constraints.

    Args:
        bodies, pace, gravity: The system's.

    Attributes:
        accounts: The work of forces on the nodes of each body, and the sum of its absolute values [J]: float64 [2, n],
            world after world.
        of_constraints: The work of constraints on bodies that were touched, by the number of the body. It stays when a
            constraint is removed.
        others: All forces besides elasticity in the last step [N], vec4, for each body.
    """

    def __init__(self, bodies: Sequence[SoftBody], pace: Pace, gravity: wp.vec3):
        self._bodies, self._pace, self._gravity = bodies, pace, gravity
        self.accounts: list[wp.array] = []
        self.others: list[wp.array] = []
        self.of_constraints: dict[int, wp.array] = {}
        self._elastic: list[wp.array] = []

    def prepare(self, counted: bool) -> None:
        """Make room for the present arrays of nodes; not while launches are recorded.

        Args:
            counted: Whether there are forces whose work is counted.
        """
        lengths = [len(body.state.displacements) for body in self._bodies]
        for k, (body, length) in enumerate(zip(self._bodies, lengths, strict=True)):
            if body.state.is_touched and (k not in self.of_constraints or self.of_constraints[k].shape[1] != length):
                self.of_constraints[k] = wp.zeros((2, length), dtype=wp.float64, device=body.device)
        if not counted:
            return
        if lengths == [len(array) for array in self.others]:
            return
        device = self._bodies[0].device
        self.others, self._elastic = ([wp.zeros(n, dtype=wp.vec4, device=device) for n in lengths] for _ in range(2))
        self.accounts = [wp.zeros((2, n), dtype=wp.float64, device=device) for n in lengths]

    def launch_begin(self) -> None:
        """Launch the copy of the forces so far, which are elastic."""
        for body, elastic in zip(self._bodies, self._elastic, strict=True):
            wp.copy(elastic, body.state.forces)

    def launch_separation(self) -> None:
        """Launch the difference since then: the other forces."""
        for body, elastic, others in zip(self._bodies, self._elastic, self.others, strict=True):
            inputs = [elastic, body.state.forces]
            wp.launch(separate_forces, body.sizes.launch_nodes, inputs, [others], device=body.device)

    def launch_count(self, offset: int, damping: float) -> None:
        """Launch the sum of their work, after the forces of constraints, which change the motion."""
        for k, body in enumerate(self._bodies):
            state, conditions = body.state, body.conditions
            inputs = [damping, self._gravity, conditions.inverse_mass, int(conditions.has_loads), conditions.loads]
            inputs += [self._pace.arrays, offset, self._elastic[k], state.forces, state.velocities]
            outputs = [self.others[k], self.accounts[k]]
            wp.launch(COUNT_WORK[conditions.loads.dtype], body.sizes.launch_nodes, inputs, outputs, device=body.device)

    def launch_constraints(self, offset: int, damping: float) -> None:
        """Launch the sum of the constraints' work, after all of them have added their forces."""
        for k, account in self.of_constraints.items():
            body = self._bodies[k]
            state, conditions = body.state, body.conditions
            inputs = [damping, self._gravity, conditions.inverse_mass, int(conditions.has_loads), conditions.loads]
            inputs += [self._pace.arrays, offset, state.contact_forces, state.forces, state.velocities]
            kernel = COUNT_CONSTRAINTS[conditions.loads.dtype]
            wp.launch(kernel, body.sizes.launch_nodes, inputs, [account], device=body.device)
