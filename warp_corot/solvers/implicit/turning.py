"""The state at which steps with one linearisation are linearised."""

from __future__ import annotations

from typing import TYPE_CHECKING

import warp as wp

from warp_corot.kernels.implicit import increments as kernels

from .conjugate_gradients import WorldSums

if TYPE_CHECKING:
    from .tangent import TangentOperator


class TurnedState:
    """A body turned as a whole as it will turn in a step of backward Euler; see ``kernels.implicit.increments``.

    Elastic forces are linearised there, and then taken back to where the step begins: f(x) = f(x + w) + K w with the
    way w of the turn. Bodies with held nodes are not turned.

    Args:
        operator: The operator of the body, whose derivative is taken there.
        dt: The step [s].

    Attributes:
        displacements: Those of the turned body [m], vec4.
    """

    def __init__(self, operator: TangentOperator, dt: float):
        self._operator, self._dt, self.body = operator, wp.float64(dt), operator.body
        worlds, device = operator.worlds, operator.device
        self.displacements, self._way = (wp.zeros_like(self.body.state.displacements) for _ in range(2))
        self._sums = WorldSums(worlds, operator.node_count, kernels.MOTION_COLUMNS, device, operator.ranks)
        self._centres = wp.zeros(worlds, dtype=wp.vec3, device=device)
        self._turns = wp.zeros(worlds, dtype=wp.mat33, device=device)
        self._any_turns = wp.zeros(1, dtype=wp.int32, device=device)

    def launch_forces(self, forces: wp.array) -> None:
        """Launch the linearisation, and the addition of its elastic forces in the present state [N], vec4."""
        body, sums, operator = self.body, self._sums, self._operator
        state, conditions = body.state, body.conditions
        self._any_turns.zero_()
        inputs = [conditions.mass, conditions.inverse_mass, state.rest, state.displacements, state.velocities]
        wp.launch(kernels.sum_motion, sums.shape, [*inputs, *sums.sizes], [sums.parts], device=operator.device)
        sums.take_in(*range(kernels.MOTION_COLUMNS))
        outputs = [self._centres, self._turns, self._any_turns]
        sums.launch_scalars(kernels.find_turns, [self._dt], outputs)
        inputs = [operator.node_count, state.rest, state.displacements, self._centres, self._turns]
        outputs = [self.displacements, self._way]
        wp.launch(kernels.turn_nodes, body.sizes.launch_nodes, inputs, outputs, device=operator.device)
        operator.field.add_forces(self.displacements, forces)
        operator.take(self.displacements)
        if operator.device.is_cpu:
            wp.capture_if(self._any_turns, self._go_back, forces=forces)
        else:
            # A condition would take longer.
            self._go_back(forces)

    def _go_back(self, forces: wp.array) -> None:
        self._operator.tangent.add_product(self._way, forces)
