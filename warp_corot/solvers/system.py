"""What is stepped together: bodies, their elastic forces, other forces, and the clock."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Protocol

import numpy as np
import warp as wp

from warp_corot.elasticity import ForceField
from warp_corot.solvers.steps.pace import Pace

if TYPE_CHECKING:
    from warp_corot.body.soft_body import SoftBody

#: No step: later than all.
NEVER = np.iinfo(np.int64).max


class Forces(Protocol):
    """Something besides elasticity that pushes nodes of one body or of several, such as damping."""

    def add_forces(self) -> None:
        """Launch what adds the forces in the present state to ``state.forces`` of the bodies concerned [N]."""
        ...


class System:
    """All bodies of a simulation, on one device.

    Args:
        bodies: The bodies.
        fields: The elastic force field of each.
        pace: The clock and the length of a step; steps recorded in one run add their offset.
        gravity: [m/s^2].

    Attributes:
        forces: What pushes nodes besides elasticity.
        device, worlds: Of all bodies.
        support_work: What moving supports have put in, and the sum of its absolute values [J], float64 [2].
        bad_step: The first step after which something was not finite, int64 [1] on the device.
    """

    def __init__(self, bodies: Sequence[SoftBody], fields: Sequence[ForceField], pace: Pace, gravity: Sequence[float]):
        self.bodies, self.fields, self.pace, self.gravity = tuple(bodies), tuple(fields), pace, wp.vec3(*gravity)
        self.forces: list[Forces] = []
        self.device, self.worlds = bodies[0].device, bodies[0].worlds
        self.support_work = pace.support_work
        self.bad_step = wp.array([NEVER], dtype=wp.int64, device=self.device)

    @property
    def launch_revision(self) -> int:
        """Changes whenever the launches of a step do, so that steps must be recorded again."""
        return sum(body.launch_revision for body in self.bodies)

    @property
    def rewritten(self) -> int:
        """Changes whenever keyframes do that launches go on with."""
        return sum(body.conditions.rewritten for body in self.bodies)

    def add_elastic_forces(self, k: int, offset: int = 0) -> None:
        """Launch the elastic forces of the k-th body, of the ``offset``-th step since the clock was last advanced."""
        body, state, field = self.bodies[k], self.bodies[k].state, self.fields[k]
        body.conditions.follow_activations(self.pace, offset)
        field.add_forces(state.displacements, state.forces)

    def adopt_positions(self) -> None:
        """Take over what somebody wrote to positions since they were published."""
        for body in self.bodies:
            body.state.adopt_positions()

    def publish_positions(self) -> None:
        """Write positions from displacements."""
        for body in self.bodies:
            body.state.publish_positions()
