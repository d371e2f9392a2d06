"""Runs of a simulation: how many steps come before something else is due, and what becomes of a state gone wrong."""

from __future__ import annotations

import math
import warnings
from typing import TYPE_CHECKING

from .elasticity import StVenantKirchhoff
from .errors import StabilityWarning, UnstableError, depth_of_user
from .kernels.pace import GROWTH, LEAST
from .solvers.guard import Fault

if TYPE_CHECKING:
    from .simulation import Simulation

#: Measurements from one check with elastic energies to the next: for a body that stays as stiff as at rest, for one
#: that is strained so that its step is less than a share of that at rest, and while less than what is stable is taken
#: or a strained body errs by more than QUIET of what is let pass.
CHECK_INTERVALS = 16
STRAINED_INTERVALS = 4
CLOSE_INTERVALS = 2
STRAINED = 0.7
QUIET = 0.25
#: Measurements are fewer once the step has been this share of the one at rest, or more, at two checks in a row.
CALM = 0.95
CALM_CHECKS = 2
#: Energy from nowhere that is let pass between two checks, and in all, as shares of what gravity, loads and supports
#: have moved: the step is made shorter for more than the first, and not longer again before both are kept. Less is let
#: pass the nearer it is in all to the most there should be.
GAIN = 0.001
SURPLUS = 0.004
MOST_SURPLUS = 0.008
LEAST_LEAVE = 0.02
#: What vibrations err by at any one time does not add up: it alone makes the share no smaller than this.
RINGING = 0.3
#: Growth of the step's share from one measurement to the next: from a half to the whole in 35 of them.
RECOVERY = 1.02
#: How often the step is halved to come over one place.
MOST_RETURNS = 6
#: How often it is halved for a little energy from nowhere, as comes with crushed elements also of the shortest steps.
STRICT_RETURNS = 4
#: Steps made one at a time from one look at where nodes are to the next.
LOOK_STEPS = 256
#: Longer runs are looked after in between.
MOST_INTERVALS = 1000


