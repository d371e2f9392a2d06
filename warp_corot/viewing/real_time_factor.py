"""Simulated time over wall time."""

from __future__ import annotations

import time
from dataclasses import dataclass

#: The least share of a frame's time for steps, however long the rest takes.
STEPPING = 0.4
#: Time is made up for that was lost within this many periods of frames.
MOST_LATE = 4.0
#: Time counts as slow below this share of the requested speed.
SLOW = 0.9


@dataclass
class RealTimeFactor:
    """The speed of simulated time.

    Attributes:
        rate: Simulated seconds per second of stepping, lately.
        ratio: Simulated over wall time, lately.
        rest: Wall time of a frame without its steps, lately [s].
    """

    rate: float = 0.0
    ratio: float = 0.0
    rest: float = 0.0
    _owed: float = 0.0
    _since: float = 0.0
    _then: float = 0.0

    def wanted(self, speed: float, period: float) -> float:
        """Simulated seconds of the next frame: as many as requested since the last one began, and as are still owed
        from those before, if there is time enough for them.

        Args:
            speed: Wanted simulated seconds for each second of wall time.
            period: Period of frames [s].
        """
        now = time.perf_counter()
        self._since, self._then = (now - self._then if self._then else period), now
        late = MOST_LATE * period
        self._owed = min(self._owed + speed * self._since, speed * late)
        # Frames that were late may take longer, but less so each time.
        length = 0.5 * (period + min(max(self._since, period), late))
        return min(self._owed, self.rate * max(length - self.rest, STEPPING * period) if self.rate else self._owed)

    def is_slow(self, speed: float) -> bool:
        """Whether simulated time is slower than requested."""
        return 0.0 < self.ratio < SLOW * speed

    def took(self, simulated: float, stepping: float) -> None:
        """Note an advance: its simulated time, and its time for steps [s]."""
        self._owed = max(self._owed - simulated, 0.0)
        if simulated > 0.0:
            self.rate = _mean(self.rate, simulated / max(stepping, 1e-9), 0.3)
        if self._since:
            self.ratio = _mean(self.ratio, simulated / self._since, 0.1)

    def showed(self, rest: float) -> None:
        """Note how long a frame took to read and send [s]."""
        self.rest = _mean(self.rest, rest, 0.3)

    def interrupted(self) -> None:
        """Forget the time before an interruption."""
        self._owed = self._since = self._then = 0.0


def _mean(before: float, now: float, share: float) -> float:
    return now if not before else before + share * (now - before)
