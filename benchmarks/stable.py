"""Search for the largest stable step of a solver."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod

#: Steps longer than a frame of an animation are not needed [s].
LONGEST = 1.0 / 60.0

#: A step is stable if no node of the unit cube has moved farther than this after this many steps [m].
FURTHEST = 0.25
STEPS = 100

#: The largest stable step is found to this ratio.
PRECISION = 1.05


class Steppable(ABC):
    """A solver on a problem, for comparison.

    Attributes:
        name: Name in the table.
        dt: The step that ``step`` takes [s]; may be set.
        recordable: Whether a CUDA graph may record ``step``.
        wrong: Upper bound of ``error``; None if that is not an error.
    """

    name: str
    dt: float
    recordable: bool = False
    wrong: float | None = 1e-3

    @abstractmethod
    def reset(self) -> None:
        """Restore the problem's state at rest."""

    @abstractmethod
    def step(self, count: int) -> None:
        """Take this many steps."""

    @abstractmethod
    def largest_displacement(self) -> float:
        """Largest displacement of any node along any axis [m]; infinite if the state is not finite."""

    @abstractmethod
    def error(self) -> float:
        """Error of one step from the problem's state."""

    def stands(self, dt: float) -> bool:
        self.dt = dt
        self.reset()
        for _ in range(0, STEPS, 10):
            self.step(10)
            if not self.largest_displacement() < FURTHEST:
                return False
        return True

    def largest_stable_step(self, guess: float) -> float:
        """The largest stable step [s], at most ``LONGEST``; 0 if none above a thousandth of the guess is stable."""
        stable, unstable = 0.0, math.inf
        dt = min(guess, LONGEST)
        while stable == 0.0 or math.isinf(unstable):
            if self.stands(dt):
                stable = dt
                if dt >= LONGEST:
                    return dt
                dt = min(2.0 * dt, LONGEST)
            else:
                unstable = dt
                dt *= 0.5
                if dt < 1e-3 * guess:
                    return 0.0
            if stable and unstable < math.inf:
                break
        while unstable / stable > PRECISION:
            dt = math.sqrt(stable * unstable)
            if self.stands(dt):
                stable = dt
            else:
                unstable = dt
        return stable