class Running:
    """Makes the steps of a simulation.

    Args:
        sim: The simulation.
    """

    def __init__(self, sim: Simulation):
        self._sim = sim
        self._returns = 0
        #: The time at which the state was found to be wrong, while it has not been passed.
        self._wrong_until = -math.inf
        self._has_warned = False
        self._steps_called = 0
        #: Whether the last run ended with steps shorter than what the state allows.
        self._shortened = False
        self._steps_made = 0
        #: Steps done when the share of the step was last looked at.
        self._followed = 0
        self._check_intervals = CHECK_INTERVALS if sim.safe_step is None else CLOSE_INTERVALS

    def step(self) -> None:
        """Make one step, with a measurement before it where one is due."""
        sim = self._sim
        self._resume()
        position = sim.steps if sim.device.is_cpu else self._steps_made
        self._steps_made = position + 1
        measured = sim.safe_step is not None and position % sim.recorded.interval == 0
        sim.recorded.replay(1, whole=True, measured=measured)

    def make(self, count: int) -> None:
        """Make so many steps, with hooks and passes."""
        sim = self._sim
        end = sim.total_steps + count
        self._begin()
        while (left := end - sim.total_steps) > 0:
            self._go(left, None)

    def make_until(self, total_time: float) -> None:
        """Make steps until a time [s], exactly; only if the step is the simulation's to choose."""
        sim = self._sim
        self._begin()
        while sim.total_time < total_time:
            if self._go(MOST_INTERVALS * sim.recorded.interval, total_time - sim.time_before_reset):
                break

    def look(self) -> None:
        """See that the state is finite, and now and then that nodes are within reach.

        Raises:
            UnstableError: They are not.
        """
        guard = self._sim.guard
        fault = guard.not_finite()
        if fault is None and self._sim.steps % LOOK_STEPS == 0:
            fault = guard.beyond_reach()
        if fault is not None:
            raise UnstableError(self._message(fault))

    # --- pieces ----------------------------------------------------------------------------------------------------

    def _begin(self) -> None:
        sim = self._sim
        sim.recorded.adopt_positions()
        self._take()
        if sim.safe_step is not None:
            calm, intervals, self._followed = sim.safe_step.schedule
            self._check_intervals = intervals or CLOSE_INTERVALS
            sim.recorded.is_calm = calm == CALM_CHECKS

    def _take(self) -> None:
        """Take the present state for good, which a user may have written."""
        sim = self._sim
        if sim.guard.begin() and sim.safe_step is not None:
            sim.safe_step.take_given()

    def _go(self, most: int, end: float | None) -> bool:
        """Make steps until something is due, and do it; whether the end is reached."""
        sim = self._sim
        sim.recorded.adopt_positions()
        done = sim.steps
        most = min(most, self._until_due(done))
        reached = self._advance(done, most, end)
        sim.recorded.publish_positions()
        now = self._steps_made = sim.steps
        whole = now % self._check_steps == 0 or bool(self._returns)
        passed = self._check(now, whole)
        # Where short runs end does not count: the same run in one would take other steps.
        if whole or not passed:
            self._choose_intervals(checked=passed)
        if not passed:
            return False
        if sim.remeshing.is_due(now):
            sim.follow_motion()
            sim.guard.forget()
            self._take()
        if any(now % every == 0 for every in sim.hook_intervals) and sim.total_steps > self._steps_called:
            self._steps_called = sim.total_steps
            sim.call_hooks()
            sim.recorded.adopt_positions()
            self._take()
        return reached

    def _until_due(self, done: int) -> int:
        """Steps until a check, a pass or a hook is due."""
        sim = self._sim
        every = [self._check_steps, *sim.hook_intervals]
        if sim.remeshing.every:
            every.append(sim.remeshing.every)
        return min(n - done % n for n in every)

    @property
    def _check_steps(self) -> int:
        if self._returns:
            return self._sim.recorded.interval
        return self._check_intervals * self._sim.recorded.interval

    def _advance(self, done: int, most: int, end: float | None) -> bool:
        """Make at most so many steps; whether the end is reached."""
        sim = self._sim
        if sim.safe_step is None:
            sim.recorded.replay_many(most)
            return False
        self._resume()
        every, stop = sim.recorded.interval, done + most
        sure = 0
        while done < stop:
            phase = done % every
            count = min(stop - done, every - phase)
            if end is not None and phase == 0 and not sure:
                sure = self._sure_intervals(end - sim.time)
            if end is None or (phase == 0 and sure and count == every):
                self._measured(count, phase)
                sure = max(sure - 1, 0)
                done += count
                continue
            if phase == 0:
                self._resume()
                sim.recorded.replay(0, measured=True)
            count, reached = self._ending(count, end)
            done += count
            if reached:
                return True
        return False

    def _measured(self, count: int, phase: int) -> None:
        recorded = self._sim.recorded
        if phase == 0 and count == recorded.interval:
            recorded.replay(count, measured=True)
            return
        if phase == 0:
            recorded.replay(1, measured=True)
            count -= 1
        recorded.replay_many(count)

    def _ending(self, count: int, end: float) -> tuple[int, bool]:
        """Make steps that end in time: the last ones are as long as one another. Returns how many, and whether it is
        reached."""
        sim = self._sim
        assert sim.safe_step is not None
        left, dt = end - sim.time, sim.safe_step.allowed
        steps = max(math.ceil(left / dt * (1.0 - 1e-9)), 1)
        self._shortened = True
        sim.pace.set_step(left / steps if steps <= 2 * sim.recorded.interval else dt)
        count = min(count, steps)
        sim.recorded.replay_many(count)
        if count == steps:
            sim.pace.set_time(end)
        return count, count == steps

    def _sure_intervals(self, left: float) -> int:
        """Whole intervals after which there is still some time left, even if the step grows as fast as it may."""
        safe = self._sim.safe_step
        assert safe is not None
        interval, longest = self._sim.recorded.interval, safe.at_rest
        growth = float(GROWTH)
        dt = min(growth * safe.allowed, longest)
        count = 0
        left -= 2 * interval * dt
        while count < MOST_INTERVALS and left >= interval * dt:
            left -= interval * dt
            dt = min(growth * dt, longest)
            count += 1
        return count

    def _resume(self) -> None:
        """Take the step that the state allows again.

        Velocities shift neither here nor where the end of a run made the step shorter, so that the two cancel.
        """
        if self._shortened and self._sim.safe_step is not None:
            self._sim.safe_step.resume()
        self._shortened = False

    def _check(self, now: int, whole: bool) -> bool:
        """Check the state, elastic energies too if asked to; False if it was put back."""
        sim = self._sim
        strict = sim.safe_step is not None and self._returns < STRICT_RETURNS
        fault = sim.guard.check(whole=whole, strict=strict, lenient=sim.safe_step is not None)
        if fault is not None:
            self._go_back(fault)
            return False
        if self._returns and sim.time > self._wrong_until:
            self._returns = 0
        if whole and sim.safe_step is not None:
            self._follow_energy(now)
        return True

    def _follow_energy(self, now: int) -> None:
        """Make the step shorter where energy came from nowhere, and longer again where none did."""
        sim = self._sim
        assert sim.safe_step is not None
        share = self._share
        intervals = (now - self._followed) / sim.recorded.interval
        self._followed = now
        gain = GAIN * max(1.0 - sim.guard.surplus / MOST_SURPLUS, LEAST_LEAVE)
        late, more = sim.guard.untimely / SURPLUS, sim.guard.gain / gain
        if late > 1.0 or more > 1.0:
            least = min(share, RINGING)
            share *= max(1.0 / math.sqrt(max(more, 1.0)), 0.5)
            share = min(share, max(share / math.sqrt(max(late, 1.0)), least))
        elif sim.guard.surplus + sim.guard.untimely <= SURPLUS:
            share = min(share * RECOVERY**intervals, 1.0)
        if share != self._share:
            self._set_share(share)

    def _choose_intervals(self, *, checked: bool) -> None:
        """Look more often where a body is strained, less often where checks on elastic energies have found it calm."""
        sim = self._sim
        if sim.safe_step is None:
            return
        share, allowed, at_rest = sim.safe_step.shares
        before = sim.safe_step.schedule
        calm = min(before[0] + checked, CALM_CHECKS) if share == 1.0 and allowed >= CALM * at_rest else 0
        sim.recorded.is_calm = calm == CALM_CHECKS
        if share < 1.0:
            self._check_intervals = CLOSE_INTERVALS
        elif allowed < STRAINED * at_rest:
            quiet = max(sim.guard.gain / GAIN, sim.guard.untimely / SURPLUS) < QUIET
            self._check_intervals = STRAINED_INTERVALS if quiet else CLOSE_INTERVALS
        else:
            self._check_intervals = CHECK_INTERVALS
        if before != (chosen := (calm, self._check_intervals, self._followed)):
            sim.safe_step.schedule = chosen

    @property
    def _share(self) -> float:
        return 1.0 if self._sim.safe_step is None else self._sim.safe_step.share

    def _set_share(self, share: float) -> None:
        """Take another share of the step that the state allows from here on."""
        sim = self._sim
        assert sim.safe_step is not None
        sim.safe_step.share = max(share, float(LEAST))
        sim.recorded.retime()
        sim.guard.settle()

    def _go_back(self, fault: Fault) -> None:
        """Go on from the last good state with half the step.

        Raises:
            UnstableError: The step was given, or no shorter one helps.
        """
        sim = self._sim
        if sim.safe_step is None or self._returns >= MOST_RETURNS:
            self._returns = 0
            sim.guard.forget()
            raise UnstableError(self._message(fault))
        if not self._returns:
            self._wrong_until = sim.time
        self._returns += 1
        share = sim.safe_step.share
        sim.guard.go_back()
        self._followed = sim.steps
        self._set_share(0.5 * share)
        if not self._has_warned and not fault.is_slight:
            self._has_warned = True
            message = (
                f"the state went wrong by t = {self._wrong_until:.4g} s ({fault.what}); the simulation goes on from "
                f"t = {sim.time:.4g} s with half the step, and does the same without a word if that happens again"
            )
            warnings.warn(message, StabilityWarning, stacklevel=depth_of_user())

    def _message(self, fault: Fault) -> str:
        sim = self._sim
        more = f" and {len(fault.worlds) - 3} more" if len(fault.worlds) > 3 else ""
        where = f" in world {', '.join(map(str, fault.worlds[:3]))}{more}" if sim.worlds > 1 else ""
        if fault.step is None:
            when = f"at step {sim.steps} (t = {sim.time:.4g} s)"
        else:
            when = f"since step {fault.step} (t = {sim.pace.time_at(fault.step):.4g} s)"
        steps = f"dt is {sim.pace.dt:.3g} s, the largest stable step at rest about {sim.stable_dt:.3g} s"
        return f"{fault.what} {when}{where}; {steps}{self._advice()}"

    def _advice(self) -> str:
        sim = self._sim
        if any(getattr(model, "rotation_level", None) is not None for model in sim.models):
            return "; shared rotations have no energy, so that strong bending may need rotation_level=None"
        if any(isinstance(model, StVenantKirchhoff) for model in sim.models):
            return "; StVenantKirchhoff has no energy barrier against being crushed: take NeoHookean or Corotated"
        if sim.safe_step is None:
            return ": take a shorter step, or dt=None, which follows the state"
        return f"; {MOST_RETURNS} times half the step did not help: look for loads or motions that crush the body"
