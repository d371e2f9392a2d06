"""What every time integrator is: a small description, and the stepper that it becomes for one body."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import TYPE_CHECKING

import warp as wp

from ..elasticity import ForceField

if TYPE_CHECKING:
    from ..body import SoftBody


@dataclass(frozen=True)
class StepContext:
    """What the steppers of a simulation share.

    Attributes:
        dt: Time step [s].
        gravity: [m/s^2].
        clock: Number of steps done, int64 [1] on the device; steps recorded in one run add their offset.
        bad_step: The first step after which something was not finite, int64 [1] on the device.
    """

    dt: float
    gravity: wp.vec3
    clock: wp.array
    bad_step: wp.array


class Stepper(ABC):
    """One body's time steps as launches that can be recorded."""

    @property
    def many_a_launch(self) -> bool:
        """Whether many steps are one launch."""
        return False

    @abstractmethod
    def steps(self, count: int) -> None:
        """Launch steps, the first ones since the clock was last advanced."""


class Integrator(ABC):
    """The description of a time integrator: a frozen dataclass of plain values with a step ``dt`` [s] or None."""

    dt: float | None

    @abstractmethod
    def bind(self, body: SoftBody, field: ForceField, context: StepContext) -> Stepper:
        """The stepper of a body under a force field."""
