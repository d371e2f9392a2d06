"""Readings of a device: checks, and the motion from one reading to the next."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from warp_corot.inputs.checks import shown

Floats = npt.NDArray[np.float64]
Pose = tuple[Floats, Floats]


class DeviceError(RuntimeError):
    """The haptic device failed, and the loop has stopped; one line says how."""


def checked_pose(position: object, quaternion: object) -> Pose:
    """A position [m], [3], and a unit quaternion (x, y, z, w), [4].

    Raises:
        DeviceError: The reading is something else.
    """
    try:
        place, turn = np.array(position, dtype=np.float64), np.array(quaternion, dtype=np.float64)
    except (TypeError, ValueError):
        place, turn = np.zeros(0), np.zeros(0)
    length = float(np.linalg.norm(turn)) if turn.shape == (4,) else math.nan
    if place.shape != (3,) or not np.isfinite(place).all() or not 0.0 < length < math.inf:
        raise DeviceError(
            f"the haptic device read {shown(position)} and {shown(quaternion)}; it must read three finite numbers and "
            "a quaternion"
        )
    return place, turn / length


def way(before: Pose, now: Pose) -> tuple[Floats, Floats]:
    """How far something has moved [m] and turned [rad] from one pose to another, [3] each."""
    (p, b), (position, q) = before, now
    # The imaginary part of the present quaternion times the conjugate of the one before.
    axis = b[3] * q[:3] - q[3] * b[:3] - np.cross(q[:3], b[:3])
    real, sine = float(q @ b), float(np.linalg.norm(axis))
    angle = 2.0 * math.atan2(sine, abs(real))
    turned = axis * (math.copysign(angle, real) / sine) if sine > 1e-12 else np.zeros(3)
    return position - p, turned
