"""Rigid obstacles: shapes in their own frames, which a pose maps to the world."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.errors import InputError
from warp_corot.inputs.checks import checked_count, checked_length, checked_number, checked_numbers, checked_vector
from warp_corot.kernels.contact import shapes as kernels

from .options import checked_friction

Vector = Sequence[float] | npt.NDArray[np.floating]
#: x, y, z, w.
NO_TURN = (0.0, 0.0, 0.0, 1.0)


class Feeling(Protocol):
    """The source of the wrench on an obstacle."""

    @property
    def wrench(self) -> wp.array: ...


class Shape:
    """A rigid obstacle.

    Args:
        position: The origin of its frame in the world [m].
        quaternion: The rotation of its frame, (x, y, z, w).
        friction: Coulomb's coefficient; None: the simulation's.

    Attributes:
        kind: Its kind in ``kernels.contact.shapes``.
        size: Its sizes there [m].
        thickness: Half of the shortest way through it [m]; infinite for a half-space. Steps are so short that nothing
            passes through it.
        reach: The largest distance of its points from its origin [m]; infinite for a half-space.

    Raises:
        InputError: A value out of its range.
    """

    kind: int
    size: tuple[float, float, float] = (0.0, 0.0, 0.0)
    thickness = math.inf
    reach = math.inf

    def __init__(
        self, *, position: Vector = (0.0, 0.0, 0.0), quaternion: Vector = NO_TURN, friction: float | None = None
    ):
        self.position = checked_vector(position, "position")
        self.quaternion = checked_quaternion(quaternion)
        self.friction = None if friction is None else checked_friction(friction)
        #: The simulation's tool for it.
        self.felt: Feeling | None = None

    @property
    def wrench(self) -> wp.array:
        """As ``Tool.wrench``, for a shape that does not move.

        Raises:
            InputError: The shape is in no simulation.
        """
        if self.felt is None:
            raise InputError(f"no simulation has this {self!r}; name it among obstacles of a Simulation")
        return self.felt.wrench

    @property
    def pose(self) -> npt.NDArray[np.float64]:
        """Position and quaternion, float64 [7]."""
        return np.concatenate([self.position, self.quaternion])

    def __repr__(self) -> str:
        return type(self).__name__.lower()


class Ground(Shape):
    """The half-space below a plane: the points x with normal . x <= offset.

    Args:
        normal: The direction out of the ground, of any length except zero.
        offset: The distance of the plane from the origin, along the normal [m].
        friction: As ``Shape``.
    """

    kind = int(kernels.GROUND)

    def __init__(self, normal: Vector = (0.0, 0.0, 1.0), offset: float = 0.0, *, friction: float | None = None):
        n = checked_vector(normal, "normal")
        length = float(np.linalg.norm(n))
        if not length > 0.0:
            raise InputError("normal is zero; it must point out of the ground")
        if not math.isfinite(checked_number(offset, "offset", "m")):
            raise InputError(f"offset is {offset}; it must be a finite number of metres")
        n = n / length
        super().__init__(position=float(offset) * n, quaternion=turn_from_z(n), friction=friction)


class Sphere(Shape):
    """A ball.

    Args:
        radius: The radius [m].
    """

    kind = int(kernels.SPHERE)

    def __init__(self, radius: float, **options: Any):
        super().__init__(**options)
        r = checked_length(radius, "radius")
        self.size, self.thickness, self.reach = (r, 0.0, 0.0), r, r


class Capsule(Shape):
    """A cylinder along the z axis of its frame, about its origin, with round ends.

    Args:
        radius: [m].
        length: Distance between the centres of the two ends [m].
    """

    kind = int(kernels.CAPSULE)

    def __init__(self, radius: float, length: float, **options: Any):
        super().__init__(**options)
        r, half = checked_length(radius, "radius"), 0.5 * checked_length(length, "length")
        self.size, self.thickness, self.reach = (r, half, 0.0), r, half + r


class Cylinder(Shape):
    """A cylinder along the z axis of its frame, about its origin, with flat ends, whose rims are a little rounded: by a
    twentieth of the radius or of half the length.

    Args:
        radius: The radius [m].
        length: The length [m].
    """

    kind = int(kernels.CYLINDER)

    def __init__(self, radius: float, length: float, **options: Any):
        super().__init__(**options)
        r, half = checked_length(radius, "radius"), 0.5 * checked_length(length, "length")
        self.size, self.thickness, self.reach = (r, half, 0.0), min(r, half), math.hypot(half, r)


class Box(Shape):
    """A box about the origin of its frame, along its axes; its edges are rounded by a fortieth of the shortest.

    Args:
        size: Its three edges [m].
    """

    kind = int(kernels.BOX)

    def __init__(self, size: Vector, **options: Any):
        super().__init__(**options)
        edges = checked_vector(size, "size")
        if not (edges > 0.0).all():
            raise InputError(f"size is {edges.tolist()}; it must be three positive lengths [m]")
        x, y, z = (0.5 * edges).tolist()
        self.size, self.thickness, self.reach = (x, y, z), min(x, y, z), math.hypot(x, y, z)


def checked_quaternion(given: Any) -> npt.NDArray[np.float64]:
    """A unit quaternion, (x, y, z, w).

    Raises:
        InputError: They are not four finite numbers, or all are zero.
    """
    q = checked_numbers(given, "quaternion", "[4]")
    length = float(np.linalg.norm(q)) if q.shape == (4,) else math.nan
    if not 0.0 < length < math.inf:
        raise InputError(f"quaternion is {np.asarray(given).tolist()}; it must be four finite numbers (x, y, z, w)")
    return q / length


def turn_from_z(n: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """The shortest rotation of the z axis to a unit vector, (x, y, z, w); exactly the identity for z itself."""
    q = np.array([-n[1], n[0], 0.0, 1.0 + n[2]])
    length = np.linalg.norm(q)
    return q / length if length > 1e-6 else np.array([1.0, 0.0, 0.0, 0.0])


def axis_of(q: npt.NDArray[np.floating]) -> npt.NDArray[np.float64]:
    """The z axis of a frame with this rotation (x, y, z, w), [3]."""
    x, y, z, w = np.asarray(q, np.float64)
    return np.array((2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)))


# --- of any shape -----------------------------------------------------------------------------------------------------

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
