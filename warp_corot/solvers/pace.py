"""The clock of a simulation, seen from the host."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.kernels.stepping import balance
from warp_corot.kernels.stepping import pace as kernels


class Mapped:
    """float64 numbers in memory that host and device share.

    The host sees what a kernel wrote once the stream has finished it. Few threads should use this memory.

    Args:
        count: Number of values.
        device: The device.

    Attributes:
        values: For the host, float64 [count].
        array: For kernels, float64 [count].
    """

    def __init__(self, count: int, device: wp.Device):
        self._memory = wp.zeros(count, dtype=wp.float64, device="cpu", pinned=device.is_cuda)
        self.values: npt.NDArray[np.float64] = self._memory.numpy()
        self.array = self._memory
        if device.is_cuda:
            # The same memory: pinned memory has one address on host and device.
            self.array = wp.array(ptr=self._memory.ptr, shape=count, dtype=wp.float64, device=device)


#: In place of a number of calm checks: some bodies change fast; there was no check yet.
LIVELY, UNKNOWN = -1, -2
#: After this many calm checks in a row, measurements are half as frequent.
CALM_CHECKS = 2


class Schedule(NamedTuple):
    """When energies are checked, and the result of the last check.

    Attributes:
        calm: How many checks in a row found the bodies calm, or LIVELY or UNKNOWN.
        intervals: Measurements between two checks; zero if not chosen yet.
        steps: Steps done at the last check.
        allowed: The step that the state allowed then [s].
    """

    calm: int = 0
    intervals: int = 0
    steps: int = 0
    allowed: float = 0.0


class StepControl(NamedTuple):
    """The numbers that set the length of steps, if none was given [s]; see ``kernels.stepping.pace``.

    Attributes:
        allowed, share: The step that the state allows, and the share of it that is taken.
        at_rest: The longest step: that of the bodies at rest.
        shortest, longest: The shortest and the longest step so far.
    """

    allowed: float = 0.0
    share: float = 0.0
    at_rest: float = 0.0
    shortest: float = 0.0
    longest: float = 0.0

    @property
    def dt(self) -> float:
        """The step, except where the end of a run shortens it."""
        return self.share * self.allowed


@dataclass(frozen=True)
class Known:
    """What the host knows of the clock.

    Attributes:
        counts, seconds, control, work: The values of the arrays of ``Pace``.
    """

    counts: tuple[int, int]
    seconds: tuple[float, float, float]
    control: StepControl
    work: tuple[float, float]


class Pace:
    """Steps done, their length and the time now, kept on the device.

    The host knows the device's last report, and reads the device only if something was launched since then.

    Args:
        dt: Length of a step [s].
        device: The device.

    Attributes:
        arrays: The arguments of kernels.
        control: Numbers that set the length of steps, if none was given; see ``kernels.stepping.pace``.
        support_work: Work of moving supports, and the sum of its absolute values [J], float64 [2].
        orders: The host's orders for the present run, float64 [ORDERS].
        schedule: When energies are checked.
        is_shared: Whether users may launch steps that they have recorded, without the host's knowledge.
    """

    def __init__(self, dt: float, device: wp.Device):
        self.device = device
        self.arrays = kernels.Pace()
        self.arrays.counts = wp.zeros(2, dtype=wp.int64, device=device)
        self.arrays.seconds = wp.array([dt, 0.0, 0.0], dtype=wp.float64, device=device)
        self.control = wp.zeros(kernels.CONTROLS, dtype=wp.float64, device=device)
        self.support_work = wp.zeros(2, dtype=wp.float64, device=device)
        self.orders = wp.zeros(kernels.ORDERS, dtype=wp.float64, device=device)
        self._given = Mapped(kernels.ORDERS, device)
        self.schedule = Schedule()
        self.is_shared = False
        self._known: Known | None = None

    @property
    def known(self) -> Known:
        """The clock; waits for the device if something has been launched since the last report."""
        if self._known is None or self.is_shared:
            counts, seconds, work = (
                tuple(array.numpy().tolist()) for array in (self.arrays.counts, self.arrays.seconds, self.support_work)
            )
            self._known = Known(counts, seconds, StepControl(*self.control.numpy().tolist()), work)
        return self._known

    def saw(self, numbers: npt.NDArray[np.float64]) -> None:
        """Take over the report of ``kernels.stepping.balance.report``."""
        steps, then, dt, time, before, work, absolute = numbers[: int(balance.WORK_ABSOLUTE) + 1].tolist()
        control = StepControl(*numbers[int(balance.CONTROL) :].tolist())
        self._known = Known((int(steps), int(then)), (dt, time, before), control, (work, absolute))

    def take_given(self) -> None:
        """Note that a user gave the velocities, so that they belong to the time of the displacements."""
        known = self.known
        self.arrays.seconds[int(kernels.BEFORE) : int(kernels.BEFORE) + 1].fill_(0.0)
        self._known = replace(known, seconds=(*known.seconds[:2], 0.0))

    def forget(self) -> None:
        """Note a launch that changes the clock without a report."""
        self._known = None

    def put_back(self, known: Known) -> None:
        """Restore an earlier clock."""
        self.arrays.counts.assign(np.array(known.counts, np.int64))
        self.arrays.seconds.assign(np.array(known.seconds))
        self.control.assign(np.array(known.control))
        self.support_work.assign(np.array(known.work))
        self._known = known

    def write_control(self, control: StepControl) -> None:
        """Write ``control``."""
        self.control.assign(np.array(control))
        self._known = replace(self.known, control=control)

    def order(self, *, end: float | None, stop: int, slot: int) -> None:
        """Write the orders for the next run, which begins with ``launch_orders``; no other run may be under way.

        Args:
            end: When it ends [s], if it has an end.
            stop: The steps done by then.
            slot: The copy of the state that is the last good one.
        """
        self._given.values[:] = kernels.NEVER if end is None else end, stop, slot

    def launch_orders(self, changed: wp.array) -> None:
        """Launch the copy of the orders to the device."""
        wp.launch(kernels.take_orders, dim=1, inputs=[self._given.array, self.orders, changed], device=self.device)

    @property
    def steps(self) -> int:
        """Steps done."""
        return self.known.counts[0]

    @property
    def dt(self) -> float:
        """The length of the next step [s]."""
        return self.known.seconds[0]

    @property
    def time(self) -> float:
        """The time now [s]."""
        return self.time_at(self.steps)

    def time_at(self, steps: int) -> float:
        """The time after a total number of steps, if their length has not changed since the last report [s]."""
        dt, then, _ = self.known.seconds
        return then + (steps - self.known.counts[1]) * dt

    def restart(self) -> None:
        """Begin again at time and step zero; the length of a step stays."""
        self.arrays.counts.zero_()
        wp.launch(kernels.set_time, dim=1, inputs=[wp.float64(0.0), self.arrays], device=self.device)
        self.forget()

    def restart_work(self, work: npt.NDArray[np.float64] | None = None) -> None:
        """Count the work of supports from here on, or on from what was counted before."""
        done = np.zeros(2) if work is None else work
        self.support_work.assign(done)
        if self._known is not None:
            self._known = replace(self._known, work=(float(done[0]), float(done[1])))

    def advance(self, steps: int) -> None:
        """Launch the advance of the clock by a number of steps."""
        wp.launch(kernels.advance_clock, dim=1, inputs=[steps, self.arrays], device=self.device)

    @property
    def state(self) -> dict[str, wp.array]:
        """Arrays from which the clock continues."""
        return {"counts": self.arrays.counts, "seconds": self.arrays.seconds}
