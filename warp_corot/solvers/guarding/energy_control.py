"""What energy from nowhere does to the step: shorter where there was some, longer again where there was none, and how
often that is looked at."""

from __future__ import annotations

import math

from warp_corot.kernels.stepping.pace import LEAST
from warp_corot.solvers.recorded import RecordedSteps
from warp_corot.solvers.steps.safe_step import CALM_CHECKS, FIRST_INTERVAL, LIVELY, UNKNOWN, SafeStep, Schedule

from .guard import Guard

#: Measurements from one check with elastic energies to the next: for a body that stays as stiff as at rest, for one
#: that is strained so that its step is less than a share of that at rest, and while less than what is stable is taken
#: or a strained body errs by more than QUIET of what is let pass.
CHECK_INTERVALS = 16
STRAINED_INTERVALS = 4
CLOSE_INTERVALS = 2
STRAINED = 0.7
QUIET = 0.25
#: Bodies are calm if the step is this share of the one at rest, or more, and change fast if it has fallen to less than
#: this share of what it was at the check before.
CALM = 0.95
FALLING = 0.9
#: Energy from nowhere that is let pass between two checks, as a share of what gravity, loads and supports have moved:
#: the step is made shorter for more. It is less the more came lately, down to this share.
GAIN = 0.001
LEAST_LEAVE = 0.2
#: The same of what came lately (``guard.MEMORY``): from the first on the step is made shorter while there is more and
#: more of it, from one window of time to the next, the more the nearer it is to the second, and slowly longer while
#: there is not.
SURPLUS, MOST_SURPLUS = 0.004, 0.008
LEAST_CUT, MOST_CUT = 0.95, 0.7
SLOW_RECOVERY = 1.1
#: The step is made shorter where what fast vibrations err by is more than this share.
UNTIMELY = 0.004
#: What vibrations err by at any one time does not add up: it alone makes the share no smaller than this.
RINGING = 0.3
#: Growth of the step's share from one measurement to the next: from a half to the whole in 35 of them.
RECOVERY = 1.02


class EnergyControl:
    """Chooses the share of the step that is taken of what the state allows.

    Args:
        guard: Finds energy from nowhere.
        recorded: Whose measurements it makes fewer or more.
        safe_step: The step; None if one was given, which stays.
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
        """Go on as the device has it, which a checkpoint may have brought."""
        if self._safe_step is not None:
            schedule = self._safe_step.schedule
            self._look(schedule if schedule.intervals else schedule._replace(calm=UNKNOWN, intervals=CLOSE_INTERVALS))

    def go_on(self, steps: int) -> None:
        """Go on with unchecked steps after so many; nothing waits for them."""
        if steps >= CLOSE_INTERVALS * FIRST_INTERVAL and self._recorded.calm == UNKNOWN:
            self._recorded.calm = 0

    def begin_anew(self) -> None:
        """A user has written to the state: it may change fast."""
        if self._safe_step is not None:
            self._choose(self._safe_step.schedule._replace(calm=UNKNOWN, intervals=CLOSE_INTERVALS))

    def follow(self, steps: int) -> None:
        """Make the step shorter where energy came from nowhere, and longer again where none did.

        Args:
            steps: Done at the check that was made.
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
        """Take half the share, after going back to where so many steps were done."""
        assert self._safe_step is not None
        self._safe_step.schedule = self._safe_step.schedule._replace(steps=steps)
        self._take_share(0.5 * self._safe_step.share)

    def choose_intervals(self, *, checked: bool) -> None:
        """Look more often where a body is strained, less often where checks on elastic energies have found it calm."""
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
        """Measure and check as often as a schedule says."""
        self._intervals = schedule.intervals
        self._recorded.calm = schedule.calm

    def _take_share(self, share: float) -> None:
        """Take another share of the step that the state allows from here on."""
        assert self._safe_step is not None
        self._safe_step.share = max(share, float(LEAST))
        self._safe_step.resume()
        self._guard.settle()
