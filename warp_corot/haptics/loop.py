"""The haptic loop: reads the device, sends the tool after it, and gives it a force, a thousand times a second."""

from __future__ import annotations

import gc
import logging
import math
import sys
import threading
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from warp_corot.contact.tool import Tool
from warp_corot.errors import InputError
from warp_corot.inputs.checks import checked_number, shown
from warp_corot.simulation.simulation import Simulation

from .devices import Device, DeviceError, Pose, checked_pose, way
from .exchange import HapticExchange, LocalModel, PassivityControl, ToolState

if TYPE_CHECKING:
    pass


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


#: Speed [m/s] and angular speed [rad/s] of a hand that the bound on energy assumes.
SPEED, TURN_RATE = 1.0, 10.0
#: Without a new state of the simulation, a force stays for this time and then fades in the same time [s].
PATIENCE = 0.25
#: Python threads yield to the loop's thread after this time [s].
SWITCH = 2e-4
#: Time between two publications of ``run`` [s].
EVERY = 0.002


class HapticLoop:
    """Connects a haptic device to a tool of a simulation, in its own thread.

    The loop reads the device, lets the tool follow it, and takes the newest published state of the tool without
    waiting. It writes the force of a local model (`LocalModel`), bounded in energy (`PassivityControl`). Meanwhile the
    caller steps the simulation, by ``run`` or by calls of ``sim.advance``. When the simulation stops, the force fades.

    Args:
        sim: The simulation, of one world, with the tool among its obstacles.
        tool: The tool in the hand. It follows the device at no more than ``Tool.speed``.
        device: The device.
        rate: Readings per second [1/s].
        stiffness: Expected stiffness of the tissue at the tool [N/m]; None: of a half-space of the first body's
            material under a flat punch as thick as the tool.
        most_force: Largest force [N]; larger ones are scaled down together with the torque.
        energy_bound: How much more energy may go out than came in [J], and in each second after [W]; see
            ``PassivityControl``.

    Attributes:
        error: The line on why the loop stopped, if the device failed; else None.

    Raises:
        InputError: An argument has another type, the tool belongs to another simulation, there are several worlds, or a
            number is out of its range.
    """

    def __init__(
        self,
        sim: Simulation,
        tool: Tool,
        device: Device,
        *,
        rate: float = 1000.0,
        stiffness: float | None = None,
        most_force: float = 10.0,
        energy_bound: float = 1e-3,
    ):
        if not isinstance(sim, Simulation) or not sim.ranks.is_alone:
            raise InputError(f"sim is {shown(sim)}; it must be a Simulation on one process")
        given = () if sim.contact is None else sim.contact.obstacles.given
        if not any(each is tool for each in given):
            raise InputError(f"tool is {shown(tool)}; it must be a Tool among the simulation's obstacles")
        if sim.worlds > 1:
            raise InputError(f"the simulation has {sim.worlds} worlds; it must have one")
        if not isinstance(device, Device):
            raise InputError(f"device is {shown(device)}; it must have the methods read() and write(force, torque)")
        self.period = 1.0 / _positive(rate, "rate", "1/s")
        self._most_force = _positive(most_force, "most_force", "N")
        bound, reach = _positive(energy_bound, "energy_bound", "J"), SPEED * self.period
        expected = stiffness
        if expected is None:  # Johnson, Contact Mechanics, 3.4
            material = sim.bodies[0].material.isotropic
            young, poisson = float(np.median(material.young)), float(np.median(material.poisson))
            expected = 2.0 * min(tool.shape.thickness, 0.01) * young / (1.0 - poisson**2)
        self._sim, self._tool, self._device = sim, tool, device
        self._model = LocalModel(_positive(expected, "stiffness", "N/m"), 2.0 * bound / reach**2)
        self._control = PassivityControl(bound, reach, TURN_RATE * self.period)
        assert sim.contact is not None
        self._exchange = HapticExchange(sim.system, sim.contact.obstacles, [each is tool for each in given].index(True))
        self._state: ToolState | None = None
        self._pose: Pose | None = None
        self._updated = self._last = math.nan
        self._periods, self._delays, self._busy = TimeSeries(), TimeSeries(), TimeSeries()
        self._missed = self._updates = 0
        self._is_to_stop = threading.Event()
        self._thread: threading.Thread | None = None
        self._froze = False
        self.error: str | None = None

    # --- running ---------------------------------------------------------------------------------------------------

    @property
    def is_running(self) -> bool:
        return self._thread is not None and self._thread.is_alive()

    def start(self) -> None:
        """Connect the tool to the device, and start the thread.

        Until ``stop``, Python's collector passes over all objects that exist now: a collection of them would hold up
        all threads for a quarter of a second.

        Raises:
            InputError: The loop was started before; make another one.
        """
        if self._thread is not None:
            raise InputError("the haptic loop was started before; make another one")
        self.connect()
        if not gc.get_freeze_count():
            gc.collect()
            gc.freeze()
            self._froze = True
        self._thread = threading.Thread(target=self._run, name="haptics", daemon=True)
        self._thread.start()

    def connect(self) -> None:
        """Let the simulation publish the tool's state, and the tool follow the device; ``start`` does so.

        Raises:
            InputError: Steps of the simulation are implicit.
        """
        if self._sim.system.is_implicit:
            raise InputError("steps of the simulation are implicit; a haptic loop needs SymplecticEuler")
        if self._exchange not in self._sim.system.constraints:
            self._exchange.send(self._tool.pose[:3], self._tool.pose[3:], 0.0)
            self._sim.system.constraints.append(self._exchange)
            self._tool.use_poses(self._exchange.target)

    def stop(self) -> None:
        """Stop the thread, leave the device without force, and the tool where it was sent last. May be called twice."""
        self._is_to_stop.set()
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join()
        if self._froze:
            gc.unfreeze()
            self._froze = False
        if self._exchange in self._sim.system.constraints:
            self._sim.system.constraints.remove(self._exchange)
            place = self._exchange.place
            self._tool.move(place[:3], place[3:])

    def __enter__(self) -> HapticLoop:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def run(self, seconds: float, every: float = EVERY) -> float:
        """Advance the simulation in real time, or as fast as it goes if that is slower.

        Args:
            seconds: Wall time [s] after the first state, for which kernels may have to be compiled.
            every: Simulated time between two states that the loop reads [s].

        Returns:
            Simulated time over wall time.

        Raises:
            InputError: A time is not positive.
            DeviceError: The device failed; the simulation can continue without it.
            UnstableError: As ``Simulation.advance``.
        """
        _positive(seconds, "seconds", "s")
        _positive(every, "every", "s")
        self._sim.advance(every)
        begun, simulated = time.perf_counter(), self._sim.total_time
        while (past := time.perf_counter() - begun) < seconds:
            if self.error is not None:
                raise DeviceError(self.error)
            ahead = self._sim.total_time - simulated - past
            if ahead > 0.0:
                time.sleep(min(ahead, seconds - past))
            else:
                self._sim.advance(every)
        return (self._sim.total_time - simulated) / (time.perf_counter() - begun)

    @property
    def report(self) -> Report:
        """The loop's times and energy so far."""
        periods, delays, control = self._periods, self._delays, self._control
        return Report(
            readings=self._busy.count,
            missed=self._missed,
            period=periods.share(50),
            period_99=periods.share(99),
            period_most=periods.largest,
            busy=self._busy.share(50),
            delay=delays.share(50),
            delay_99=delays.share(99),
            delay_most=delays.largest,
            updates=self._updates,
            put_out=control.most_put_out,
            damped=control.damped,
            beyond=control.beyond,
            stiffness=self._model.stiffness,
        )

    # --- one reading -----------------------------------------------------------------------------------------------

    def tick(self, now: float) -> None:
        """Read the device, send the tool after it, and write a force; the thread does so in each period.

        Args:
            now: The time on a clock that only goes forward [s].

        Raises:
            DeviceError: What the device read is not a position and an orientation.
        """
        position, quaternion = checked_pose(*self._device.read())
        self._exchange.send(position, quaternion, now)
        newest = self._exchange.newest(self._state)
        if newest is not None and newest is not self._state:
            self._state, self._updated = newest, now
            self._updates += 1
            if newest.stamp > 0.0:
                self._delays.add(now - newest.stamp)
            if np.isfinite(newest.force).all() and np.isfinite(newest.torque).all():
                self._model.follow(newest)
        moved, turned = (np.zeros(3), np.zeros(3)) if self._pose is None else way(self._pose, (position, quaternion))
        elapsed = 0.0 if math.isnan(self._last) else now - self._last
        self._control.observe(moved, turned, elapsed)
        # No larger than the device bears, fading if the simulation is silent.
        force, torque = self._model.forces(position)
        share = min(self._most_force / max(float(np.linalg.norm(force)), 1e-300), 1.0)
        silent = 0.0 if self._state is None else max(now - self._updated - PATIENCE, 0.0)
        share *= max(1.0 - silent / PATIENCE, 0.0)
        self._device.write(*self._control.control(share * force, share * torque, moved, turned))
        self._pose, self._last = (position, quaternion), now

    def _run(self) -> None:
        """The thread."""
        interval = sys.getswitchinterval()
        sys.setswitchinterval(min(interval, SWITCH))
        try:
            due = last = time.perf_counter()
            while not self._is_to_stop.is_set():
                started = time.perf_counter()
                if self._busy.count:
                    self._periods.add(started - last)
                last = started
                self.tick(started)
                ended = time.perf_counter()
                self._busy.add(ended - started)
                late = int((ended - due) / self.period)
                self._missed += late
                due += (late + 1) * self.period
                time.sleep(max(due - time.perf_counter(), 0.0))
        except Exception as error:
            words = " ".join(f"{type(error).__name__}: {error}".split())
            self.error = words if isinstance(error, DeviceError) else f"the haptic device failed: {words}"
            logging.getLogger(__name__).error("%s; the loop has stopped", self.error)
        finally:
            sys.setswitchinterval(interval)
            try:
                self._device.write(np.zeros(3), np.zeros(3))
            except Exception:
                logging.getLogger(__name__).debug("the device takes no last force", exc_info=True)


def _positive(given: float, name: str, unit: str) -> float:
    if not 0.0 < checked_number(given, name, unit) < math.inf:
        raise InputError(f"{name} is {given}; it must be a positive number [{unit}]")
    return float(given)
