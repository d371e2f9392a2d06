"""Runs of a simulation: how many steps come before something else is due, the repair of a state that went wrong.

``Simulation.advance`` makes steps until a time. It makes them in runs, which end where a check, a hook or a pass of
remeshing is due. The host plans a run from the device's last report, launches it (``solvers.recorded``), and waits
once, for the report at its end (``solvers.guard``). Most calls of ``advance`` are one run.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from warp_corot.elasticity import StVenantKirchhoff
from warp_corot.errors import InputError, StabilityWarning, UnstableError, depth_of_user
from warp_corot.inputs.checks import checked_count, shown
from warp_corot.inputs.simulation_lock import SIMULATION_LOCK
from warp_corot.kernels.stepping.pace import GROWTH
from warp_corot.solvers.guard import EnergyControl, Fault
from warp_corot.solvers.pace import Schedule
from warp_corot.solvers.recorded import Segment

from .progress import bar_of

if TYPE_CHECKING:
    from warp_corot.solvers.pace import Pace, StepControl

    from .simulation import Simulation


class Stepped(Protocol):
    """The part of a simulation that a message reads."""

    worlds: int
    models: tuple[Any, ...]
    pace: Pace
    stable_dt: float
    safe_step: Any
    integrator: Any

    @property
    def steps(self) -> int: ...

    @property
    def time(self) -> float: ...


def fault_message(sim: Stepped, fault: Fault, returns: int) -> str:
    """What went wrong, when, and what would help; after the step was halved this many times."""
    more = f" and {len(fault.worlds) - 3} more" if len(fault.worlds) > 3 else ""
    where = f" in world {', '.join(map(str, fault.worlds[:3]))}{more}" if sim.worlds > 1 else ""
    if fault.step is None:
        when = f"at step {sim.steps} (t = {sim.time:.4g} s)"
    else:
        when = f"since step {fault.step} (t = {sim.pace.time_at(fault.step):.4g} s)"
    steps = f"dt is {sim.pace.dt:.3g} s"
    if math.isfinite(sim.stable_dt):
        steps += f", the largest stable step at rest about {sim.stable_dt:.3g} s"
    return f"{fault.what} {when}{where}; {steps}{_advice(sim, returns)}"


def _advice(sim: Stepped, returns: int) -> str:
    if any(getattr(model, "rotation_level", None) is not None for model in sim.models):
        return "; shared rotations have no energy, so that strong bending may need rotation_level=None"
    if any(isinstance(model, StVenantKirchhoff) for model in sim.models):
        return "; StVenantKirchhoff has no energy barrier against being crushed: take NeoHookean or Corotated"
    if sim.integrator.is_implicit:
        return ": take a shorter step, or a tolerance, so that steps are solved by more than one iteration"
    if sim.safe_step is None:
        return ": take a shorter step, or dt=None, which follows the state"
    return f"; {returns} times half the step did not help: look for loads or motions that crush the body"


#: A hook that advances the simulation is called within its own call, at most this often.
MOST_NESTED = 50


@dataclass(frozen=True)
class _Hook:
    callback: Callable[[Any], None]
    every: int


class Hooks:
    """The functions and the numbers of steps between their calls."""

    def __init__(self) -> None:
        self._hooks: list[_Hook] = []
        self._nested = 0

    @property
    def intervals(self) -> list[int]:
        """Steps between the calls of each function."""
        return [hook.every for hook in self._hooks]

    def add(self, callback: Callable[[Any], None], every: int) -> None:
        """Call a function after every ``every``-th step.

        Raises:
            InputError: ``every`` is not a positive whole number, or the callback is not callable.
        """
        if not callable(callback):
            raise InputError(f"callback is {shown(callback)}; it must be a function of the simulation")
        self._hooks.append(_Hook(callback, checked_count(every, "every", least=1)))

    def call(self, sim: Any) -> None:
        """Call the functions that are due now, with the simulation.

        Raises:
            InputError: A function advances the simulation, which calls it again, without end.
        """
        steps = sim.steps if self._hooks else 0
        for hook in tuple(self._hooks):
            if steps % hook.every == 0:
                self._call(hook.callback, sim)

    def _call(self, callback: Callable[[Any], None], sim: Any) -> None:
        if self._nested >= MOST_NESTED:
            name = getattr(callback, "__qualname__", shown(callback))
            raise InputError(
                f"the hook {name} advances the simulation, which calls it again and again; "
                "let it return, and advance the simulation outside"
            )
        self._nested += 1
        try:
            callback(sim)
        finally:
            self._nested -= 1


#: How often the step is halved to get past one time.
MOST_RETURNS = 6
#: How often it is halved because of a little energy from nowhere, which crushed elements make at any step.
STRICT_RETURNS = 4
#: Single steps between two checks of the nodes' positions.
LOOK_STEPS = 256
#: After this many steps, elastic energies are checked at the end of a run; they cost as much as some steps. Bodies that
#: are not calm are checked sooner.
JUDGED_STEPS = 64
JUDGED_STRAINED = 16
#: Longer runs are divided.
MOST_INTERVALS = 1000
#: A step below this share of the longest may have grown after some measurements.
GROWN = 0.98
#: A measurement is expected to reduce the step of a strained body to this share. A body counts as strained below this
#: share of the longest step.
SHRINKING = 0.95


class Running:
    """Makes the steps of a simulation.

    Args:
        sim: The simulation.
    """

    def __init__(self, sim: Simulation):
        self._sim = sim
        self._energies = EnergyControl(sim.guard, sim.recorded, sim.safe_step)
        self._returns = 0
        #: The time at which the state was found to be wrong, until steps have passed it.
        self._wrong_until = -math.inf
        self._has_warned = False
        self._steps_called = 0
        #: Whether the last run may have ended with shorter steps than the state allows.
        self._shortened = True
        self._steps_made = 0
        #: Steps done at the last check of elastic energies.
        self._judged = 0

    def step(self) -> None:
        """Make one step, after a measurement if one is due."""
        sim = self._sim
        position = sim.steps if sim.device.is_cpu else self._steps_made
        self._steps_made = position + 1
        recorded = sim.recorded
        self._energies.go_on(position)
        segment = Segment(1, adopts=True, publishes=True)
        if sim.safe_step is not None:
            measured = 0 if position % recorded.interval else recorded.interval
            segment = replace(segment, resumes=self._shortened, measured=measured)
            self._shortened = False
        recorded.replay(segment)

    @property
    def state(self) -> dict[str, float]:
        """What a run needs besides the guard's state to continue."""
        until = self._wrong_until if self._returns else 0.0
        schedule = self._sim.pace.schedule._asdict()
        return {"returns": self._returns, "wrong_until": until, "judged": self._judged} | schedule

    def resume(self, *, returns: float, wrong_until: float, judged: float, **schedule: Any) -> None:
        """Continue from what ``state`` gave."""
        self._returns, self._wrong_until, self._judged = int(returns), float(wrong_until), int(judged)
        self._sim.pace.schedule = Schedule(
            **{name: type(of)(schedule[name]) for name, of in Schedule()._asdict().items()}
        )

    def begin_again(self) -> None:
        """Go on with other launches and another guard, at the same time."""
        sim = self._sim
        self._energies = EnergyControl(sim.guard, sim.recorded, sim.safe_step)
        self._energies.begin()

    def make(self, count: int) -> None:
        """Make a number of steps, with hooks and passes."""
        sim = self._sim
        end = sim.total_steps + count
        self._energies.begin()
        with self._bar(count, "steps") as show:
            while (left := end - sim.total_steps) > 0:
                self._run(left, None)
                show(count - (end - sim.total_steps))

    def make_until(self, total_time: float) -> None:
        """Make steps until exactly a time [s]; only if the simulation chooses the step."""
        sim = self._sim
        self._energies.begin()
        start = sim.total_time
        with self._bar(total_time - start, "s") as show:
            while sim.total_time < total_time:
                if self._run(MOST_INTERVALS * sim.recorded.interval, total_time - sim.time_before_reset):
                    break
                show(sim.total_time - start)

    def _bar(self, total: float, unit: str) -> AbstractContextManager[Callable[[float], None]]:
        """A bar for long waits; none where hooks may print lines of their own."""
        silent = self._sim.hooks.intervals or not self._sim.is_root
        return nullcontext(lambda _: None) if silent else bar_of(total, unit)

    def look(self) -> None:
        """Check that the state is finite and, every few hundred steps, that nodes are within reach.

        Raises:
            UnstableError: It is not, or they are not.
        """
        sim = self._sim
        fault = sim.guard.not_finite()
        if fault is None and sim.steps % LOOK_STEPS == 0:
            fault = sim.guard.beyond_reach()
        if fault is not None:
            raise UnstableError(fault_message(sim, fault, MOST_RETURNS))

    # --- one run ---------------------------------------------------------------------------------------------------

    def _run(self, most: int, end: float | None) -> bool:
        """Make steps until something is due, and do that; returns whether the end is reached."""
        sim = self._sim
        with SIMULATION_LOCK:
            reached, now = self._run_alone(most, end)
        SIMULATION_LOCK.pass_on()
        if reached is None:
            return False
        if any(now % every == 0 for every in sim.hooks.intervals) and sim.total_steps > self._steps_called:
            self._steps_called = sim.total_steps
            sim.hooks.call(sim)
        return reached

    def _run_alone(self, most: int, end: float | None) -> tuple[bool | None, int]:
        """``_run`` without hooks: whether the end is reached, None if the state went wrong; and the steps done."""
        sim = self._sim
        if not sim.guard.has_begun and sim.contact is not None:
            sim.contact.check_start()
        if sim.guard.begin() and sim.safe_step is not None:
            sim.pace.take_given()
        done = sim.steps
        segments, stop = self._plan(done, min(most, self._until_due(done)), end)
        now = self._steps_made = done + sum(segment.count for segment in segments)
        whole = now % self._check_steps == 0 or bool(self._returns)
        judged = whole or self._is_to_be_judged(now)
        sim.guard.order(end, stop)
        for number, segment in enumerate(segments):
            last = number == len(segments) - 1
            sim.recorded.replay(segment.placed(begins=number == 0, ends=last, whole=last and judged))
        passed = self._check(now, whole, judged)
        self._judged = sim.steps if judged or now < self._judged else self._judged
        if sim.guard.was_given:
            self._energies.begin_anew()
        # The ends of short runs do not count: one long run over the same time would take other steps.
        if whole or not passed:
            self._energies.choose_intervals(checked=passed)
        if not passed:
            return None, now
        reached = end is not None and sim.time >= end
        if any(now % every == 0 for every in sim.changes_every) and sim.follow_motion():
            sim.guard.forget()
        return reached, now

    def _is_to_be_judged(self, steps: int) -> bool:
        """Whether to check elastic energies after these steps, only to see whether the state is good."""
        sim = self._sim
        if sim.safe_step is None:
            return False
        return steps - self._judged >= (JUDGED_STEPS if sim.recorded.calm > 0 else JUDGED_STRAINED)

    def _until_due(self, done: int) -> int:
        """Steps until a check, a pass or a hook is due."""
        sim = self._sim
        every = [self._check_steps, *sim.hooks.intervals, *sim.changes_every]
        return min(n - done % n for n in every)

    @property
    def _check_steps(self) -> int:
        return self._sim.recorded.interval if self._returns else self._energies.check_steps

    @property
    def _control(self) -> StepControl:
        assert self._sim.safe_step is not None
        return self._sim.safe_step.control

    # --- what a run is to be ---------------------------------------------------------------------------------------

    def _plan(self, done: int, most: int, end: float | None) -> tuple[list[Segment], int]:
        """Plan a run of at most ``most`` steps; return its segments, and the total number of steps at ``end`` if the
        run gets there, else 0.

        The number of the last steps before ``end`` follows from the step that the device last reported. If a
        measurement within the run allows longer steps, they stay shorter; if it allows only shorter ones, the run ends
        before ``end``, and another one follows.
        """
        sim = self._sim
        if sim.safe_step is None:
            return [Segment(most)], 0
        every, last = sim.recorded.interval, done + most
        left = math.inf if end is None else end - sim.time
        shortened, self._shortened = sim.safe_step.is_shortened, True
        segments: list[Segment] = []
        sure = stop = 0
        while done < last:
            phase = done % every
            if phase == 0 and not sure and not stop:
                if any(segment.measured for segment in segments) and self._may_have_grown():
                    break
                sure = self._sure_intervals(left)
            if not stop and not (sure and phase == 0):
                needed = self._steps_for(left, -done % every)
                stop = done + int(needed) if needed <= 2 * every else 0
            count = min(last - done, every - phase, stop - done if stop else every)
            measured = 0 if phase else every
            resumes = shortened and (measured > 0 or not stop)
            segments.append(Segment(count, resumes=resumes, measured=measured, fits=stop > 0))
            shortened = stop > 0
            done += count
            left -= count * sim.safe_step.control.dt
            sure = max(sure - (phase == 0), 0)
            if done == stop:
                break
        return segments, stop

    def _steps_for(self, left: float, before: int) -> float:
        """An estimate of the number of steps in the remaining time [s]; after ``before`` of them the step is measured
        again."""
        if math.isinf(left):
            return math.inf
        control = self._control
        allowed = control.dt
        expected = allowed * (SHRINKING if allowed < SHRINKING * control.at_rest else 1.0)
        steps = _steps(left, allowed)
        return steps if steps <= before else before + _steps(left - before * allowed, expected)

    def _sure_intervals(self, left: float) -> int:
        """Whole intervals after which some time is left, even if the step grows as fast as it can."""
        if math.isinf(left):
            return MOST_INTERVALS
        control = self._control
        interval, longest = self._sim.recorded.interval, control.at_rest
        growth = float(GROWTH)
        dt = min(growth * control.dt, longest)
        count = 0
        left -= 2 * interval * dt
        while count < MOST_INTERVALS and left >= interval * dt:
            left -= interval * dt
            dt = min(growth * dt, longest)
            count += 1
        return count

    def _may_have_grown(self) -> bool:
        """Whether steps may have become much longer since the device's last report, so that fewer are enough."""
        return self._control.dt < GROWN * self._control.at_rest

    # --- after a run -----------------------------------------------------------------------------------------------

    def _check(self, now: int, whole: bool, judged: bool) -> bool:
        """Check the state; return False if it was put back.

        Args:
            now: Steps done.
            whole: Whether energies are counted from this state on.
            judged: Whether elastic energies were found, so that the state is checked by them, too.
        """
        sim = self._sim
        strict = sim.safe_step is not None and self._returns < STRICT_RETURNS
        fault = sim.guard.check(whole=judged, counts=whole, strict=strict, lenient=sim.safe_step is not None)
        if fault is not None:
            self._go_back(fault)
            return False
        sim.stepper.recover()
        if self._returns and sim.time > self._wrong_until:
            self._returns = 0
        if whole:
            self._energies.follow(now)
            if sim.contact is not None:
                sim.contact.look()
        return True

    def _go_back(self, fault: Fault) -> None:
        """Continue from the last good state with half the step.

        Raises:
            UnstableError: The user gave the step, or no shorter one helps.
        """
        sim = self._sim
        restores = sim.integrator.is_implicit or fault.is_want_of_room
        if fault.is_want_of_room:
            too_far = self._grow()
            if too_far is None:
                sim.guard.go_back()
                return
            fault = too_far
        elif sim.stepper.fall_back():
            wrong = sim.time
            sim.guard.go_back()
            self._warn(fault, wrong, "steps of backward Euler")
            return
        if sim.safe_step is None or self._returns >= MOST_RETURNS:
            self._returns = 0
            message = fault_message(sim, fault, MOST_RETURNS)
            if restores:
                sim.guard.go_back()
                message += f"; the state is that of t = {sim.time:.4g} s again"
            sim.guard.forget()
            raise UnstableError(message)
        if not self._returns:
            self._wrong_until = sim.time
        self._returns += 1
        sim.guard.go_back()
        self._energies.halve(sim.steps)
        self._warn(fault, self._wrong_until, "half the step")

    def _warn(self, fault: Fault, wrong: float, how: str) -> None:
        """Warn once that the simulation has gone back from a time [s]."""
        if not self._has_warned and not fault.is_slight:
            self._has_warned = True
            message = (
                f"the state went wrong by t = {wrong:.4g} s ({fault.what}); the simulation continues from "
                f"t = {self._sim.time:.4g} s with {how}, and will do so again without a warning"
            )
            warnings.warn(message, StabilityWarning, stacklevel=depth_of_user())

    def _grow(self) -> Fault | None:
        """Make the room that the last run needed; the fault if no room is enough for the motion in its steps."""
        said = ""
        for constraint in self._sim.system.constraints:
            try:
                constraint.grow()
            except UnstableError as error:
                said = str(error)
        if not self._sim.ranks.max(float(bool(said))):
            return None
        return Fault(said or "surfaces of another rank go too far in one step", np.arange(self._sim.worlds))


def _steps(seconds: float, dt: float) -> int:
    """The number of equal steps in some time [s], each as long as ``dt`` [s] or a little shorter."""
    return max(math.ceil(seconds / dt * (1.0 - 1e-9)), 1)
