"""Surfaces of rigid obstacles, as pictures and stages draw them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from warp_corot.contact.shapes import Box, Capsule, Cylinder, Ground, Shape, Sphere, TriangleMesh
from warp_corot.contact.tool import Obstacle, Tool
from warp_corot.cutting.blade import Edge

#: Points around a round shape, and from the pole of a ball to its equator.
AROUND, TO_EQUATOR = 32, 8
#: Height of a drawn blade over the length of its edge.
BLADE_HEIGHT = 0.15
#: Half of the edge of a drawn ground, in sizes of the bodies on it.
GROUND_SIZE = 1.2

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int32]


@dataclass(frozen=True)
class Solid:
    """A surface in an obstacle's frame.

    Attributes:
        points: [m], [N, 3].
        triangles: Counter-clockwise seen from outside, int32 [F, 3].
    """

    points: Floats
    triangles: Ints

    def at(self, pose: npt.ArrayLike) -> Floats:
        """The points at a pose [m], [N, 3]: position and quaternion (x, y, z, w)."""
        place = np.asarray(pose, dtype=np.float64)
        return _rotation(place[3:]).apply(self.points) + place[:3]


def shape_of(obstacle: Obstacle) -> Shape:
    return obstacle.shape if isinstance(obstacle, Tool) else obstacle


def solid_of(shape: Shape) -> Solid | None:
    """The surface of a shape; None for a ground, which has no end, and for a signed distance."""
    if isinstance(shape, TriangleMesh):
        return Solid(np.asarray(shape.points, dtype=np.float64), np.asarray(shape.triangles, dtype=np.int32))
    if isinstance(shape, Box):
        return _box(np.array(shape.size))
    if isinstance(shape, Edge):
        return _sheet(shape.points)
    radius, half, _ = shape.size
    if isinstance(shape, Sphere | Capsule):
        angles = np.linspace(0.0, 0.5 * np.pi, TO_EQUATOR + 1)
        arc = radius * np.stack([np.sin(angles), np.cos(angles)], axis=1)
        end = half if isinstance(shape, Capsule) else 0.0
        upper = arc + np.array([0.0, end])
        lower = (arc * [1.0, -1.0] - np.array([0.0, end]))[::-1]
        return _revolved(np.concatenate([upper, lower if end else lower[1:]]))
    if isinstance(shape, Cylinder):
        return _revolved(np.array([(0.0, half), (radius, half), (radius, -half), (0.0, -half)]))
    return None


def ground_corners(ground: Ground, points: npt.ArrayLike) -> Floats:
    """A square of the ground below points [m], [4, 3], counter-clockwise seen from above."""
    x = np.asarray(points, dtype=np.float64)
    turn = _rotation(ground.quaternion)
    above = turn.inv().apply(x - ground.position)
    low, high = above.min(axis=0), above.max(axis=0)
    # A body that is higher than wide may fall over.
    center, half = 0.5 * (low + high)[:2], GROUND_SIZE * 0.5 * float((high - low).max())
    corners = np.array([(-half, -half, 0.0), (half, -half, 0.0), (half, half, 0.0), (-half, half, 0.0)])
    return turn.apply(corners + np.array([*center, 0.0])) + ground.position


def poses_of(obstacles: Sequence[Obstacle], world: int = 0) -> Floats:
    """Where obstacles of a simulation are, float64 [O, 7]; waits for the device."""
    poses = [each.present_pose[world] if isinstance(each, Tool) else each.pose for each in obstacles]
    return np.array(poses, dtype=np.float64).reshape(-1, 7)


def _revolved(profile: Floats) -> Solid:
    """A profile of radius and height [n, 2], from its upper end on the axis to its lower one, turned about z."""
    turns = np.linspace(0.0, 2.0 * np.pi, AROUND, endpoint=False)
    rings = profile[1:-1]
    around = np.stack([np.cos(turns), np.sin(turns)], axis=1)
    points = np.concatenate([np.c_[r * around, np.full(AROUND, z)] for r, z in rings])
    points = np.concatenate([[(0.0, 0.0, profile[0, 1])], points, [(0.0, 0.0, profile[-1, 1])]])
    last = len(points) - 1
    this = np.arange(AROUND)
    following = (this + 1) % AROUND
    triangles = [np.stack([np.zeros_like(this), 1 + this, 1 + following], axis=1)]
    for ring in range(len(rings) - 1):
        a = 1 + ring * AROUND
        b = a + AROUND
        triangles.append(np.stack([a + this, b + this, b + following], axis=1))
        triangles.append(np.stack([a + this, b + following, a + following], axis=1))
    a = 1 + (len(rings) - 1) * AROUND
    triangles.append(np.stack([a + this, np.full_like(this, last), a + following], axis=1))
    return Solid(points, np.concatenate(triangles).astype(np.int32))


def _sheet(edge: Floats) -> Solid:
    """Both sides of a sheet behind a polyline [n, 3]."""
    along = edge[-1] - edge[0]
    aside = np.eye(3)[np.argmin(np.abs(along))]
    back = BLADE_HEIGHT * np.cross(np.cross(along, aside), along) / max(float(np.linalg.norm(along)), 1e-30)
    a, n = np.arange(len(edge) - 1), len(edge)
    front = np.concatenate([np.stack([a, a + 1, a + n + 1], axis=1), np.stack([a, a + n + 1, a + n], axis=1)])
    return Solid(np.concatenate([edge, edge + back]), np.concatenate([front, front[:, ::-1]]).astype(np.int32))


def _box(half: Floats) -> Solid:
    points = half * np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=np.float64)
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    triangles = [corner for a, b, c, d in quads for corner in ((a, b, c), (a, c, d))]
    return Solid(points, np.array(triangles, np.int32))


def _rotation(quaternion: npt.ArrayLike) -> Any:
    """SciPy's ``Rotation`` of a quaternion (x, y, z, w)."""
    from scipy.spatial.transform import Rotation  # takes a sixth of the time of ``import warp_corot``

    return Rotation.from_quat(quaternion)
