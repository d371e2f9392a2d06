"""Some subtrees of a uniformly bisected box of root cubes, with the same elements as in the whole box, which is not
made.

Above the subtrees, the tree has only their ancestors, and the other children of these ancestors as void leaves. A table
over the cubes that hold the subtrees numbers the places of the grid.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from warp_corot.errors import InputError

from .bisection import CHUNK, IntArray, children, corner_leaves, far_end, patch
from .tree import LIVE, VOID, Tree
from .uniform import halvings, numbered

#: Levels of a subtree.
SUBTREE_DEPTH = 3
#: Grid places are numbered in 32 bits.
MOST_PLACES = 2**31 - 1


class PartTree(Tree):
    """A tree whose live leaves all have one level and come last, in tree order.

    Args:
        tets, level, parent, first_child: As for ``Tree``.
        count: Number of live leaves.
    """

    def __init__(self, tets: IntArray, level: IntArray, parent: IntArray, first_child: IntArray, count: int):
        super().__init__(tets, level, parent, first_child)
        object.__setattr__(self, "_count", count)

    @cached_property
    def leaves(self) -> np.ndarray:
        return np.arange(len(self.level) - self._count, len(self.level), dtype=np.int32)  # type: ignore[attr-defined]

    @cached_property
    def leaf_tets(self) -> np.ndarray:
        return self.tets[len(self.tets) - self._count :]  # type: ignore[attr-defined]

    @cached_property
    def leaf_levels(self) -> np.ndarray:
        return np.broadcast_to(self.level[-1], self._count)  # type: ignore[attr-defined]


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
    walks = np.zeros((6, 4, 3), np.int64)
    for walk, axes in zip(walks, itertools.permutations(range(3)), strict=True):
        for step, axis in enumerate(axes):
            walk[step + 1 :, axis] = 1
    strides = np.array([ny * nz, nz, 1], np.int64)
    tets = (intervals * (cubes - low)) @ strides
    tets = tets[:, None] + intervals * (walks[roots % 6] @ strides)
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


def _tree(coarse: list[_Elements], number: IntArray, leaves: IntArray, level: int) -> PartTree:
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
    return PartTree(tets, levels, parent, first_child, len(leaves))
