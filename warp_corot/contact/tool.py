"""Obstacles with prescribed motion."""

from __future__ import annotations

import copy
import math
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.errors import InputError
from warp_corot.inputs.checks import checked_number, checked_numbers, checked_times, shown

from .shapes import Shape, Vector, checked_quaternion, checked_vector

if TYPE_CHECKING:
    from .obstacles import Obstacles

#: Times [s], [K], and poses, [K, 7].
Keys = tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]
#: The default of the highest speed of a tool with given poses [m/s].
SPEED = 1.0
#: Longest edge of elements, over half the thickness of a tool, with which its force is right to a few per cent.
FITTING = 0.25


def checked_keys(times: npt.ArrayLike, positions: npt.ArrayLike, quaternions: npt.ArrayLike) -> Keys:
    """Keyframes of poses; the arguments and errors are those of ``Tool.follow``."""
    t = checked_times(times)
    p = checked_numbers(positions, "positions", f"[{len(t)}, 3]")
    if p.shape != (len(t), 3) or not np.isfinite(p).all():
        raise InputError(f"positions has shape {p.shape}; it must be finite, [{len(t)}, 3]")
    q = checked_numbers(quaternions, "quaternions", f"[{len(t)}, 4]")
    if q.shape not in ((4,), (len(t), 4)) or not np.isfinite(q).all():
        raise InputError(f"quaternions has shape {q.shape}; it must be finite, [{len(t)}, 4] or [4]")
    return t, np.hstack([p, [checked_quaternion(row) for row in np.broadcast_to(q, (len(t), 4))]])


