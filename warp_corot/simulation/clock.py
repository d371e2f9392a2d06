"""The clock of a simulation: steps and times."""

from __future__ import annotations

from warp_corot.solvers.pace import Pace
from warp_corot.solvers.stability import SafeStep


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
        return self.pace.dt if safe_step is None else safe_step.allowed

    @property
    def dt_range(self) -> tuple[float, float]:
        """The shortest and the longest time step so far [s]."""
        safe_step = self.safe_step
        return (self.dt, self.dt) if safe_step is None else safe_step.range

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
