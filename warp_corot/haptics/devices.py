"""The interface of a haptic device's driver, two devices without hardware, and checks of their readings."""

from __future__ import annotations

import math
import time
from array import array
from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Any, Protocol, runtime_checkable

import numpy as np
import numpy.typing as npt

from warp_corot.contact.shapes import NO_TURN, checked_quaternion, checked_vector
from warp_corot.contact.tool import checked_keys
from warp_corot.errors import InputError
from warp_corot.inputs.checks import shown

Floats = npt.NDArray[np.float64]
Pose = tuple[Floats, Floats]


class DeviceError(RuntimeError):
    """The haptic device failed, and the loop has stopped; one line says how."""


def checked_pose(position: Any, quaternion: Any) -> Pose:
    """A position [m], [3], and a unit quaternion (x, y, z, w), [4].

    Raises:
        DeviceError: The reading is something else.
    """
    try:
        return checked_vector(position, "position"), checked_quaternion(quaternion)
    except (InputError, TypeError, ValueError):
        raise DeviceError(
            f"the haptic device read {shown(position)} and {shown(quaternion)}; it must read three finite numbers and "
            "a quaternion"
        ) from None


def way(before: Pose, now: Pose) -> tuple[Floats, Floats]:
    """How far something has moved [m] and turned [rad] from one pose to another, [3] each."""
    (p, b), (position, q) = before, now
    # The imaginary part of the present quaternion times the conjugate of the one before.
    axis = b[3] * q[:3] - q[3] * b[:3] - np.cross(q[:3], b[:3])
    real, sine = float(q @ b), float(np.linalg.norm(axis))
    angle = 2.0 * math.atan2(sine, abs(real))
    turned = axis * (math.copysign(angle, real) / sine) if sine > 1e-12 else np.zeros(3)
    return position - p, turned


Vector = Sequence[float] | npt.NDArray[np.floating]
#: Numbers of a record: a time, a position, a force and a torque.
RECORDED = 10


@runtime_checkable
class Device(Protocol):
    """A haptic device, in the coordinates of the simulation.

    A loop calls both methods from its own thread, at its rate. Any exception in them ends the loop.
    """

    def read(self) -> tuple[Vector, Vector]:
        """Position [m], [3], and orientation as a quaternion (x, y, z, w), [4], of the tool in the hand."""
        ...

    def write(self, force: Floats, torque: Floats) -> None:
        """Push the hand with this force [N], [3], and torque [N m], [3], until the next call."""
        ...


class ScriptedDevice:
    """A device that a script moves along keyframes, in straight lines, and that records its forces.

    Args:
        times: Increasing, at least two, from the first reading on [s], [K].
        positions: [m], [K, 3].
        quaternions: (x, y, z, w), [K, 4]; None: no rotation.
        clock: A function that returns the seconds of a clock.

    Raises:
        InputError: As ``Tool.follow``.
    """

    def __init__(
        self,
        times: npt.ArrayLike,
        positions: npt.ArrayLike,
        quaternions: npt.ArrayLike | None = None,
        *,
        clock: Callable[[], float] = time.perf_counter,
    ):
        self._times, self._poses = checked_keys(times, positions, NO_TURN if quaternions is None else quaternions)
        for before, after in pairwise(self._poses[:, 3:]):
            after *= 1.0 if before @ after >= 0.0 else -1.0
        self._clock, self._start = clock, math.nan
        self._now, self._place = 0.0, self._poses[0]
        # Not a list of tuples: Python's collector would look through all of them, for longer and longer.
        self._felt = array("d")

    @property
    def felt(self) -> Floats:
        """The record so far: time [s], position [m], force [N] and torque [N m], float64 [readings, 10]."""
        # At once, since the loop's thread may be adding to it.
        found = np.frombuffer(self._felt.tobytes())
        return found[: len(found) // RECORDED * RECORDED].reshape(-1, RECORDED)

    def read(self) -> tuple[Floats, Floats]:
        now = self._clock()
        if math.isnan(self._start):
            self._start = now
        self._now = now - self._start
        k = int(np.clip(np.searchsorted(self._times, self._now), 1, len(self._times) - 1))
        begun = (self._now - self._times[k - 1]) / (self._times[k] - self._times[k - 1])
        share = min(max(begun, 0.0), 1.0)
        self._place = (1.0 - share) * self._poses[k - 1] + share * self._poses[k]
        return self._place[:3], self._place[3:] / np.linalg.norm(self._place[3:])

    def write(self, force: Floats, torque: Floats) -> None:
        self._felt.extend((self._now, *self._place[:3].tolist(), *map(float, force), *map(float, torque)))


class MouseDevice:
    """A device that takes its position from a caller in any thread, such as a page or a window, and shows the force.

    Args:
        position: Its first position [m].
        quaternion: Its first orientation, (x, y, z, w).

    Attributes:
        force, torque: The last force and torque [N], [N m].

    Raises:
        InputError: A number is not finite.
    """

    def __init__(self, position: Vector = (0.0, 0.0, 0.0), quaternion: Vector = NO_TURN):
        self.force, self.torque = np.zeros(3), np.zeros(3)
        self._pose = (checked_vector(position, "position"), checked_quaternion(quaternion))

    def move(self, position: Vector, quaternion: Vector | None = None) -> None:
        """Move the device; the next reading gives the new place.

        Raises:
            InputError: A number is not finite; the device stays where it is.
        """
        turn = self._pose[1] if quaternion is None else checked_quaternion(quaternion)
        self._pose = (checked_vector(position, "position"), turn)

    def read(self) -> tuple[Floats, Floats]:
        return self._pose

    def write(self, force: Floats, torque: Floats) -> None:
        self.force, self.torque = np.array(force), np.array(torque)
