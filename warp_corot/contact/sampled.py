"""Obstacles of any shape: closed triangle meshes, and signed distances that are sampled on a grid."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

from warp_corot.errors import InputError
from warp_corot.inputs.checks import checked_count, checked_numbers
from warp_corot.kernels.contact import shapes as kernels

from .shapes import Shape, Vector, checked_vector

Floats = npt.NDArray[np.float64]
#: Samples along the longest side of a function's box.
RESOLUTION = 64


class TriangleMesh(Shape):
    """A closed surface of triangles, with a skin about it that rounds its edges: as thick as a fiftieth of a ball's
    radius, or 3 % of a plate's thickness.

    Args:
        points: In its frame [m], [N, 3].
        triangles: Their corners, counter-clockwise seen from outside, [F, 3].

    Raises:
        InputError: Wrong shapes, corners that do not exist, or a surface that is open or inside out.
    """

    kind = int(kernels.MESH)

    def __init__(self, points: npt.ArrayLike, triangles: npt.ArrayLike, **options: Any):
        super().__init__(**options)
        x = checked_numbers(points, "points", "[N, 3]")
        if x.ndim != 2 or x.shape[1] != 3 or not np.isfinite(x).all():
            raise InputError(f"points has shape {x.shape}; it must be finite, [N, 3]")
        corners = checked_numbers(triangles, "triangles", "[F, 3]")
        t = corners.astype(np.int32)
        if t.ndim != 2 or t.shape[1] != 3 or not len(t) or (t != corners).any() or t.min() < 0 or t.max() >= len(x):
            raise InputError(
                f"triangles has shape {t.shape}; it must be [F, 3], numbers of points from 0 to {len(x) - 1}"
            )
        _check_closed(t)
        a, b, c = (x[t[:, k]] - x.mean(axis=0) for k in range(3))
        volume = float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6.0)
        area = float(0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum())
        if not volume > 0.0:
            raise InputError(
                "the triangle mesh is inside out; its triangles must be counter-clockwise seen from outside"
            )
        self.points, self.triangles = x, t
        # Half of a plate's thickness, a third of a ball's radius.
        self.thickness = volume / area
        self.reach = float(np.linalg.norm(x, axis=1).max())
        self.size = (min(3.0 * self.thickness, self.reach), 0.0, 0.0)


class SignedDistance(Shape):
    """A signed distance, negative inside, between samples on a grid.

    Args:
        distance: Samples [nx, ny, nz] [m]; or a function of points [n, 3] [m] that returns their distances [n] [m].
        lower: The first sample's place, or the lower corner of the box in which the function is sampled [m].
        spacing: The distance of samples along each axis [m]; with samples only.
        upper: The upper corner of the box [m]; with a function only. The shape must lie within it.
        resolution: Samples along the longest side of the box; with a function only.

    Raises:
        InputError: Arguments that exclude each other, distances that are not finite, no point inside, or a shape that
            reaches the border of the grid, for example because it is inside out.
    """

    kind = int(kernels.GRID)

    def __init__(
        self,
        distance: npt.ArrayLike | Callable[[Floats], npt.ArrayLike],
        lower: Vector,
        *,
        spacing: float | Vector | None = None,
        upper: Vector | None = None,
        resolution: int = RESOLUTION,
        **options: Any,
    ):
        super().__init__(**options)
        self.lower = checked_vector(lower, "lower")
        if callable(distance):
            if upper is None or spacing is not None:
                raise InputError("a function needs upper, the other corner of its box, and no spacing")
            values, step = _sampled(distance, self.lower, checked_vector(upper, "upper"), resolution)
        else:
            if spacing is None or upper is not None:
                raise InputError("samples need spacing, and no upper")
            values = checked_numbers(distance, "distance", "[nx, ny, nz]")
            steps = checked_numbers(spacing, "spacing", "one or three distances [m]")
            step = checked_vector(np.full(3, steps) if steps.shape == () else steps, "spacing")
        if values.ndim != 3 or min(values.shape) < 2 or not np.isfinite(values).all() or not (step > 0.0).all():
            raise InputError(f"distance has shape {values.shape}; it must be finite, [nx, ny, nz], at least two each")
        inner = tuple(slice(1, -1) for _ in range(3))
        border = np.ones(values.shape, bool)
        border[inner] = False
        if not (values < 0.0).any():
            raise InputError("the signed distance is nowhere negative; it must be so inside the shape")
        if (values[border] <= 0.0).any():
            raise InputError("the signed distance is negative at the border of its grid; it must be positive outside")
        self.values = values.astype(np.float32)
        self.size = (float(step[0]), float(step[1]), float(step[2]))
        self.thickness = float(-values.min())
        corners = np.stack([self.lower, self.lower + step * (np.array(values.shape) - 1)])
        self.reach = float(np.linalg.norm(np.abs(corners).max(axis=0)))


def _check_closed(triangles: npt.NDArray[np.int32]) -> None:
    """Check that every edge occurs once in each direction.

    Raises:
        InputError: The surface is open, or turns over.
    """
    edges = triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    there = np.sort(edges[:, 0].astype(np.int64) * (triangles.max() + 1) + edges[:, 1])
    back = np.sort(edges[:, 1].astype(np.int64) * (triangles.max() + 1) + edges[:, 0])
    if not np.array_equal(there, back):
        raise InputError("the triangle mesh is not closed; every edge must have two triangles with the same winding")


def _sampled(
    function: Callable[[Floats], npt.ArrayLike], lower: Floats, upper: Floats, resolution: int
) -> tuple[Floats, Floats]:
    """A function's values on a grid over a box, and the spacing."""
    count = checked_count(resolution, "resolution", least=3)
    if not (lower < upper).all():
        raise InputError(f"the box from {lower.tolist()} to {upper.tolist()} is empty; lower must be below upper")
    wanted = (upper - lower).max() / (count - 1)
    counts = np.maximum(np.ceil((upper - lower) / wanted).astype(int) + 1, 3)
    axes = [np.linspace(lower[k], upper[k], counts[k]) for k in range(3)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    values = checked_numbers(function(points), "distance", f"[{len(points)}]")
    if values.shape != (len(points),):
        raise InputError(
            f"the function gives shape {values.shape} for {len(points)} points; it must be [{len(points)}]"
        )
    return values.reshape(tuple(counts)), (upper - lower) / (counts - 1)
