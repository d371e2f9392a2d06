"""Bisection of tetrahedra in Maubach order, the rule behind the whole mesh.

A tetrahedron (x0, x1, x2, x3) of type t = level mod 3 is bisected at the midpoint z of its refinement edge x0-xk,
k = 3 - t, into (x0 .. x(k-1), z, x(k+1) .. x3) and (x1 .. xk, z, x(k+1) .. x3) (Maubach 1995).

All subtrees below elements of one type have the same structure. ``Patch`` is a table of this structure, so only the
nodes are data.
"""

from __future__ import annotations

import functools
import itertools
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

IntArray = npt.NDArray[np.int32]

#: Number of patches that are computed at a time, few enough that data read again are still in the cache.
CHUNK = 4096


#: Corners of the six path (Kuhn) tetrahedra of a cube [6, 4, 3], in cubes from its lowest corner.
WALKS = np.array([np.tri(4, 3, -1, dtype=np.int64)[:, np.argsort(axes)] for axes in itertools.permutations(range(3))])


def far_end(kind: int) -> int:
    """k of the refinement edge x0-xk of a type, which is also where the midpoint stands in both children."""
    return 3 - kind


def children(tets: np.ndarray, middle: np.ndarray, kind: int) -> np.ndarray:
    """Both children, [n, 2, 4], of elements of one type, [n, 4], with the midpoints of their refinement edges, [n]."""
    k = far_end(kind)
    both = np.empty((len(tets), 2, 4), tets.dtype)
    both[:, 0, :k] = tets[:, :k]
    both[:, 1, :k] = tets[:, 1 : k + 1]
    both[:, :, k] = middle[:, None]
    both[:, :, k + 1 :] = tets[:, None, k + 1 :]
    return both


def corner_leaves(level: int, depth: int) -> list[tuple[int, int]]:
    """For each of an element's corners, a leaf among the 2**(depth - level) below it and the corner's place there."""
    found = []
    for place in range(4):
        leaf = 0
        for above in range(level, depth):
            in_second = 1 <= place <= far_end(above % 3)
            leaf = 2 * leaf + in_second
            place -= in_second
        found.append((leaf, place))
    return found


@dataclass(frozen=True, eq=False)
class Patch:
    """The uniformly bisected subtree below an element of one type, as a table of its nodes.

    Nodes are numbered within the patch, in the order in which the leaves first name them.

    Attributes:
        corners: The element's own four nodes.
        middles: Every other node and the two ends of the edge whose midpoint it is, coarse to fine, intp [m, 3].
        leaves: Nodes of the leaves in tree order, intp [2**depth, 4].
    """

    corners: tuple[int, ...]
    middles: npt.NDArray[np.intp]
    leaves: npt.NDArray[np.intp]

    @property
    def node_count(self) -> int:
        return len(self.corners) + len(self.middles)

    def lattice_points(self, tets: IntArray) -> IntArray:
        """The nodes of the patches below elements [n, 4], if nodes are numbered by an affine function of coordinates.

        Then the number of a midpoint is the mean of those of its ends, and no search is needed.
        """
        points = np.empty((len(tets), self.node_count), np.int32)
        for start in range(0, len(tets), CHUNK):
            part = points[start : start + CHUNK]
            part[:, self.corners] = tets[start : start + CHUNK]
            for middle, a, b in self.middles:
                # Half the difference, because the sum of two numbers may overflow.
                part[:, middle] = part[:, a] + (part[:, b] - part[:, a]) // 2
        return points

    def leaves_of(self, nodes: IntArray) -> IntArray:
        """The leaves [n * 2**depth, 4] of patches that stand on nodes [n, node_count]."""
        return np.take(nodes, self.leaves.ravel(), axis=1).reshape(-1, 4)


@functools.cache
def patch(kind: int, depth: int) -> Patch:
    """The patch ``depth`` levels below an element of a type."""
    made: dict[tuple[int, int], int] = {}
    leaves = np.arange(4)[None, :]
    for level in range(kind, kind + depth):
        edges = np.sort(leaves[:, [0, far_end(level % 3)]], axis=1)
        middle = np.array([made.setdefault((int(a), int(b)), 4 + len(made)) for a, b in edges])
        leaves = children(leaves, middle, level % 3).reshape(-1, 4)
    touched = list(dict.fromkeys(leaves.ravel().tolist()))
    rank = {node: place for place, node in enumerate(touched)}
    middles = [(rank[4 + n], rank[a], rank[b]) for n, (a, b) in enumerate(made)]
    at = np.array([rank[n] for n in range(len(rank))])
    return Patch(tuple(at[:4].tolist()), np.array(middles, np.intp).reshape(-1, 3), at[leaves])


def path_tetrahedra(cells: tuple[int, int, int], points: tuple[int, int, int]) -> IntArray:
    """Six path (Kuhn) tetrahedra in each cube of a box, one for each order of the axes, int32 [n, 4].

    Args:
        cells: Number of cubes along x, y, z.
        points: Number of grid points along x, y, z; a multiple of ``cells``, plus one. Nodes are numbered by grid
            points, z fastest.
    """
    # The growth of a node's number from one cube to the next along each axis.
    strides = np.array([points[1] * points[2], points[2], 1])
    strides *= [(p - 1) // n for p, n in zip(points, cells, strict=True)]
    corners = np.indices(cells).reshape(3, -1).T @ strides
    return (corners[:, None] + (WALKS @ strides).ravel()).reshape(-1, 4).astype(np.int32)
