"""Simulated time over wall time."""

from __future__ import annotations

import time
from dataclasses import dataclass

#: The least share of a frame's time for steps, however long the rest takes.
STEPPING = 0.4
#: A frame takes at most this many times its period, even after a delay.
MOST_LATE = 2.0
#: Time counts as slow below this share of the requested speed.
SLOW = 0.9


@dataclass
class Pace:
    """The speed of simulated time.

    Attributes:
        rate: Simulated seconds per second of stepping, lately.
        ratio: Simulated over wall time, lately.
        rest: Wall time of a frame without its steps, lately [s].
    """

    rate: float = 0.0
    ratio: float = 0.0
    rest: float = 0.0
    _then: float = 0.0

    def wanted(self, speed: float, period: float) -> float:
        """Simulated seconds of the next frame: as many as requested, if a frame's time is enough for them.

        Args:
            speed: Wanted simulated seconds for each second of wall time.
            period: Period of frames [s].
        """
        since = time.perf_counter() - self._then if self._then else period
        asked = speed * min(since, MOST_LATE * period)
        most = self.rate * max(period - self.rest, STEPPING * period) if self.rate else asked
        return min(asked, most)

    def is_slow(self, speed: float) -> bool:
        """Whether simulated time is slower than requested."""
        return 0.0 < self.ratio < SLOW * speed

    def took(self, simulated: float, stepping: float, rest: float) -> None:
        """Note a frame: its simulated time, its time for steps, and the rest [s]."""
        now = time.perf_counter()
        if simulated > 0.0:
            self.rate = _mean(self.rate, simulated / max(stepping, 1e-9), 0.3)
        self.rest = _mean(self.rest, rest, 0.3)
        if self._then:
            self.ratio = _mean(self.ratio, simulated / max(now - self._then, 1e-9), 0.1)
        self._then = now

    def interrupted(self) -> None:
        """Forget the time before an interruption."""
        self._then = 0.0


def _mean(before: float, now: float, share: float) -> float:
    return now if not before else before + share * (now - before)
