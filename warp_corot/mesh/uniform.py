"""A box of root cubes, bisected uniformly without a search.

All vertices lie on a grid, and a vertex's place on it is an affine function of its coordinates. So the place of a
midpoint is the mean of the places of its ends. Tables of patches of six levels lead from the roots to the leaves. Only
the nodes of the last patches have to be numbered: one seventh as many as the entries of all leaves.
"""

from __future__ import annotations

import math

import numpy as np

from .bisection import CHUNK, IntArray, Patch, patch, path_tetrahedra

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
    coordinates = np.empty((len(place_of), 3), np.int32)
    for axis, along in enumerate(np.unravel_index(place_of, grid)):
        coordinates[:, axis] = along
    return coordinates, ends, last.leaves_of(number[places])


def numbered(touched: IntArray, place_count: int) -> tuple[IntArray, IntArray]:
    """Number places in the order in which they are first named.

    Returns:
        The number of each place, int32 [place_count] (undefined if nothing names it), and the place of each number.
    """
    number = np.empty(place_count, np.int32)
    turn = np.arange(len(touched), dtype=np.int32)
    # The last write to a place wins, so walk backwards to keep the first value.
    number[touched[::-1]] = turn[::-1]
    place_of = touched[number[touched] == turn]
    number[place_of] = turn[: len(place_of)]
    return number, place_of
