"""Simulated time beside a clock on the wall."""

from __future__ import annotations

import time
from dataclasses import dataclass

#: The least share of a frame's time that steps have, however long the rest takes.
STEPPING = 0.4
#: A frame is not to be longer than this many times its period, whatever was late.
MOST_LATE = 2.0
#: Time counts as slow below this share of the requested speed.
SLOW = 0.9


@dataclass
class Pace:
    """The speed of simulated time.

    Attributes:
        rate: Simulated seconds a second of stepping, lately.
        ratio: Simulated over wall time, lately.
        rest: Wall time of a frame that is not stepping, lately [s].
    """

    rate: float = 0.0
    ratio: float = 0.0
    rest: float = 0.0
    _then: float = 0.0

    def wanted(self, speed: float, period: float) -> float:
        """Simulated seconds that the next frame is to have: as asked for, if a frame's time is enough.

        Args:
            speed: Simulated seconds that a second on the wall is to have.
            period: Of frames [s].
        """
        since = time.perf_counter() - self._then if self._then else period
        asked = speed * min(since, MOST_LATE * period)
        most = self.rate * max(period - self.rest, STEPPING * period) if self.rate else asked
        return min(asked, most)

    def is_slow(self, speed: float) -> bool:
        """Whether simulated time is slower than requested."""
        return 0.0 < self.ratio < SLOW * speed

    def took(self, simulated: float, stepping: float, rest: float) -> None:
        """A frame was made: of so much simulated time, so much stepping, and the rest [s]."""
        now = time.perf_counter()
        if simulated > 0.0:
            self.rate = _mean(self.rate, simulated / max(stepping, 1e-9), 0.3)
        self.rest = _mean(self.rest, rest, 0.3)
        if self._then:
            self.ratio = _mean(self.ratio, simulated / max(now - self._then, 1e-9), 0.1)
        self._then = now

    def interrupted(self) -> None:
        """What follows has nothing to do with the time before."""
        self._then = 0.0


def _mean(before: float, now: float, share: float) -> float:
    return now if not before else before + share * (now - before)
