"""The guard of a run: its state must be finite, within reach, and without energy from nowhere; and the last good state.

Every run of steps begins with ``launch_begin`` and ends with ``launch_end``, both recorded with the steps. The last
good state is the one at the end of the last run that ``check`` accepted, with what a user has written to it since.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.kernels.stepping.pace import LEAST

from .energy_balance import Balance, Copies, Energies, Floats
from .pace import CALM_CHECKS, LIVELY, UNKNOWN, Known
from .stability import FIRST_INTERVAL, SafeStep
from .system import NEVER, System

if TYPE_CHECKING:
    from .recorded import RecordedSteps

#: Energy that may come from nowhere between two checks, and in all, as shares of the most energy that gravity, loads
#: and supports ever moved or a user gave. The error of a stable step is less than a tenth, and up to a half while
#: elements are crushed and inverted. The error of an unstable step multiplies within tens of steps.
GAIN = 0.25
DRIFT = 0.5
#: By how much the kinetic energy may exceed the total, because the velocities of fast vibrations are half a step late;
#: and the excess above which elastic energies are checked.
MOTION = 0.5
LITTLE = 0.1
#: The share that is tolerated if the step can be made shorter.
STRICT = 0.02
#: Factor on what is tolerated if rotations are shared: their forces have no energy.
SHARED = 4.0
#: A body at rest that its weight and loads set in motion moves at least this many times the kinetic energy of half the
#: first step's velocity: four times at the longest stable step, and this much at half of it. Swinging bodies of few
#: nodes come back to where they began, where gravity and loads have moved nothing between two checks.
SET_IN_MOTION = 16.0
#: Beyond this many sizes of the body, displacements leave no digit of float32 for its strains.
REACH = 1e6


@dataclass(frozen=True)
class Fault:
    """A fault of a state.

    Attributes:
        what: The fault in words.
        worlds: The worlds that have it.
        step: The first step after which it was seen, if that is known.
        is_slight: Whether the state may still be roughly right.
        is_want_of_room: Whether the only fault is that forces were left out because an array was full.
    """

    what: str
    worlds: npt.NDArray[np.intp]
    step: int | None = None
    is_slight: bool = False
    is_want_of_room: bool = False


class Guard:
    """Checks states against the last good one, which it keeps on the device.

    Args:
        system: The simulation's system.
    """

    def __init__(self, system: System):
        self.system, self.bodies, self.worlds = system, system.bodies, system.worlds
        self._ranks = system.ranks
        bounds = (self._ranks.owned(body).bounds for body in system.bodies)
        self._size = max(float((high - low).max()) for low, high in bounds)
        self._copies = Copies(system)
        self._balance = Balance(system, self._copies)
        self._reference: Energies | None = None
        self._good: Known | None = None
        shared = any(getattr(field, "rotation_level", None) is not None for field in system.fields)
        self._leave = SHARED if shared else 1.0
        #: Energy from nowhere between the last two checks of elastic energies, and in all, as shares of the energy that
        #: was moved, of the world with the most; infinite until a check has found it.
        self.gain = self.surplus = np.inf
        #: Whether a user had written to the state before the last run that was checked.
        self.was_given = False
        self.restart()

    def restart(self) -> None:
        """Forget everything: the next state counts as good."""
        self._reference = None
        self._scale, self._drift, self._loads, self._height, self._loads_since = (
            np.zeros(self.worlds) for _ in range(5)
        )
        self._absolute_base = np.zeros(self.worlds)
        self._counted: Floats | None = None
        self._work = np.zeros(2)
        self.gain = self.surplus = np.inf
        self._floor: Floats | None = None

    def forget(self) -> None:
        """Let the next state count as good, because it does not follow from the last one."""
        self._reference = None

    # --- on the device ---------------------------------------------------------------------------------------------

    @property
    def revision(self) -> int:
        """Changes whenever recorded launches become invalid."""
        return self._copies.revision

    def prepare(self) -> None:
        """Update what launches use; not while they are recorded."""
        self.system.prepare()
        self._copies.prepare()
        self._balance.prepare()

    def order(self, end: float | None = None, stop: int = 0) -> None:
        """Set when the next run ends [s], if it has an end, and the steps done by then."""
        self.system.pace.order(end=end, stop=stop, slot=self._copies.slot)

    def launch_begin(self) -> None:
        """Launch the beginning of a run: a state that a user has written since the last one is a new state."""
        self.system.pace.launch_orders(self._copies.changed)
        self._copies.launch_take_over()

    def launch_end(self, *, whole: bool) -> None:
        """Launch the end of a run: keep the state beside the last good one, and report what ``check`` reads."""
        self._copies.launch_keep()
        self._balance.launch(whole=whole, keeps=True)

    @property
    def has_begun(self) -> bool:
        """Whether there is a good state with which others are compared."""
        return self._reference is not None

    # --- on the host -----------------------------------------------------------------------------------------------

    def begin(self) -> bool:
        """Accept the present state as good if no run has led to it; returns whether a user may have written to it."""
        given = False
        if self._reference is None:
            self.prepare()
            given = self._counted is None
            self._absolute_base = np.zeros(self.worlds)
            self.system.restart_work(None if self._counted is None else self._work)
            self._copies.take()
            self._begin_from(self._find(whole=True))
        self._good = self.system.pace.known
        return given

    def check(self, *, whole: bool, counts: bool = True, strict: bool = False, lenient: bool = False) -> Fault | None:
        """Check the state at the end of a run, and keep it if it is good. Waits for the device: once, if the state is
        good and no user wrote to it before the run.

        Args:
            strict: Whether to tolerate less energy from nowhere than an error would need.
            lenient: Whether to tolerate energy from nowhere since the beginning, because a shorter step will help.
            whole: Whether elastic energies were found, too. Without them, the sum of the others must not exceed what
                there was and what came in, because elastic energies are never negative.
            counts: Whether energies are counted from this state on, if they were found. Otherwise they only judge it.
        """
        found = self._balance.wait()
        self.was_given = found.has_changed
        full = any(each.is_full for each in self.system.constraints)
        if self.system.constraints and self._ranks.max(float(full)):
            return Fault("more contacts than there is room for", np.arange(self.worlds), is_want_of_room=True)
        if found.has_changed:
            self._begin_before()
        fault = self._not_finite(found.bad_step)
        if fault is not None:
            return fault
        # An extra check at the end of a short run must not make its state differ from that of one long run.
        leave = self._leave * (STRICT if strict and whole else 1.0)
        fault = self._beyond_reach(found) or self._from_nowhere(found, whole, leave, lenient)
        if fault is not None and not whole:
            whole, found = True, self._find(whole=True)
            fault = self._beyond_reach(found) or self._from_nowhere(found, whole, leave, lenient)
        if fault is None:
            self._copies.flip()
            self._count(found, whole=whole and counts)
        return fault

    def go_back(self) -> None:
        """Restore the last good state."""
        assert self._good is not None
        self._copies.put_back()
        self.system.pace.put_back(self._good)
        for body in self.bodies:
            body.state.forces.zero_()
            body.state.publish_positions()
        for each in self.system.constraints:
            each.forget()
        self.system.bad_step.fill_(NEVER)
        # Energy from nowhere before that state still counts.
        self._count(self._find(whole=True), whole=True)

    def settle(self) -> None:
        """Count from the present energies: the kinetic energy depends on the step, which has changed."""
        self._copies.take()
        self._reference = self._find(whole=True)

    def not_finite(self) -> Fault | None:
        """Whether the state is not finite: the cheapest check."""
        return self._not_finite(-self._ranks.max(-int(self.system.bad_step.numpy()[0])))

    def beyond_reach(self) -> Fault | None:
        """Whether nodes are beyond reach: the only check of a state that users may write to."""
        return self._beyond_reach(self._find(whole=False))

    @property
    def state(self) -> dict[str, Floats]:
        """What a run needs besides the present state to continue."""
        counted = np.full((7, self.worlds), np.nan) if self._counted is None else self._counted
        before = self._reference
        if before is not None and not self._has_changed():
            now = self._find(whole=False)
            # The accounts of constraints begin again at zero, the work of supports does not.
            supports = before.supports - now.worked
            counted[:6] = before.exact, before.gravitational, supports, self._loads_since, self._height, self._loads
            counted[6] = now.worked_absolute - self._absolute_base
        work = np.array(self.system.pace.known.work) if self._counted is None else self._work
        return {"scale": self._scale, "drift": self._drift, "counted": counted, "work": work}

    def resume(self, *, scale: Floats, drift: Floats, counted: Floats, work: Floats) -> None:
        """Continue from what ``state`` gave."""
        self._scale, self._drift = np.array(scale, float), np.array(drift, float)
        self.system.pace.forget()
        if np.isfinite(counted).all():
            self._counted, self._work = np.array(counted, float), np.array(work, float)

    # --- pieces ----------------------------------------------------------------------------------------------------

    def _begin_from(self, found: Energies) -> None:
        """Count from the energies of a given state."""
        if self._counted is not None:
            exact, gravitational, supports, self._loads_since, self._height, self._loads = self._counted[:6]
            self._absolute_base = -self._counted[6]
            found = replace(found, exact=exact, gravitational=gravitational, supports=supports)
        else:
            self._loads, self._height = np.zeros(self.worlds), found.gravitational
            self._loads_since = np.zeros(self.worlds)
            # The user may still correct a bad world.
            known = np.where(np.isfinite(found.exact), np.abs(found.exact), 0.0)
            swing = np.where(np.isfinite(found.untimely), SET_IN_MOTION * found.untimely, 0.0)
            self._scale = np.maximum(self._scale, np.maximum(known, swing))
        self._counted = None
        self._reference = found

    def _begin_before(self) -> None:
        """Count from the state at the beginning of the run, which a user wrote; waits for the device."""
        assert self._good is not None
        pace = self.system.pace
        # A user's velocities belong to the time of the displacements.
        self._good = replace(self._good, seconds=(*self._good.seconds[:2], 0.0))
        now = pace.known
        copies = self._copies
        found = self._find(whole=True, at=copies.good, seconds=self._good.seconds, accounts=copies.good_accounts)
        since = now.work[0] - self._good.work[0]
        self._absolute_base = found.supports_absolute - (now.work[1] - self._good.work[1])
        self._begin_from(replace(found, supports=found.supports - since))

    def _find(
        self,
        *,
        whole: bool,
        at: Sequence[tuple[wp.array, wp.array]] | None = None,
        seconds: Sequence[float] | None = None,
        accounts: Sequence[wp.array] | None = None,
    ) -> Energies:
        """The energies of the present state or another; waits for the device."""
        self.prepare()
        self.order()
        self.system.pace.launch_orders(self._copies.changed)
        self._balance.launch(whole=whole, at=at, seconds=seconds, accounts=accounts)
        return self._balance.wait()

    def _has_changed(self) -> bool:
        self.order()
        self.system.pace.launch_orders(self._copies.changed)
        self._copies.launch_take_over()
        changed = bool(self._copies.changed.numpy()[0])
        if changed:
            self.forget()
        return changed

    def _not_finite(self, step: int) -> Fault | None:
        if step == NEVER:
            return None
        # Reported once: after setting a good state again, a user may continue.
        self.system.bad_step.fill_(NEVER)
        bad = self._not_finite_worlds()
        # The user may have set a good state before the check.
        return Fault("the state is not finite", bad, step) if len(bad) else None

    def _not_finite_worlds(self) -> npt.NDArray[np.intp]:
        """The worlds in which something is not finite, as ``kernels.stepping.integrate.is_finite`` has it."""
        bad = np.zeros(self.worlds, bool)
        for body in self.bodies:
            sizes = np.abs(body.state.displacements.numpy().astype(np.float64)).sum(axis=1)
            bad |= ~(sizes.reshape(self.worlds, -1) <= 3e38).all(axis=1)
        return np.flatnonzero(self._ranks.max(bad))

    def _beyond_reach(self, found: Energies) -> Fault | None:
        bad = np.flatnonzero(~(found.reach <= REACH * self._size))
        if not len(bad):
            return None
        return Fault(f"nodes are {found.reach[bad].max():.3g} m from where they were at rest", bad)

    def _given(self, found: Energies) -> tuple[Floats, Floats, Floats]:
        """The expected energy, the most that was ever moved, and the work of loads since counting began [J]."""
        before = self._reference
        assert before is not None
        fallen = before.gravitational - found.gravitational
        loads = self._loads_since + found.loads
        given = before.exact + fallen + loads + found.supports - before.supports
        # Energy from nowhere does not raise the tolerance.
        moved = np.abs(self._height - found.gravitational) + np.abs(self._loads + loads)
        return given, np.maximum(self._scale, moved + found.supports_absolute - self._absolute_base), loads

    def _from_nowhere(self, found: Energies, whole: bool, leave: float, lenient: bool) -> Fault | None:
        if not self._balance.is_closed:
            return None
        floor = self._rounding()
        given, scale, _ = self._given(found)
        # Elastic energies are never negative.
        gain = found.kinetic - given
        bad = ~(gain <= (MOTION if whole else LITTLE) * self._leave * scale + floor)
        if whole:
            drift = np.maximum(self._drift + found.exact - given, 0.0)
            gain = np.maximum(np.maximum(gain, found.exact - given), drift)
            bad |= ~(found.exact - given <= GAIN * leave * scale + floor)
            if not lenient:
                bad |= ~(drift <= DRIFT * self._leave * scale + 10.0 * floor)
        if not bad.any():
            return None
        worlds = np.flatnonzero(bad)
        worst = worlds[np.argmax(gain[worlds])]
        most = f"gravity, loads and supports have moved {scale[worst]:.3g} J at most"
        is_slight = bool((gain[worlds] <= GAIN * self._leave * scale[worlds] + floor[worlds]).all())
        return Fault(f"{gain[worst]:.3g} J of energy came from nowhere ({most})", worlds, is_slight=is_slight)

    def _rounding(self) -> Floats:
        """Energies that rounding cannot tell from zero, for each world [J]; found once."""
        if self._floor is None:
            self._floor = self._balance.rounding()
        return self._floor

    def _count(self, found: Energies, *, whole: bool) -> None:
        """Continue from a good state, and from its total energies if these count."""
        given, self._scale, self._loads_since = self._given(found)
        before = self._reference
        assert before is not None
        if not whole:
            return
        if self._balance.is_closed:
            floor = self._rounding()
            self._drift = np.maximum(self._drift + found.exact - given, 0.0)
            known = 1.0 / np.maximum(self._scale, 1e-200) / self._leave
            self.gain = float(np.max(np.maximum(found.exact - given - floor, 0.0) * known))
            self.surplus = float(np.max(np.maximum(self._drift - 10.0 * floor, 0.0) * known))
        else:
            self.gain = self.surplus = 0.0
        self._loads, self._loads_since = self._loads + self._loads_since, np.zeros(self.worlds)
        self._reference = found


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
#: moved; beyond it the step becomes shorter. The more energy came in all, up to the second share, the less is
#: tolerated, down to ``LEAST_LEAVE`` times this.
LITTLE_GAIN, MOST_SURPLUS = 0.001, 0.008
LEAST_LEAVE = 0.2
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
        self._guard, self._recorded, self._safe_step, self._pace = guard, recorded, safe_step, guard.system.pace
        self._intervals = CHECK_INTERVALS if safe_step is None else CLOSE_INTERVALS
        recorded.calm = 0 if safe_step is None else UNKNOWN

    @property
    def check_steps(self) -> int:
        """Steps from one check with elastic energies to the next."""
        return self._intervals * self._recorded.interval

    def begin(self) -> None:
        """Continue with the schedule, which may come from a checkpoint."""
        if self._pace.schedule.intervals:
            self._choose()
        else:
            self.begin_anew()

    def go_on(self, steps: int) -> None:
        """Continue unchecked after a number of steps, without waiting for the device."""
        if steps >= CLOSE_INTERVALS * FIRST_INTERVAL and self._recorded.calm == UNKNOWN:
            self._recorded.calm = 0

    def begin_anew(self) -> None:
        """Begin again after a user has written to the state, which may now change fast."""
        self._choose(calm=UNKNOWN, intervals=CLOSE_INTERVALS)

    def follow(self, steps: int) -> None:
        """Make the step shorter if energy came from nowhere, and longer again if none did.

        Args:
            steps: Steps done at the check.
        """
        if self._safe_step is None:
            return
        guard, share = self._guard, self._safe_step.control.share
        intervals = (steps - self._pace.schedule.steps) / self._recorded.interval
        self._pace.schedule = self._pace.schedule._replace(steps=steps)
        more = guard.gain / (LITTLE_GAIN * max(1.0 - guard.surplus / MOST_SURPLUS, LEAST_LEAVE))
        share = share * max(1.0 / math.sqrt(more), 0.5) if more > 1.0 else min(share * RECOVERY**intervals, 1.0)
        if share != self._safe_step.control.share:
            self._take_share(share)

    def halve(self, steps: int) -> None:
        """Take half the share, after going back to the state with this number of steps."""
        assert self._safe_step is not None
        self._pace.schedule = self._pace.schedule._replace(steps=steps)
        self._take_share(0.5 * self._safe_step.control.share)

    def choose_intervals(self, *, checked: bool) -> None:
        """Check more often if a body is strained, and less often if checks of elastic energies found it calm."""
        if self._safe_step is None:
            return
        guard = self._guard
        allowed, share, at_rest, *_ = self._safe_step.control
        before = self._pace.schedule
        calm = 0
        if not checked or allowed < FALLING * before.allowed:
            calm = LIVELY
        elif share == 1.0 and allowed >= CALM * at_rest:
            calm = min(max(before.calm, 0) + 1, CALM_CHECKS)
        if share < 1.0 or calm == LIVELY:
            intervals = CLOSE_INTERVALS
        elif allowed < STRAINED * at_rest:
            intervals = STRAINED_INTERVALS if guard.gain < QUIET * LITTLE_GAIN else CLOSE_INTERVALS
        else:
            intervals = CHECK_INTERVALS if calm > 1 else STRAINED_INTERVALS
        self._choose(calm=calm, intervals=intervals, allowed=allowed)

    def _choose(self, **changes: Any) -> None:
        """Measure and check at the intervals of the schedule after these changes."""
        if self._safe_step is not None:
            self._pace.schedule = schedule = self._pace.schedule._replace(**changes)
            self._intervals, self._recorded.calm = schedule.intervals, schedule.calm

    def _take_share(self, share: float) -> None:
        """Set the share of the allowed step from here on."""
        assert self._safe_step is not None
        self._safe_step.take_share(max(share, float(LEAST)))
        self._guard.settle()
