"""Numbers that the simulation and the haptic loop exchange without waiting for each other."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.contact.obstacles import Obstacles
from warp_corot.kernels.haptics import publish as kernels
from warp_corot.kernels.stepping.work import separate_forces
from warp_corot.solvers.pace import Mapped
from warp_corot.solvers.system import Constraint, System

Floats = npt.NDArray[np.float64]

#: Readings after which the last state is kept: the simulation would have to publish between all of them.
TRIES = 8


@dataclass(frozen=True, eq=False)
class ToolState:
    """The published state of a tool.

    Attributes:
        count: Number of states published up to this one.
        time: Simulated time [s].
        stamp: When the position to which it moves was read from the device, on the loop's clock [s]; zero: never.
        position: [m], [3].
        quaternion: (x, y, z, w), [4].
        force, torque: On the tool in the last step [N], and about its origin [N m], [3] each.
    """

    count: int
    time: float
    stamp: float
    position: Floats
    quaternion: Floats
    force: Floats
    torque: Floats


class HapticExchange(Constraint):
    """Publishes a tool's state after each run of steps, and lets the tool follow the device.

    It is one of the system's constraints only so that it is launched with them; it exerts no force. On CUDA, kernels
    write to and read from pinned host memory; on the CPU both sides use the same arrays.

    Args:
        system: The simulation's system.
        obstacles: Its obstacles.
        number: The number of the tool among them.
    """

    launch_revision = 1
    state: dict[str, wp.array] = {}  # noqa: RUF012
    is_full = False

    def __init__(self, system: System, obstacles: Obstacles, number: int):
        self._system, self._obstacles, self._number = system, obstacles, number
        device = system.device
        for kernel in (kernels.write_slot, separate_forces):  # the loop's clock does not wait for a compiler
            wp.load_module(kernel.module, device)
        self._shared = Mapped(1 + 2 * int(kernels.SLOT), device)
        self._stamp = Mapped(1, device)
        self._count = wp.zeros(1, dtype=wp.int64, device=device)
        pinned = wp.zeros(7, dtype=wp.float32, device="cpu", pinned=device.is_cuda)
        self._pose_memory, self._pose = pinned, pinned.numpy()
        self._pose[6] = 1.0
        #: The target of the tool, a ``wp.transform`` for ``Tool.use_poses``.
        self.target = wp.array(ptr=pinned.ptr, shape=1, dtype=wp.transform, device=device)

    # --- the loop's side -------------------------------------------------------------------------------------------

    def send(self, position: Floats, quaternion: Floats, stamp: float) -> None:
        """Send the tool to a place [m] that was read from the device at a time on the loop's clock [s]."""
        self._pose[:3] = position
        self._pose[3:] = quaternion
        self._stamp.values[0] = stamp

    @property
    def place(self) -> Floats:
        """The place to which the tool was sent last: position and quaternion, [7]."""
        return self._pose.astype(np.float64)

    def newest(self, last: ToolState | None) -> ToolState | None:
        """The newest state, or the last one if nothing was published since; never a half-written one."""
        values = self._shared.values
        for _ in range(TRIES):
            count = int(values[0])
            if count == 0 or (last is not None and count == last.count):
                return last
            first = 1 + count % 2 * int(kernels.SLOT)
            slot = values[first : first + int(kernels.SLOT)].copy()
            if int(values[0]) == count:
                pose, wrench = int(kernels.POSE), int(kernels.WRENCH)
                parts = np.split(slot[pose:], [3, 7, wrench - pose + 3])
                return ToolState(count, float(slot[0]), float(slot[1]), *parts)
        return last

    # --- the simulation's side: only what is published counts -----------------------------------------------------

    def prepare(self) -> None:
        return

    def launch(self, offset: int, damping: float) -> None:
        return

    def grow(self) -> None:
        return

    def forget(self) -> None:
        return

    def measure(self) -> None:
        return

    def reset(self, chosen: wp.array) -> None:
        return

    def publish(self) -> None:
        obstacles, device = self._obstacles, self._system.device
        inputs = [self._number, obstacles.wrenches, obstacles.motions, self._system.pace.arrays]
        inputs += [self._stamp.array, self._count]
        wp.launch(kernels.write_slot, 1, inputs, [self._shared.array], device=device)
        wp.launch(kernels.count_slot, 1, [self._count, self._shared.array], device=device)
