"""What a simulation tells: its clock, energies, and the cost of implicit solves."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import numpy.typing as npt

from warp_corot.solvers.pace import Pace
from warp_corot.solvers.stability import SafeStep

if TYPE_CHECKING:
    from warp_corot.body.soft_body import SoftBody
    from warp_corot.elasticity import ForceField
    from warp_corot.solvers.halo import Halo


class Clock:
    """The steps and times of a simulation.

    Attributes:
        pace: The clock on the device.
        safe_step: Chooses the step; None if one was given.
        steps_before_reset, time_before_reset: Time steps and simulated time before the last ``reset()`` of all worlds
            [s]; zero without one.
    """

    pace: Pace
    safe_step: SafeStep | None
    steps_before_reset: int = 0
    time_before_reset: float = 0.0

    @property
    def dt(self) -> float:
        """The time step [s]; if none was given, the one that the present state allows."""
        safe_step = self.safe_step
        return self.pace.dt if safe_step is None else safe_step.control.dt

    @property
    def dt_range(self) -> tuple[float, float]:
        """The shortest and the longest time step so far [s]."""
        safe_step = self.safe_step
        return (self.dt, self.dt) if safe_step is None else (safe_step.control.shortest, safe_step.control.longest)

    @property
    def steps(self) -> int:
        """Time steps since the last ``reset()``, or since the beginning."""
        return self.pace.steps

    @property
    def total_steps(self) -> int:
        """Time steps since the beginning; resets do not change it."""
        return self.steps_before_reset + self.steps

    @property
    def time(self) -> float:
        """Simulated time since the last ``reset()``, or since the beginning [s]."""
        return self.pace.time

    @property
    def total_time(self) -> float:
        """Simulated time since the beginning [s]; resets do not change it."""
        return self.time_before_reset + self.time


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


class Solves(NamedTuple):
    """Sums over all steps and bodies since the beginning; each step counts the world that needed most.

    Attributes:
        steps: Steps, once for each body.
        iterations: Iterations of Newton's method.
        linear_iterations: Iterations of conjugate gradients.
        unfinished: Steps that did not reach the tolerance, or whose linear solves ran out while contact still changed.
    """

    steps: int
    iterations: int
    linear_iterations: int
    unfinished: int
