"""Boxes of root cubes that are bisected uniformly, or some subtrees of one, without a search.

All vertices lie on a grid, and a vertex's place on it is an affine function of its coordinates. So the place of a
midpoint is the mean of the places of its ends. Tables of patches of six levels lead from the roots to the leaves. Only
the nodes of the last patches have to be numbered: one seventh as many as the entries of all leaves.

A part of a box has the same elements as in the whole, which is not made. Above its subtrees, the tree has only their
ancestors, and the other children of these as void leaves.

Subtrees around points: a point's barycentric weights in a root are whole numbers. An element is bisected at the
midpoint of an edge, between corners with the weights a and b. If a >= b, the point is in the child that keeps the first
corner, with the weights a - b there and 2 b at the midpoint; otherwise it is in the other child, with a and b
exchanged. So a descent needs only sums and comparisons of whole numbers."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from warp_corot.errors import InputError
from warp_corot.mesh.bisection import (
    CHUNK,
    WALKS,
    IntArray,
    Patch,
    children,
    corner_leaves,
    far_end,
    patch,
    path_tetrahedra,
)
from warp_corot.mesh.tree import LIVE, VOID, Tree, numbered

#: Levels of a patch: 64 leaves on 35 or 37 nodes.
PATCH_DEPTH = 6


def halvings(level: int) -> int:
    """How often a cube's edge must be halved for all vertices of a level to be on the grid."""
    return -(-level // 3)


def uniform_leaves(cells: tuple[int, int, int], level: int) -> tuple[IntArray, IntArray, IntArray]:
    """Grid places of the nodes, ends of the nodes and leaves of a box of root cubes bisected ``level`` times.

    Returns:
        The nodes' coordinates, 2**halvings(level) intervals a cube edge, int32 [N, 3], in the order in which the leaves
        first name them: neighbours in memory are neighbours in space. The two ends of the edge whose midpoint a node
        is, the lower number first, -1, -1 for corners of cubes, int32 [N, 2]. The leaves in tree order, int32 [T, 4].
    """
    intervals = 2 ** halvings(level)
    grid = tuple(n * intervals + 1 for n in cells)
    tets = path_tetrahedra(cells, grid)
    patches: list[tuple[Patch, IntArray]] = []
    at = 0
    while at < level or not patches:
        # Levels that do not fill a patch come first, so that the last patches, which are nearly all, are full.
        depth = (level - at) % PATCH_DEPTH or min(level, PATCH_DEPTH)
        if patches:
            tets = patches[-1][0].leaves_of(patches[-1][1])
        table = patch(at % 3, depth)
        patches.append((table, table.lattice_points(tets)))
        at += depth
    last, places = patches[-1]
    number, place_of = numbered(places.ravel(), math.prod(grid))
    ends = np.full((len(place_of), 2), -1, np.int32)
    for table, points in patches:
        for start in range(0, len(points), CHUNK):
            nodes = number[points[start : start + CHUNK]]
            ends[nodes[:, table.middles[:, 0]]] = nodes[:, table.middles[:, 1:]]
    ends.sort(axis=1)
    return _coordinates(place_of, grid), ends, last.leaves_of(number[places])


#: Levels of a subtree.
SUBTREE_DEPTH = 3
#: Grid places are numbered in 32 bits.
MOST_PLACES = 2**31 - 1


@dataclass(frozen=True, eq=False)
class _Elements:
    """The elements of one level: their numbers among all of that level, their places, and which have descendants."""

    number: npt.NDArray[np.int64]
    tets: IntArray
    kept: npt.NDArray[np.bool_]


def uniform_part(
    cells: tuple[int, int, int], level: int, subtrees: npt.NDArray[np.int64]
) -> tuple[IntArray, IntArray, Tree]:
    """The leaves of some subtrees of a box of root cubes bisected ``level`` times.

    Args:
        cells: Number of cubes along x, y, z.
        level: At least ``SUBTREE_DEPTH``.
        subtrees: Ascending numbers of elements ``SUBTREE_DEPTH`` levels above the leaves, in tree order, int64 [s].

    Returns:
        Coordinates of the nodes, 2**halvings(level) intervals a cube edge, int32: nodes of leaves in the order in which
        these first name them, then all others, by their places. The ends of the edge whose midpoint each node is, as in
        ``TetForest``. The tree.

    Raises:
        InputError: The cubes around the subtrees have too many grid places.
    """
    low, grid, coarse = _above(cells, level, subtrees)
    table = patch((level - SUBTREE_DEPTH) % 3, SUBTREE_DEPTH)
    points = table.lattice_points(coarse[-1].tets[coarse[-1].kept])
    number, place_of = numbered(points.ravel(), math.prod(grid))
    real = np.zeros(len(number), bool)
    real[place_of] = True
    named = np.zeros(len(number), bool)
    for elements in coarse:
        named[elements.tets] = True
    virtual = np.flatnonzero(named & ~real).astype(place_of.dtype)
    coordinates = _coordinates(np.concatenate([place_of, virtual]), grid)
    order = np.lexsort(coordinates[len(place_of) :].T)
    coordinates[len(place_of) :] = coordinates[len(place_of) :][order]
    number[virtual[order]] = np.arange(len(place_of), len(coordinates), dtype=np.int32)
    ends = np.full((len(coordinates), 2), -1, np.int32)
    for at, elements in enumerate(coarse[:-1]):
        edge = number[elements.tets[elements.kept][:, [0, far_end(at % 3)]]]
        ends[number[_middles(elements.tets[elements.kept], at)]] = edge
    for start in range(0, len(points), CHUNK):
        nodes = number[points[start : start + CHUNK]]
        ends[nodes[:, table.middles[:, 0]]] = nodes[:, table.middles[:, 1:]]
    ends.sort(axis=1)
    leaves = table.leaves_of(number[points])
    return coordinates + (low << halvings(level)), ends, _tree(coarse, number, leaves, level)


def vertices_of(cells: tuple[int, int, int], level: int, subtrees: npt.NDArray[np.int64]) -> IntArray:
    """Coordinates of the nodes of some subtrees in any order, int32 [n, 3]; as for ``uniform_part``."""
    low, grid, coarse = _above(cells, level, subtrees)
    table = patch((level - SUBTREE_DEPTH) % 3, SUBTREE_DEPTH)
    named = np.zeros(math.prod(grid), bool)
    named[table.lattice_points(coarse[-1].tets[coarse[-1].kept])] = True
    return _coordinates(np.flatnonzero(named), grid) + (low << halvings(level))


def _above(
    cells: tuple[int, int, int], level: int, subtrees: npt.NDArray[np.int64]
) -> tuple[IntArray, tuple[int, int, int], list[_Elements]]:
    """The lowest cube of the table, its number of grid places along each axis, and the elements of each level from the
    roots to the subtrees."""
    depth = level - SUBTREE_DEPTH
    low, grid, roots = _roots(cells, level, np.unique(subtrees >> depth))
    found = [roots]
    for at in range(depth):
        found.append(_halved(found[-1], at, np.unique(subtrees >> (depth - at - 1))))
    return low, grid, found


def _roots(
    cells: tuple[int, int, int], level: int, roots: npt.NDArray[np.int64]
) -> tuple[IntArray, tuple[int, int, int], _Elements]:
    """The lowest cube of the table, its number of grid places along each axis, and the roots."""
    intervals = 1 << halvings(level)
    cubes = np.stack(np.unravel_index(roots // 6, cells), axis=1)
    low = cubes.min(axis=0)
    nx, ny, nz = (int(n) * intervals + 1 for n in cubes.max(axis=0) - low + 1)
    if nx * ny * nz > MOST_PLACES:
        raise InputError(
            f"the cubes of this part have {nx * ny * nz} grid places; there must be at most {MOST_PLACES}: take more "
            "ranks, or a lower level"
        )
    strides = np.array([ny * nz, nz, 1], np.int64)
    tets = (intervals * (cubes - low)) @ strides
    tets = tets[:, None] + intervals * (WALKS[roots % 6] @ strides)
    return low.astype(np.int32), (nx, ny, nz), _Elements(roots, tets.astype(np.int32), np.ones(len(roots), bool))


def _halved(above: _Elements, at: int, kept: npt.NDArray[np.int64]) -> _Elements:
    """Both children of all elements that have descendants; the children in ``kept`` have descendants, too."""
    tets = above.tets[above.kept]
    both = children(tets, _middles(tets, at), at % 3).reshape(-1, 4)
    number = (2 * above.number[above.kept][:, None] + np.arange(2)).ravel()
    place = np.minimum(np.searchsorted(kept, number), len(kept) - 1)
    return _Elements(number, both, kept[place] == number)


def _middles(tets: IntArray, at: int) -> IntArray:
    a, b = tets[:, 0], tets[:, far_end(at % 3)]
    return a + (b - a) // 2


def _coordinates(places: npt.NDArray[np.integer], grid: tuple[int, int, int]) -> IntArray:
    found = np.empty((len(places), 3), np.int32)
    for axis, along in enumerate(np.unravel_index(places, grid)):
        found[:, axis] = along
    return found


def _tree(coarse: list[_Elements], number: IntArray, leaves: IntArray, level: int) -> Tree:
    depth, subtrees = len(coarse) - 1, len(leaves) >> SUBTREE_DEPTH
    sizes = [len(each.number) for each in coarse] + [subtrees << n for n in range(1, SUBTREE_DEPTH + 1)]
    starts = np.concatenate([[0], np.cumsum(sizes)])
    tets = np.empty((starts[-1], 4), np.int32)
    parent = np.full(starts[-1], -1, np.int32)
    first_child = np.full(starts[-1], LIVE, np.int32)
    for at in range(level):
        here, below = slice(starts[at], starts[at + 1]), slice(starts[at + 1], starts[at + 2])
        kept = coarse[at].kept if at <= depth else np.ones(sizes[at], bool)
        first = starts[at + 1] + 2 * np.arange(np.count_nonzero(kept), dtype=np.int32)
        child = np.full(sizes[at], VOID, np.int32)
        child[kept] = first
        first_child[here] = child
        parent[below] = np.repeat(starts[at] + np.flatnonzero(kept), 2)
    for at in range(level + 1):
        own = tets[starts[at] : starts[at + 1]]
        if at <= depth:
            own[:] = number[coarse[at].tets]
            continue
        for corner, (leaf, place) in enumerate(corner_leaves(at, level)):
            own[:, corner] = leaves[leaf :: 2 ** (level - at), place]
    levels = np.repeat(np.arange(level + 1, dtype=np.int32), sizes)
    return Tree(tets, levels, parent, first_child)


Longs = npt.NDArray[np.int64]

#: Number of points that descend at a time.
DESCENTS = 1 << 20


def subtrees_around(
    points: IntArray, cells: tuple[int, int, int], intervals: int, depth: int, left_out: tuple[int, int]
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
    for start in range(0, len(points), DESCENTS):
        for node, root, weights in _in_roots(points[start : start + DESCENTS], cells, intervals):
            pairs = _below((node, root, weights), depth, left_out)
            found.append((pairs[0] + start, pairs[1]))
    nodes, subtrees = (np.concatenate(each) for each in zip(*found, strict=True))
    return nodes, subtrees


def _in_roots(points: IntArray, cells: tuple[int, int, int], intervals: int) -> Iterator[tuple[Longs, Longs, IntArray]]:
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


def _weights(inside: IntArray, axes: tuple[int, ...], intervals: int) -> IntArray:
    """Barycentric weights, times ``intervals``, in the path tetrahedron that goes along these axes; [n, 4]."""
    first, second, third = (inside[:, axis] for axis in axes)
    return np.stack([intervals - first, first - second, second - third, third], axis=1).astype(np.int32)


def _below(given: tuple[Longs, Longs, IntArray], depth: int, left_out: tuple[int, int]) -> tuple[Longs, Longs]:
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


def _first(weights: IntArray, k: int) -> IntArray:
    """The weights in the first child, which keeps the corner before the edge's midpoint."""
    made = weights.copy()
    made[:, 0] -= weights[:, k]
    made[:, k] *= 2
    return made


def _second(weights: IntArray, k: int) -> IntArray:
    made = weights.copy()
    made[:, : k - 1] = weights[:, 1:k]
    made[:, k - 1] = weights[:, k] - weights[:, 0]
    made[:, k] = 2 * weights[:, 0]
    return made
