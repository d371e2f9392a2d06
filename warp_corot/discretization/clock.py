"""The clock of a simulation, in the form that lower folders read."""

from __future__ import annotations

from typing import Protocol

from warp_corot.kernels.stepping.pace import Pace


class Clock(Protocol):
    """Steps and seconds of a simulation; ``solvers.pace.Pace`` is one.

    Attributes:
        arrays: ``kernels.stepping.pace.Pace`` for kernels.
    """

    @property
    def arrays(self) -> Pace: ...
