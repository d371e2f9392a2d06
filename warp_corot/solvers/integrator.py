"""Time integrators: a small description each, and the stepper that it becomes for a system of bodies."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, ClassVar

import warp as wp

if TYPE_CHECKING:
    from .system import System

#: Steps recorded in one graph where a launch is not many steps.
GRAPH_STEPS = 64


class Stepper(ABC):
    """Time steps of all bodies of a system as launches that can be recorded."""

    #: Whether steps launch the forces of the system's constraints.
    resolves_constraints = False
    #: The most steps of one recording.
    graph_steps = GRAPH_STEPS

    @property
    def kept(self) -> dict[str, wp.array]:
        """Arrays that a step leaves for the next one besides the state of bodies and fields, by name."""
        return {}

    @property
    def many_a_launch(self) -> bool:
        """Whether many steps are one launch, for every body."""
        return False

    def prepare(self) -> None:  # noqa: B027 (most need nothing)
        """Copy what launches read of the bodies' conditions to the device; called before steps are recorded."""

    def continue_from(self, other: Stepper) -> None:  # noqa: B027 (most need nothing)
        """Take over what another stepper of the same integrator has counted, in whose place this one is."""

    def fall_back(self) -> bool:
        """Make steps sturdier until ``recover`` is called; whether they can be."""
        return False

    def recover(self) -> None:  # noqa: B027 (most need nothing)
        """Make steps as usual again."""

    @abstractmethod
    def forces(self, offset: int = 0) -> None:
        """Launch the elastic forces of the ``offset``-th step since the clock was last advanced."""

    @abstractmethod
    def steps(self, count: int, *, forces_known: bool = False) -> None:
        """Launch steps, the first ones since the clock was last advanced.

        Args:
            count: Number of steps.
            forces_known: Whether ``forces`` has been launched for the first of them.
        """


class Integrator(ABC):
    """The description of a time integrator: a frozen dataclass of plain values with a step ``dt`` [s] or None."""

    dt: float | None
    #: Whether steps of any length are stable.
    is_implicit: ClassVar[bool] = False

    def stable_step(self, frequency: float) -> float:
        """The largest stable step [s] of a body whose largest angular frequency at rest is this [rad/s]; infinite for
        zero."""
        return 2.0 / frequency if frequency > 0.0 else math.inf

    @abstractmethod
    def bind(self, system: System) -> Stepper:
        """The stepper of a system."""
