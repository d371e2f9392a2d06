"""What every time integrator is: a small description, and the stepper that it becomes for one body."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warp_corot.elasticity import ForceField
from warp_corot.solvers.steps.pace import Pace

if TYPE_CHECKING:
    from warp_corot.body.soft_body import SoftBody


#: No step: later than all.
NEVER = np.iinfo(np.int64).max


@dataclass(frozen=True)
class StepContext:
    """What the steppers of a simulation share.

    Attributes:
        pace: The clock and the length of a step; steps recorded in one run add their offset.
        gravity: [m/s^2].
        support_work: What moving supports have put in, and the sum of its absolute values [J], float64 [2].
        bad_step: The first step after which something was not finite, int64 [1] on the device.
    """

    pace: Pace
    gravity: wp.vec3
    support_work: wp.array
    bad_step: wp.array

    @classmethod
    def of(cls, pace: Pace, gravity: wp.vec3) -> StepContext:
        """A new one, in which nothing has happened."""
        bad_step = wp.array([NEVER], dtype=wp.int64, device=pace.device)
        return cls(pace, gravity, pace.support_work, bad_step)


class Stepper(ABC):
    """One body's time steps as launches that can be recorded."""

    @property
    def many_a_launch(self) -> bool:
        """Whether many steps are one launch."""
        return False

    def prepare(self) -> None:  # noqa: B027 (most need nothing)
        """Bring up to date what launches read of the body's controls; called before steps are recorded."""

    @abstractmethod
    def forces(self, offset: int = 0) -> None:
        """Launch the elastic forces of the ``offset``-th step since the clock was last advanced."""

    @abstractmethod
    def steps(self, count: int, *, forces_known: bool = False) -> None:
        """Launch steps, the first ones since the clock was last advanced.

        Args:
            count: How many.
            forces_known: Whether ``forces`` has been launched for the first of them.
        """


class Integrator(ABC):
    """The description of a time integrator: a frozen dataclass of plain values with a step ``dt`` [s] or None."""

    dt: float | None

    def stable_step(self, frequency: float) -> float:
        """The largest stable step [s] of a body whose largest angular frequency at rest is this [rad/s]; infinite for
        zero."""
        return 2.0 / frequency if frequency > 0.0 else math.inf

    @abstractmethod
    def bind(self, body: SoftBody, field: ForceField, context: StepContext) -> Stepper:
        """The stepper of a body under a force field."""
