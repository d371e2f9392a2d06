"""A body under loads, which a static answer brings to rest."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from warp_corot.body.soft_body import SoftBody
from warp_corot.elasticity import ForceField
from warp_corot.mesh.topology import linked, node_pairs

#: Loads on a free body balance if their sum is less than this share of the sum of their magnitudes.
BALANCED = 1e-5
#: Held nodes are on one line if they are within this share of their distances.
ON_A_LINE = 1e-6


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

    def turns(self) -> bool:
        """Whether loads at the rest shape do work in a rigid motion of a whole part of the mesh that leaves all held
        nodes where they are, because in some world they are on one line; parts that share no node move separately.
        """
        body = self.body
        part, points = _parts(body.mesh.tets, body.node_count // body.worlds), body.mesh.points
        held = body.conditions.held_mask().reshape(body.worlds, -1)
        loads = self.loads.reshape(body.worlds, -1, 3)
        for number in range(int(part.max()) + 1):
            nodes = np.flatnonzero(part == number)
            x = points[nodes] - points[nodes].mean(axis=0)
            motions = _rigid_motions(x / max(float(np.abs(x).max()), 1e-30))
            for world in range(body.worlds):
                kept = motions[held[world, nodes]].reshape(-1, 6)
                sizes, axes = np.linalg.eigh(kept.T @ kept)
                left = axes[:, sizes <= ON_A_LINE**2 * max(float(sizes[-1]), 1e-30)]
                forces = loads[world, nodes]
                work = np.linalg.norm(np.einsum("nci,nc->i", motions, forces) @ left)
                if work > BALANCED * np.linalg.norm(forces, axis=1).sum():
                    return True
        return False

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


def _rigid_motions(x: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Three translations and three turns about the axes at points [n, 3], [n, 3, 6]."""
    found = np.zeros((len(x), 3, 6))
    for axis in range(3):
        found[:, axis, axis] = 1.0
        found[:, :, 3 + axis] = np.cross(np.eye(3)[axis], x)
    return found


def _parts(tets: npt.NDArray[np.integer], count: int) -> npt.NDArray[np.int32]:
    """The part of each node, -1 if it is in no element: elements that share a node belong to one part."""
    label = linked(node_pairs(tets), count)
    used = np.zeros(count, bool)
    used[tets.ravel()] = True
    part = np.full(count, -1, np.int32)
    part[used] = np.unique(label[used], return_inverse=True)[1]
    return part
