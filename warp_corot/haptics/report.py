"""A report on a haptic loop's times."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

#: Number of readings that are kept: more than a quarter of an hour at 1 kHz.
MEMORY = 1 << 20

Floats = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Report:
    """A loop's times and energy.

    Attributes:
        readings: How often the device was read.
        missed: Periods in which it was not.
        period, period_99, period_most: Time from one reading to the next: median, 99 % and longest [s].
        busy: Time of a reading with everything that follows it, median [s].
        delay, delay_99, delay_most: Time from reading a position to the first force that comes from a step with the
            tool there: median, 99 % and longest [s]; NaN if the simulation published nothing.
        updates: States of the simulation that were read.
        put_out: The most energy put out through the device minus what was put in, at any time [J].
        damped: Readings at which passivity control changed the force.
        beyond: Readings between which the device moved farther than the bound on energy assumes.
        stiffness: The last estimate of the tissue's stiffness at the tool [N/m].
    """

    readings: int
    missed: int
    period: float
    period_99: float
    period_most: float
    busy: float
    delay: float
    delay_99: float
    delay_most: float
    updates: int
    put_out: float
    damped: int
    beyond: int
    stiffness: float

    def __str__(self) -> str:
        each = f"; {1e6 * self.busy:.0f} us each" if self.readings else ""
        return "\n".join(
            [
                f"readings   {self.readings}, {self.missed} periods without one{each}",
                f"period     {_said(self.period, self.period_99, self.period_most)}",
                f"delay      {_said(self.delay, self.delay_99, self.delay_most)}",
                f"updates    {self.updates} states of the simulation, stiffness {self.stiffness:.3g} N/m at last",
                f"energy     at most {1e3 * self.put_out:.3g} mJ more out than in; {self.damped} forces changed, "
                f"{self.beyond} moves too fast for the bound",
            ]
        )


class TimeSeries:
    """The last values of a quantity that is measured often, in a ring.

    Attributes:
        count: Number of values so far.
        largest: The largest of all values.
    """

    def __init__(self) -> None:
        self._values = np.zeros(MEMORY)
        self.count, self.largest = 0, float("nan")

    def add(self, value: float) -> None:
        self._values[self.count % MEMORY] = value
        self.largest = value if not self.largest >= value else self.largest
        self.count += 1

    def share(self, percent: float) -> float:
        """A percentile of the kept values; NaN if there is none."""
        values = self._values[: min(self.count, MEMORY)]
        return float(np.percentile(values, percent)) if len(values) else float("nan")


def _said(median: float, share: float, longest: float) -> str:
    if not median >= 0.0:
        return "not measured yet"
    return f"{1e3 * median:.3g} ms median, {1e3 * share:.3g} ms 99 %, {1e3 * longest:.3g} ms longest"
