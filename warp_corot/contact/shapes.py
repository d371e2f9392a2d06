"""Rigid obstacles: shapes in their own frames, which a pose maps to the world."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.errors import InputError
from warp_corot.inputs.checks import checked_length, checked_number, checked_numbers, checked_vector
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
