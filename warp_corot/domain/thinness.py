"""How many elements a thin body takes, so that its walls are as thick as one."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from .reference import extent_of

if TYPE_CHECKING:
    from .signed import SignedFunction

#: Points at which thickness is measured.
POINTS = 4000
#: Thickness is searched up to these multiples of an element's length, one after the other, because a search begins a
#: hundredth of its range inside.
REACHES = 0.01, 0.1, 1.0
#: The thinnest share of the surface counts like the rest, since edges and tips have no thickness.
TIPS = 0.05
#: Elements for each square of a wall as large as it is thick, and twice that area of its surface: six in a cube, and
#: four where the surface cuts cubes.
OF_SQUARE = 7.0
#: Normals come from differences over this share of the body's length.
APART = 2.0e-5
_AROUND = np.array([[1.0, 1.0, 1.0], [1.0, -1.0, -1.0], [-1.0, 1.0, -1.0], [-1.0, -1.0, 1.0]]) / np.sqrt(3.0)


def elements_through(domain: SignedFunction, points: np.ndarray, length: float) -> int:
    """About the number of elements of which one fits through the body where it is thinner than the present ones.

    Args:
        domain: The body.
        points: Points evenly spread over its surface [n, 3] [m].
        length: Typical edge of the present elements [m].
    """
    points = points[:: max(1, len(points) // POINTS)]
    apart = APART * float(np.ptp(domain.bounds, axis=0).max())
    outward = np.asarray(domain.phi((points[:, None] + apart * _AROUND).reshape(-1, 3)), np.float64)
    outward = outward.reshape(-1, 4) @ _AROUND
    outward /= np.maximum(np.linalg.norm(outward, axis=1, keepdims=True), 1e-300)
    thickness = np.full(len(points), np.inf)
    for reach in REACHES:
        left = np.flatnonzero(np.isinf(thickness))
        found = domain.thickness(points[left], -outward[left], reach * length) if len(left) else np.empty(0)
        thickness[left] = np.where(found < 0.99 * reach * length, found, np.inf)
    if np.isinf(thickness).all():
        return 0
    thickness = np.maximum(thickness, np.quantile(thickness, TIPS, method="lower"))
    area = extent_of(domain)[1] / len(points)
    return int(float((OF_SQUARE * area / thickness**2).sum()))
