"""A body under loads, which a static answer brings to rest."""

from __future__ import annotations

import numpy as np

from warp_corot.body.soft_body import SoftBody
from warp_corot.elasticity import ForceField

#: Loads on a free body balance if their sum is less than this share of the sum of their magnitudes.
BALANCED = 1e-5


class LoadedBody:
    """A body that is brought to rest.

    Args:
        body: The body.
        field: Its elastic forces.
        gravity: [m/s^2].

    Attributes:
        loads: Loads and weight [N], float64 [worlds * N, 3].
    """

    def __init__(self, body: SoftBody, field: ForceField, gravity: tuple[float, float, float]):
        self.body, self.field = body, field
        conditions, count = body.conditions, body.sizes.nodes
        self.loads = body.masses[:, None] * np.array(gravity)
        if conditions.has_loads:
            self.loads = self.loads + conditions.loads.numpy()[:count, :3].astype(np.float64)

    def falls(self) -> bool:
        """Whether nothing holds the body, and its loads do not balance."""
        worlds = self.body.worlds
        held = self.body.conditions.held_mask().reshape(worlds, -1).any(axis=1)
        of_worlds = self.loads.reshape(worlds, -1, 3)
        sums = np.linalg.norm(of_worlds.sum(axis=1), axis=1)
        return bool((~held & (sums > BALANCED * np.linalg.norm(of_worlds, axis=2).sum(axis=1))).any())

    def finish(self) -> None:
        """Let the body rest: no velocity, reactions at held nodes, positions published."""
        body, state = self.body, self.body.state
        state.velocities.zero_()
        elastic = self.field.elastic_forces(state.displacements).numpy()[: body.sizes.nodes, :3]
        held = body.conditions.held_mask()[:, None]
        reactions = np.zeros((body.sizes.nodes, 4), np.float32)
        reactions[:, :3] = np.where(held, -(elastic + self.loads), 0.0)
        state.reactions[: body.sizes.nodes].assign(reactions)
        state.publish_positions()
