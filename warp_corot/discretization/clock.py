"""The clock of a simulation, as lower rooms read it."""

from __future__ import annotations

from typing import Protocol

from warp_corot.kernels.stepping.pace import Pace


class Clock(Protocol):
    """Steps and seconds of a simulation; ``solvers.pace.Pace`` is one.

    Attributes:
        arrays: ``kernels.stepping.pace.Pace``, what kernels read.
    """

    @property
    def arrays(self) -> Pace: ...
