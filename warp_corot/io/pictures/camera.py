"""The camera of a picture."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from warp_corot.errors import InputError

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Camera:
    """A mild perspective view. The viewer looks along ``-axes[2]``; picture coordinates are right and up.

    Attributes:
        center: Point in the middle of the picture [m], [3].
        axes: Rows: right, up, towards the viewer; [3, 3].
        distance: From the viewer to ``center`` [m].
        world_up: The stage's up direction, [3].
    """

    center: Array
    axes: Array
    distance: float
    world_up: Array

    @classmethod
    def fit(cls, points: ArrayLike, up_axis: str = "Y", azimuth: float = 35.0, elevation: float = 14.0) -> Camera:
        """A camera that sees all of ``points`` [n, 3] from ``azimuth`` [°] round the up axis and ``elevation`` [°].

        Azimuth 0 looks along −Z where Y is up, along +Y where Z is up, along −Y where X is up.
        """
        right, up, front = _world_axes(up_axis)
        a, e = math.radians(azimuth), math.radians(elevation)
        towards = math.cos(e) * (math.cos(a) * front + math.sin(a) * right) + math.sin(e) * up
        across = math.cos(a) * right - math.sin(a) * front
        x = np.asarray(points, dtype=np.float64).reshape(-1, 3)
        low, high = x.min(axis=0), x.max(axis=0)
        size = float(np.linalg.norm(high - low)) or 1.0
        axes = np.stack([across, np.cross(towards, across), towards])
        return cls((low + high) / 2.0, axes, 3.5 * size, up)

    def project(self, points: Array) -> tuple[Array, Array]:
        """Picture coordinates [..., 2] and depth [...] (larger is nearer) of points [..., 3]."""
        seen = ((points - self.center).reshape(-1, 3) @ self.axes.T).reshape(points.shape)
        depth = seen[..., 2]
        return seen[..., :2] * (self.distance / (self.distance - depth))[..., None], depth

    def rays(self, points: Array) -> Array:
        """Unit vectors from points [..., 3] to the viewer."""
        towards = self.center + self.distance * self.axes[2] - points
        return towards / np.linalg.norm(towards, axis=-1, keepdims=True)

    def sees_outside(self, points: Array, faces: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Which triangles [n, 3] of points [N, 3] show their outer side."""
        u, v = self.project(points)[0].T
        a, b, c = faces.T
        return (u[b] - u[a]) * (v[c] - v[a]) > (v[b] - v[a]) * (u[c] - u[a])


def _world_axes(up_axis: str) -> tuple[Array, Array, Array]:
    """Right, up and front (towards a viewer at azimuth 0), a right-handed triple."""
    if up_axis not in ("X", "Y", "Z"):
        raise InputError(f"up_axis is {up_axis!r}; it must be X, Y or Z")
    x, y, z = np.eye(3)
    return {"Y": (x, y, z), "Z": (x, z, -y), "X": (z, x, y)}[up_axis]
