"""Planes along which bodies are cut at once."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from warp_corot.contact.shapes import Vector
from warp_corot.errors import InputError
from warp_corot.inputs.checks import checked_number, checked_vector, shown


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
