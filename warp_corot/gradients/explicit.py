"""Runs of explicit steps forwards and backwards, which keep the states at the beginnings of segments."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warp_corot.elasticity import ForceField
from warp_corot.kernels.gradients import steps as kernels
from warp_corot.solvers.graphs import Replays

from .sums import StepSums

if TYPE_CHECKING:
    from warp_corot.body.soft_body import SoftBody
    from warp_corot.solvers import SymplecticEuler


class ExplicitRun:
    """Steps of symplectic Euler of one body, from its present state.

    Only states at the beginnings of segments are kept. The other states of a segment are computed again when it is run
    backwards. So there are two runs forwards in all, and memory for the states of one segment and for one state of each
    segment.

    Args:
        body, field: The body and its elastic forces.
        integrator: The integrator, with a given step.
        gravity: [m/s^2].
        sums: The sums over steps.
        ends: The numbers of steps at which segments end, increasing; the last one is the end of the run.

    Attributes:
        displacements, velocities: At the beginning, and at each of the ends, vec4 each.
        of_displacements, of_velocities: The adjoint of the state that the run backwards has reached, vec4.
    """

    def __init__(
        self,
        body: SoftBody,
        field: ForceField,
        integrator: SymplecticEuler,
        gravity: Sequence[float],
        sums: StepSums,
        ends: Sequence[int],
    ):
        self.body, self.field, self.sums, self.device = body, field, sums, body.device
        self.lengths = np.diff([0, *ends]).tolist()
        assert integrator.dt is not None
        self._dt, self._damped = integrator.dt, 1.0 / (1.0 + integrator.dt * integrator.damping)
        self._gravity, self._tangent = wp.vec3(*gravity), field.tangent(exact=True)
        state = body.state
        self._u, self._v = wp.clone(state.displacements), wp.clone(state.velocities)
        self.of_displacements, self.of_velocities, self._p, self._product, self._f = (
            wp.zeros_like(self._u) for _ in range(5)
        )
        self._kept = [wp.zeros_like(self._u) for _ in range(max(self.lengths))]
        self.displacements, self.velocities = [wp.clone(self._u)], [wp.clone(self._v)]
        self._replays = Replays(self.device)
        self._tangent.prepare(self._u)

    def forward(self) -> None:
        """Run to the end, and leave the body in that state."""
        for length in self.lengths:
            self._replays.launch(("forward", length), partial(self._forward, length))
            self.displacements.append(wp.clone(self._u))
            self.velocities.append(wp.clone(self._v))
        state = self.body.state
        wp.copy(state.displacements, self._u)
        wp.copy(state.velocities, self._v)
        state.publish_positions()

    def backward(self, segment: int) -> None:
        """Run a segment backwards, after the segments that follow it."""
        length = self.lengths[segment]
        wp.copy(self._u, self.displacements[segment])
        wp.copy(self._v, self.velocities[segment])
        self._replays.launch(("forward", length), partial(self._forward, length))
        self._replays.launch(("backward", length), partial(self._backward, length))

    def _forward(self, length: int) -> None:
        conditions = self.body.conditions
        inputs = [self._dt, self._damped, self._gravity, conditions.inverse_mass, self.sums.loads]
        for step in range(length):
            wp.copy(self._kept[step], self._u)
            self.field.add_forces(self._u, self._f)
            self._launch(kernels.take_explicit_step, inputs, [self._f, self._u, self._v])

    def _backward(self, length: int) -> None:
        inputs = [self._dt, self._damped, self.body.conditions.inverse_mass, self.of_displacements]
        outputs = [self.of_velocities, self.sums.of_loads, self._p]
        for step in reversed(range(length)):
            u = self._kept[step]
            self._launch(kernels.begin_explicit_adjoint, inputs, outputs)
            self.sums.add(u, self._p)
            self._product.zero_()
            self._tangent.take(u)
            self._tangent.add_product(self._p, self._product)
            self._launch(kernels.subtract, [self._product], [self.of_displacements])

    def _launch(self, kernel: wp.Kernel, inputs: list, outputs: list) -> None:
        wp.launch(kernel, self.body.sizes.launch_nodes, inputs, outputs, device=self.device)
