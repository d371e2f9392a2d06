"""The subtrees of a uniformly bisected box around given lattice points, found without making the mesh.

A point's barycentric weights in a root are whole numbers. An element is bisected at the midpoint of an edge, between
corners with the weights a and b. If a >= b, the point is in the child that keeps the first corner, with the weights
a - b there and 2 b at the midpoint; otherwise it is in the other child, with a and b exchanged. So a descent needs only
sums and comparisons of whole numbers.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

from .bisection import far_end

Ints = npt.NDArray[np.int32]
Longs = npt.NDArray[np.int64]

#: Number of points that descend at a time.
CHUNK = 1 << 20


def subtrees_around(
    points: Ints, cells: tuple[int, int, int], intervals: int, depth: int, left_out: tuple[int, int]
) -> tuple[Longs, Longs]:
    """All pairs of a point and a subtree that holds it, except subtrees in one range.

    Args:
        points: Vertices of the mesh, with ``intervals`` grid intervals along a cube's edge, int32 [n, 3].
        cells: Number of cubes along x, y, z.
        intervals: A power of two.
        depth: The level of the subtrees' roots; the i-th is the i-th element of that level in tree order.
        left_out: The range of subtrees to leave out: the first one, and the one after the last.

    Returns:
        Places in ``points``, and numbers of subtrees, int64 [m] both.
    """
    found = [(np.zeros(0, np.int64), np.zeros(0, np.int64))]
    for start in range(0, len(points), CHUNK):
        for node, root, weights in _in_roots(points[start : start + CHUNK], cells, intervals):
            pairs = _below((node, root, weights), depth, left_out)
            found.append((pairs[0] + start, pairs[1]))
    nodes, subtrees = (np.concatenate(each) for each in zip(*found, strict=True))
    return nodes, subtrees


def _in_roots(points: Ints, cells: tuple[int, int, int], intervals: int) -> Iterator[tuple[Longs, Longs, Ints]]:
    """Each point with each root that holds it: places of the points, the roots, and the weights there."""
    strides = np.array([cells[1] * cells[2], cells[2], 1], np.int64)
    for below in itertools.product((0, 1), repeat=3):
        cube = points // intervals - np.array(below, np.int32)
        is_there = (cube >= 0).all(axis=1) & (cube < cells).all(axis=1)
        is_there &= ((points % intervals == 0) | (np.array(below) == 0)).all(axis=1)
        node = np.flatnonzero(is_there)
        inside, first = points[node] - intervals * cube[node], 6 * (cube[node] @ strides)
        for walk, axes in enumerate(itertools.permutations(range(3))):
            weights = _weights(inside, axes, intervals)
            held = np.flatnonzero((weights >= 0).all(axis=1))
            yield node[held], first[held] + walk, weights[held]


def _weights(inside: Ints, axes: tuple[int, ...], intervals: int) -> Ints:
    """Barycentric weights, times ``intervals``, in the path tetrahedron that goes along these axes; [n, 4]."""
    first, second, third = (inside[:, axis] for axis in axes)
    return np.stack([intervals - first, first - second, second - third, third], axis=1).astype(np.int32)


def _below(given: tuple[Longs, Longs, Ints], depth: int, left_out: tuple[int, int]) -> tuple[Longs, Longs]:
    node, element, weights = given
    for level in range(depth + 1):
        above = depth - level
        outside = (element << above < left_out[0]) | ((element + 1) << above > left_out[1])
        node, element, weights = node[outside], element[outside], weights[outside]
        if level == depth or not len(node):
            break
        k = far_end(level % 3)
        first = np.flatnonzero(weights[:, 0] >= weights[:, k])
        second = np.flatnonzero(weights[:, k] >= weights[:, 0])
        node = np.concatenate([node[first], node[second]])
        element = np.concatenate([2 * element[first], 2 * element[second] + 1])
        weights = np.concatenate([_first(weights[first], k), _second(weights[second], k)])
    return node, element


def _first(weights: Ints, k: int) -> Ints:
    """The weights in the first child, which keeps the corner before the edge's midpoint."""
    made = weights.copy()
    made[:, 0] -= weights[:, k]
    made[:, k] *= 2
    return made


def _second(weights: Ints, k: int) -> Ints:
    made = weights.copy()
    made[:, : k - 1] = weights[:, 1:k]
    made[:, k - 1] = weights[:, k] - weights[:, 0]
    made[:, k] = 2 * weights[:, 0]
    return made
