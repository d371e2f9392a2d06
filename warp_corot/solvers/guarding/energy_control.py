"""The control of the step by energy from nowhere: the step becomes shorter if there is some and grows again if there is
none. Also how often that is checked."""

from __future__ import annotations

import math

from warp_corot.kernels.stepping.pace import LEAST
from warp_corot.solvers.recorded import RecordedSteps
from warp_corot.solvers.steps.safe_step import CALM_CHECKS, FIRST_INTERVAL, LIVELY, UNKNOWN, SafeStep, Schedule

from .guard import Guard

#: Measurements between two checks with elastic energies: for a body that is as stiff as at rest; for a body that is
#: strained, so that its step is below a share of the one at rest; and while the step is shorter than the stable one, or
#: a strained body's error is more than QUIET of what is tolerated.
CHECK_INTERVALS = 16
STRAINED_INTERVALS = 4
CLOSE_INTERVALS = 2
STRAINED = 0.7
QUIET = 0.25
#: Bodies are calm if the step is at least this share of the one at rest. They change fast if it has fallen below this
#: share of the step at the check before.
CALM = 0.95
FALLING = 0.9
#: Tolerated energy from nowhere between two checks, as a share of the energy that gravity, loads and supports have
#: moved; beyond it the step becomes shorter. The more energy came lately, the less is tolerated, down to this share.
GAIN = 0.001
LEAST_LEAVE = 0.2
#: The same for the energy that came lately (``guard.MEMORY``). Above the first share, the step becomes shorter while
#: this energy grows from one window of time to the next, and faster the nearer it is to the second share. Otherwise the
#: step slowly grows.
SURPLUS, MOST_SURPLUS = 0.004, 0.008
LEAST_CUT, MOST_CUT = 0.95, 0.7
SLOW_RECOVERY = 1.1
#: The step becomes shorter if the error of fast vibrations is more than this share.
UNTIMELY = 0.004
#: The errors of vibrations at different times do not add up, so they alone make the share no smaller than this.
RINGING = 0.3
#: Growth of the step's share from one measurement to the next: from a half to one in 35 measurements.
RECOVERY = 1.02


class EnergyControl:
    """Chooses which share of the allowed step is taken.

    Args:
        guard: Finds energy from nowhere.
        recorded: The recorded steps, whose interval between measurements it sets.
        safe_step: The step; None if the user gave one, which stays.
    """

    def __init__(self, guard: Guard, recorded: RecordedSteps, safe_step: SafeStep | None):
        self._guard, self._recorded, self._safe_step = guard, recorded, safe_step
        self._intervals = CHECK_INTERVALS if safe_step is None else CLOSE_INTERVALS
        recorded.calm = 0 if safe_step is None else UNKNOWN

    @property
    def check_steps(self) -> int:
        """Steps from one check with elastic energies to the next."""
        return self._intervals * self._recorded.interval

    def begin(self) -> None:
        """Continue with the values on the device, which may come from a checkpoint."""
        if self._safe_step is not None:
            schedule = self._safe_step.schedule
            self._look(schedule if schedule.intervals else schedule._replace(calm=UNKNOWN, intervals=CLOSE_INTERVALS))

    def go_on(self, steps: int) -> None:
        """Continue unchecked after a number of steps, without waiting for the device."""
        if steps >= CLOSE_INTERVALS * FIRST_INTERVAL and self._recorded.calm == UNKNOWN:
            self._recorded.calm = 0

    def begin_anew(self) -> None:
        """Begin again after a user has written to the state, which may now change fast."""
        if self._safe_step is not None:
            self._choose(self._safe_step.schedule._replace(calm=UNKNOWN, intervals=CLOSE_INTERVALS))

    def follow(self, steps: int) -> None:
        """Make the step shorter if energy came from nowhere, and longer again if none did.

        Args:
            steps: Steps done at the check.
        """
        if self._safe_step is None:
            return
        guard, share = self._guard, self._safe_step.share
        schedule = self._safe_step.schedule
        intervals = (steps - schedule.steps) / self._recorded.interval
        self._safe_step.schedule = schedule._replace(steps=steps)
        leave = GAIN * max(1.0 - guard.surplus / MOST_SURPLUS, LEAST_LEAVE)
        late, more = guard.untimely / UNTIMELY, guard.gain / leave
        if late > 1.0 or more > 1.0:
            least = min(share, RINGING)
            share *= max(1.0 / math.sqrt(max(more, 1.0)), 0.5)
            share = min(share, max(share / math.sqrt(max(late, 1.0)), least))
        elif guard.surplus <= SURPLUS:
            share = min(share * RECOVERY**intervals, 1.0)
        if guard.surplus > SURPLUS and guard.trend is not None:
            near = min((guard.surplus - SURPLUS) / (MOST_SURPLUS - SURPLUS), 1.0)
            cut = LEAST_CUT + near * (MOST_CUT - LEAST_CUT)
            share = min(share * (cut if guard.trend > 0.0 else SLOW_RECOVERY), 1.0)
        if share != self._safe_step.share:
            self._take_share(share)

    def halve(self, steps: int) -> None:
        """Take half the share, after going back to the state with this number of steps."""
        assert self._safe_step is not None
        self._safe_step.schedule = self._safe_step.schedule._replace(steps=steps)
        self._take_share(0.5 * self._safe_step.share)

    def choose_intervals(self, *, checked: bool) -> None:
        """Check more often if a body is strained, and less often if checks of elastic energies found it calm."""
        if self._safe_step is None:
            return
        guard = self._guard
        share, allowed, at_rest = self._safe_step.shares
        before = self._safe_step.schedule
        calm = 0
        if not checked or allowed < FALLING * before.allowed:
            calm = LIVELY
        elif share == 1.0 and allowed >= CALM * at_rest:
            calm = min(max(before.calm, 0) + 1, CALM_CHECKS)
        if share < 1.0 or calm == LIVELY:
            intervals = CLOSE_INTERVALS
        elif allowed < STRAINED * at_rest:
            quiet = max(guard.gain / GAIN, guard.untimely / UNTIMELY) < QUIET
            intervals = STRAINED_INTERVALS if quiet else CLOSE_INTERVALS
        else:
            intervals = CHECK_INTERVALS if calm > 1 else STRAINED_INTERVALS
        self._choose(before._replace(calm=calm, intervals=intervals, allowed=allowed))

    def _choose(self, schedule: Schedule) -> None:
        assert self._safe_step is not None
        self._safe_step.schedule = schedule
        self._look(schedule)

    def _look(self, schedule: Schedule) -> None:
        """Measure and check at the intervals of a schedule."""
        self._intervals = schedule.intervals
        self._recorded.calm = schedule.calm

    def _take_share(self, share: float) -> None:
        """Set the share of the allowed step from here on."""
        assert self._safe_step is not None
        self._safe_step.share = max(share, float(LEAST))
        self._safe_step.resume()
        self._guard.settle()