class Tool:
    """A rigid obstacle that moves along keyframes, to a target, or to poses in an array on the device.

    Args:
        shape: Its shape. The shape's pose is the tool's first one.
        speed: The highest speed at which it moves to a target [m/s]. It bounds the length of steps, so that nothing
            passes through it.

    Raises:
        InputError: The argument is not a shape, or the speed is not positive.
    """

    def __init__(self, shape: Shape, *, speed: float = SPEED):
        if not isinstance(shape, Shape):
            raise InputError(f"shape is {shown(shape)}; it must be a shape such as Capsule(radius=0.004, length=0.1)")
        if not 0.0 < checked_number(speed, "speed", "m/s") < math.inf:
            raise InputError(f"speed is {speed}; it must be a positive number of metres per second")
        self.shape, self.speed = shape, float(speed)
        self.pose = shape.pose
        #: Keyframes: times [s], float64 [K], and poses, float64 [K, 7]; None without.
        self.keys: Keys | None = None
        #: A user's array of poses that steps read; None without one.
        self.poses: wp.array | None = None
        self.is_sent = False
        self._bound: tuple[Obstacles, int] | None = None

    def __repr__(self) -> str:
        return f"tool ({self.shape!r})"

    # --- how it moves ----------------------------------------------------------------------------------------------

    def follow(self, times: npt.ArrayLike, positions: npt.ArrayLike, quaternions: npt.ArrayLike | None = None) -> None:
        """Move along keyframes: on straight lines between them, at rest before the first and after the last.

        Args:
            times: Increasing times, at least two [s], [K].
            positions: [m], [K, 3].
            quaternions: (x, y, z, w), [K, 4], or one for all; None: its present rotation.

        Raises:
            InputError: Wrong shapes, times that do not increase, or numbers that are not finite.
        """
        self._move_by(
            checked_keys(times, positions, self.pose[3:] if quaternions is None else quaternions), None, False
        )

    def move(self, position: Vector, quaternion: Vector | None = None) -> None:
        """Move to a place on a straight line, no faster than ``speed``; at once if no simulation has the tool yet.

        Raises:
            InputError: The position is not three finite numbers, or the rotation is not a quaternion (x, y, z, w).
        """
        p = checked_vector(position, "position")
        q = self.pose[3:] if quaternion is None else checked_quaternion(quaternion)
        self.pose = np.concatenate([p, q])
        if not self.is_sent or self.poses is not None:
            self._move_by(None, None, self._bound is not None)
        if self._bound is not None:
            obstacles, number = self._bound
            obstacles.send(number, self.pose)

    def use_poses(self, poses: wp.array) -> None:
        """Move to the poses in an array on the device, which every step reads, no faster than ``speed``.

        A pose that is not finite, or whose quaternion is zero, is ignored: the tool continues to the last good one.

        Args:
            poses: ``wp.transform`` [1], or [worlds] with one for each.

        Raises:
            InputError: The array has another type or length.
        """
        if not isinstance(poses, wp.array) or poses.dtype != wp.transformf or poses.ndim != 1 or not len(poses):
            raise InputError(f"poses is {shown(poses)}; it must be a Warp array of wp.transform, [1] or [worlds]")
        self._move_by(None, poses, True)

    # --- forces ----------------------------------------------------------------------------------------------------

    @property
    def wrench(self) -> wp.array:
        """Force on the tool and torque about its origin in the last step [N, N m], a live ``wp.spatial_vector``
        [worlds]: force first.

        Raises:
            InputError: No simulation has the tool.
        """
        obstacles, number = self.place_among_obstacles()
        return obstacles.wrench(number)

    @property
    def present_pose(self) -> npt.NDArray[np.float64]:
        """Its pose in each world: position and quaternion, float64 [worlds, 7]; waits for the device.

        Raises:
            InputError: No simulation has the tool.
        """
        obstacles, number = self.place_among_obstacles()
        return obstacles.poses()[:, number]

    @property
    def is_free(self) -> bool:
        """Whether no simulation has the tool."""
        return self._bound is None

    def place_among_obstacles(self) -> tuple[Obstacles, int]:
        """The obstacles of the tool's simulation, and its number among them.

        Raises:
            InputError: No simulation has the tool.
        """
        if self._bound is None:
            raise InputError("no simulation has this tool; name it among obstacles of a Simulation")
        return self._bound

    # --- pieces ----------------------------------------------------------------------------------------------------

    def bind(self, obstacles: Obstacles, number: int) -> None:
        """Become an obstacle of a simulation, which calls this.

        Raises:
            InputError: Another simulation has the tool already.
        """
        if self._bound is not None:
            raise InputError("a tool is in two simulations; make another one of its shape")
        self._bound = (obstacles, number)

    def unbind(self) -> None:
        """Be in no simulation."""
        self._bound = None

    def released(self) -> Tool:
        """The same tool in no simulation."""
        found = copy.copy(self)
        found._bound = None
        return found

    def fastest(self) -> float:
        """The highest speed of any of its points [m/s]."""
        if self.keys is None:
            return self.speed if self.is_sent else 0.0
        times, poses = self.keys
        far = np.linalg.norm(np.diff(poses[:, :3], axis=0), axis=1)
        cosines = np.abs(np.sum(poses[1:, 3:] * poses[:-1, 3:], axis=1))
        turns = 2.0 * np.arccos(np.clip(cosines, 0.0, 1.0))
        if turns.max() > 1e-7:
            far = far + turns * self.shape.reach
        return float((far / np.diff(times)).max())

    def _move_by(self, keys: Keys | None, poses: wp.array | None, is_sent: bool) -> None:
        """Change its motion; if the simulation refuses, the motion stays as before."""
        before = self.keys, self.poses, self.is_sent
        self.keys, self.poses, self.is_sent = keys, poses, is_sent
        try:
            if self._bound is not None:
                self._bound[0].update()
        except InputError:
            self.keys, self.poses, self.is_sent = before
            raise


Obstacle = Shape | Tool


def as_tool(given: Any) -> Tool:
    """A tool, or a tool at rest for a shape.

    Raises:
        InputError: The argument is neither.
    """
    if isinstance(given, Tool):
        return given
    if isinstance(given, Shape):
        return Tool(given)
    raise InputError(f"an obstacle is {shown(given)}; it must be a shape such as Ground() or a Tool")
