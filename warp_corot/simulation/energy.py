"""Energies of a simulation's bodies, together and world by world."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    from warp_corot.body.soft_body import SoftBody
    from warp_corot.elasticity import ForceField
    from warp_corot.solvers.halo import Halo


class Energy(NamedTuple):
    """Energies of all bodies together [J]; gravitational about the origin."""

    kinetic: float
    elastic: float
    gravitational: float

    @property
    def total(self) -> float:
        return self.kinetic + self.elastic + self.gravitational


class WorldEnergies(NamedTuple):
    """The energies of each world [J], float64 [worlds]."""

    kinetic: npt.NDArray[np.float64]
    elastic: npt.NDArray[np.float64]
    gravitational: npt.NDArray[np.float64]

    @property
    def total(self) -> npt.NDArray[np.float64]:
        return self.kinetic + self.elastic + self.gravitational

    @property
    def together(self) -> Energy:
        """The sum over worlds."""
        return Energy(*(float(of_worlds.sum()) for of_worlds in self))


def find_energies(
    bodies: Sequence[SoftBody], fields: Sequence[ForceField], gravity: tuple[float, float, float], ranks: Halo
) -> WorldEnergies:
    """Energies of what this process moves and counts of bodies in their present state; waits for the device.

    Args:
        bodies, fields: The bodies, all with the same number of worlds, and the force field of each.
        gravity: [m/s^2].
        ranks: The processes with other parts of the bodies.
    """
    worlds = bodies[0].worlds
    kinetic, elastic, gravitational = (np.zeros(worlds) for _ in range(3))
    for body, field in zip(bodies, fields, strict=True):
        body.state.adopt_positions()
        masses = body.masses.reshape(worlds, -1)
        v = body.velocities.numpy().astype(np.float64)
        u = body.state.displacements[: body.node_count].numpy()[:, :3].astype(np.float64)
        height = (body.rest_positions + u) @ np.asarray(gravity)
        kinetic += 0.5 * np.einsum("wn,wn->w", masses, np.einsum("ni,ni->n", v, v).reshape(worlds, -1))
        elastic += field.elastic_energies(body.state.displacements, ranks.owned(body).clear_copies)
        gravitational -= np.einsum("wn,wn->w", masses, height.reshape(worlds, -1))
    return WorldEnergies(kinetic, elastic, gravitational)
