"""Finer surfaces of the same shape: each triangle becomes four."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.integer]


def split(points: Floats, triangles: Ints) -> tuple[Floats, Ints]:
    """A closed surface with the middles of its edges as further points.

    Args:
        points: [V, 3].
        triangles: [F, 3].

    Returns:
        The points, the given ones first, and triangles [4 F, 3].
    """
    ends = np.sort(triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1).astype(np.int64)
    keys, which = np.unique(ends[:, 0] << 32 | ends[:, 1], return_inverse=True)
    middles = 0.5 * (points[keys >> 32] + points[keys & 0xFFFFFFFF])
    a, b, c = triangles.T
    ab, bc, ca = len(points) + which.reshape(-1, 3).T
    corners = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
    made = np.concatenate([np.column_stack(each) for each in corners])
    return np.concatenate([points, middles]), made.astype(np.int32)


def longest_edge(points: Floats, triangles: Ints, sizes: Floats) -> float:
    """The length of the longest edge, over the smaller one of the sizes at its ends [V]."""
    first, second = triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).T
    once = first < second
    first, second = first[once], second[once]
    lengths = np.linalg.norm(points[first] - points[second], axis=1)
    return float((lengths / np.minimum(sizes[first], sizes[second])).max(initial=0.0))
