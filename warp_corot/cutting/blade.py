"""Planes along which bodies are cut at once, and blades: edges that cut bodies while they move."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from warp_corot.contact.shapes import NO_TURN, Shape, Vector
from warp_corot.contact.tool import SPEED, Tool
from warp_corot.errors import InputError
from warp_corot.inputs.checks import checked_number, checked_numbers, checked_things, checked_vector, shown
from warp_corot.mesh.lattice import checked_level


class Plane:
    """The plane of the points x with normal . x = offset.

    Args:
        normal: Across the plane, of any length except zero.
        offset: The distance of the plane from the origin, along the normal [m].
        point: A point of the plane [m], in place of the offset.

    Attributes:
        normal: Of unit length, float64 [3].
        offset: [m].

    Raises:
        InputError: The normal is zero, a number is not finite, or there are both a point and an offset.
    """

    def __init__(self, normal: Vector, offset: float | None = None, *, point: Vector | None = None):
        n = checked_vector(normal, "normal")
        length = float(np.linalg.norm(n))
        if not length > 0.0:
            raise InputError("normal is zero; it must point across the plane")
        if point is not None and offset is not None:
            raise InputError("a plane is given by a point and an offset; it must be one of them")
        self.normal = n / length
        if point is not None:
            self.offset = float(self.normal @ checked_vector(point, "point"))
        else:
            self.offset = checked_number(0.0 if offset is None else offset, "offset", "m")
        if not math.isfinite(self.offset):
            raise InputError(f"offset is {offset}; it must be a finite number of metres")

    def __repr__(self) -> str:
        return f"plane (normal {self.normal.tolist()}, offset {self.offset:g} m)"


def checked_plane(given: Any) -> Plane:
    """A plane.

    Raises:
        InputError: It is something else.
    """
    if not isinstance(given, Plane):
        raise InputError(f"a cut is {shown(given)}; it must be a Plane, such as Plane(normal=(1, 0, 0), offset=0.1)")
    return given


#: A kind that no contact knows.
EDGE = -1


class Edge(Shape):
    """A polyline without thickness.

    Args:
        points: Its corners in the blade's frame [m], [n, 3].
    """

    kind = EDGE

    def __init__(self, points: npt.NDArray[np.float64], **options: Any):
        super().__init__(**options)
        self.points = points
        self.reach = float(np.linalg.norm(points, axis=1).max())


class Blade(Tool):
    """A cutting edge that moves as a ``Tool`` does, by ``follow``, ``move`` or ``use_poses``, and cuts what it meets.

    It has no sides: a body touches a tool beside it, if there is one. The tissue resists at the edge: cutting takes the
    ``toughness`` of the material times the area.

    Args:
        edge: Corners of the edge in the blade's frame [m], [n, 3], at least two.
        speed: As for ``Tool``.
        position, quaternion: Its first pose.
        level: Elements at the blade are refined to this level before they are cut; None: they are cut as they are.

    Raises:
        InputError: The edge is not at least two different finite points, or a value is out of its range.
    """

    def __init__(
        self,
        edge: npt.ArrayLike,
        *,
        speed: float = SPEED,
        position: Vector = (0.0, 0.0, 0.0),
        quaternion: Vector = NO_TURN,
        level: int | None = None,
    ):
        points = checked_numbers(edge, "edge", "[n, 3]")
        if points.ndim != 2 or points.shape[1] != 3 or len(points) < 2 or not np.isfinite(points).all():
            raise InputError(f"edge has shape {points.shape}; it must be at least two finite points, [n, 3]")
        if not (np.linalg.norm(np.diff(points, axis=0), axis=1) > 0.0).all():
            raise InputError("edge has two equal points after one another; each part of it must have a length")
        super().__init__(Edge(points, position=position, quaternion=quaternion), speed=speed)
        self.level = None if level is None else checked_level(level, "level")

    def __repr__(self) -> str:
        return f"blade (edge of {len(self.edge)} points)"

    @property
    def edge(self) -> npt.NDArray[np.float64]:
        """Corners of the edge in the blade's frame [m], float64 [n, 3]."""
        assert isinstance(self.shape, Edge)
        return self.shape.points

    @property
    def length(self) -> float:
        """Length of the edge [m]."""
        return float(np.linalg.norm(np.diff(self.edge, axis=0), axis=1).sum())

    @property
    def work(self) -> float:
        """Work that the blade has done on the tissue so far [J]: the energy of its cuts, and what the tissue took up.

        Raises:
            InputError: No simulation has the blade.
        """
        blades, number = self.place_among_obstacles()
        return blades.work_of(number)  # type: ignore[attr-defined]

    def sampled(self, spacing: float) -> npt.NDArray[np.float64]:
        """Points along the edge that are at most so far apart [m], its corners among them, [m, 3]."""
        parts = [self.edge[:1]]
        for a, b in zip(self.edge[:-1], self.edge[1:], strict=True):
            count = math.ceil(float(np.linalg.norm(b - a)) / spacing)
            parts.append(a + (b - a) * (np.arange(1, count + 1) / count)[:, None])
        return np.concatenate(parts)


def checked_blades(given: Any) -> tuple[Blade, ...] | None:
    """Blades, in any number; None if bodies are not cut.

    Raises:
        InputError: Something else is among them, or a blade is given twice.
    """
    if given is None:
        return None
    found = checked_things(given, Blade, "a cut", "a Blade") if given or isinstance(given, Blade) else ()
    if len(set(map(id, found))) < len(found):
        raise InputError("a blade is given twice; each must be named once")
    return found
