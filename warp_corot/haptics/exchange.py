"""What the simulation and the haptic loop exchange without waiting for each other, and the force between two states.

The loop runs faster than the simulation, and the simulation's tool follows the hand with a delay. If the hand has moved
since, the force of the last state is extrapolated along the direction in which the tissue pushes, with the stiffness in
the last states: the contact's compliance as the tool sees it.

After Courtecuisse, Jung, Allard, Duriez, Lee and Cotin, GPU-based real-time soft tissue deformation with cutting and
haptic feedback (2010), where the compliance comes from the solver's matrix; explicit steps have none, so that it is
measured.

A force that is held from one reading to the next does work on the hand that is known exactly at the next reading: the
observer adds it up. The controller then gives the next force. It damps a force that would put out energy if the hand
continued its motion, and scales down a force that could put out more than there is in any motion of the hand.

After Hannaford and Ryu, Time-domain passivity control of haptic interfaces (2002), for observer and damping; the bound
for any motion is that of Kim and Ryu, Robustly stable haptic interaction control using an energy-bounding algorithm
(2010), with a budget.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.contact.obstacles import Obstacles
from warp_corot.kernels.haptics import publish as kernels
from warp_corot.kernels.stepping.balance import separate_forces
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

    def publish(self) -> None:
        obstacles, device = self._obstacles, self._system.device
        inputs = [self._number, obstacles.wrenches, obstacles.motions, self._system.pace.arrays]
        inputs += [self._stamp.array, self._count]
        wp.launch(kernels.write_slot, 1, inputs, [self._shared.array], device=device)
        wp.launch(kernels.count_slot, 1, [self._count, self._shared.array], device=device)


#: Weight of the older states in means over states.
MEMORY = 0.9
#: Depths that vary by less [m] say little about a stiffness.
SPREAD = 3e-5
#: Forces below this [N] count as zero.
NO_FORCE = 1e-9


class LocalModel:
    """The contact plane and the stiffness at a tool.

    Args:
        stiffness: The expected stiffness, before anything is measured [N/m].
        most: The largest stiffness that is used [N/m].

    Attributes:
        stiffness: The present estimate [N/m].
        normal: The direction in which the tissue pushes the tool, [3]; zero where nothing touches.
    """

    def __init__(self, stiffness: float, most: float):
        self._expected, self._most = min(stiffness, most), most
        self._force, self._torque = np.zeros(3), np.zeros(3)
        self._position = np.zeros(3)
        self.normal, self._origin = np.zeros(3), np.zeros(3)
        self.stiffness = self._expected
        #: Means over the last states, and their variance and covariance.
        self._depth = self._push = self._square = self._product = 0.0

    def follow(self, state: ToolState) -> None:
        """Take a new state of the simulation."""
        size = float(np.linalg.norm(state.force))
        self._position, self._force, self._torque = state.position, state.force, state.torque
        if size < NO_FORCE:
            self.normal, self.stiffness = np.zeros(3), self._expected
            self._depth = self._push = self._square = self._product = 0.0
            return
        normal = state.force / size
        touched = self.normal.any()
        if touched:
            normal = MEMORY * self.normal + (1.0 - MEMORY) * normal
            length = float(np.linalg.norm(normal))
            normal = normal / length if length > 0.1 else state.force / size
        else:
            self._origin = state.position.copy()
        self.normal = normal
        # The slope of force over depth in the last states, if the depths vary enough.
        depth, push = float((self._origin - state.position) @ normal), float(state.force @ normal)
        if not touched:
            self._depth, self._push = depth, push
            return
        new = 1.0 - MEMORY
        off_depth, off_push = depth - self._depth, push - self._push
        self._depth += new * off_depth
        self._push += new * off_push
        self._square = MEMORY * (self._square + new * off_depth * off_depth)
        self._product = MEMORY * (self._product + new * off_depth * off_push)
        found = (self._product + SPREAD**2 * self._expected) / (self._square + SPREAD**2)
        self.stiffness = float(np.clip(found, 0.0, self._most))

    def forces(self, position: Floats) -> tuple[Floats, Floats]:
        """Force [N] and torque [N m] on the tool in the hand at a position [m]; the tissue never pulls."""
        if not self.normal.any():
            return np.zeros(3), np.zeros(3)
        deeper = float((self._position - position) @ self.normal)
        push = float(self._force @ self.normal)
        continued = push + self.stiffness * deeper
        if continued <= 0.0 or push <= 0.0:
            return np.zeros(3), np.zeros(3)
        return self._force + self.stiffness * deeper * self.normal, self._torque * min(continued / push, 1.0)


class PassivityControl:
    """Bounds the energy that leaves through the device.

    At any time ``t`` [s] since the beginning, the energy put out is at most the energy put in plus
    ``bound * (1 + t)``, as long as the hand moves no farther than ``reach`` and turns no farther than ``turn`` from one
    reading to the next. Energy that has been put in counts until the force is zero.

    Args:
        bound: [J].
        reach: [m].
        turn: [rad].

    Attributes:
        balance: Energy put in minus energy put out, as the controller counts it [J]; never below ``-bound``.
        put_out: Energy put out minus energy put in since the beginning [J].
        most_put_out: The largest value of ``put_out`` [J].
        beyond: Readings between which the hand moved farther than ``reach`` or ``turn``.
        damped: Readings at which a force was changed.
    """

    def __init__(self, bound: float, reach: float, turn: float):
        self.bound, self._reach, self._turn = bound, reach, turn
        self.balance = self.put_out = self.most_put_out = 0.0
        self.beyond = self.damped = 0
        self._force, self._torque = np.zeros(3), np.zeros(3)

    def observe(self, moved: Floats, turned: Floats, seconds: float) -> None:
        """Count the work of the last force along the hand's motion [m] and rotation [rad] in some time."""
        work = float(self._force @ moved + self._torque @ turned)
        self.put_out += work
        self.most_put_out = max(self.most_put_out, self.put_out)
        if self.balance < 0.0:
            self.balance = min(self.balance + self.bound * seconds, 0.0)
        self.balance -= work
        self.beyond += int(moved @ moved > self._reach**2 or turned @ turned > self._turn**2)

    def control(self, force: Floats, torque: Floats, moved: Floats, turned: Floats) -> tuple[Floats, Floats]:
        """The force [N] and torque [N m] to be held until the next reading, from those of the model.

        Args:
            force, torque: The model's force and torque.
            moved, turned: The hand's motion since the last reading [m], [rad], which it is expected to repeat.
        """
        given = force, torque
        if not force.any() and not torque.any():
            self.balance = min(self.balance, 0.0)
        arm = (self._reach / self._turn) ** 2
        work, square = float(force @ moved + torque @ turned), float(moved @ moved + arm * (turned @ turned))
        free = max(self.balance, 0.0) + 0.25 * self.bound
        if work > free and square > 0.0:
            damping = (work - free) / square
            force, torque = force - damping * moved, torque - damping * arm * turned
        most = float(np.linalg.norm(force)) * self._reach + float(np.linalg.norm(torque)) * self._turn
        left = max(self.balance + self.bound, 0.0)
        if most > left:
            force, torque = force * (left / most), torque * (left / most)
        self.damped += int(force is not given[0])
        self._force, self._torque = force, torque
        return force, torque
