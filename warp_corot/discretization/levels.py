"""The nodes of a forest by tree level, found only from their lattice points.

The mesh of level l is all tetrahedra of level l that have leaves below them or are leaves, and all leaves above that
level. Every node but a root's corner is the midpoint of an edge of the next coarser level, so a function that is linear
in each tetrahedron of a level is, at the nodes that the next level adds, the mean of two values.

Let t be the smallest number of trailing zero bits of the nonzero coordinates of a node's lattice point. Three levels
halve the edges, and within three the first midpoints are those of a cube's diagonals, then of its faces' diagonals,
then of its edges: on one, two or all three axes the point is odd in units of 2^t. So t and the number of these axes
give the level.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.mesh.lattice import LATTICE_BITS, MAX_LEVEL

from .sizes import Sizes

Ints = npt.NDArray[np.int32]


def level_of_points(lattice: Ints) -> npt.NDArray[np.int8]:
    """The level of the node at each lattice point [n, 3], 0 for corners of roots."""
    together = np.bitwise_or.reduce(lattice, axis=1)
    lowest = together & -together
    odd = np.count_nonzero(lattice & lowest[:, None], axis=1)
    level = MAX_LEVEL + 1 - odd - 3 * np.bitwise_count(np.maximum(lowest, 1) - 1).astype(np.int64)
    return np.where((lowest == 0) | (lowest >= 1 << LATTICE_BITS), 0, level).astype(np.int8)


class Levels:
    """The nodes of one world by level with the ends of their edges, in arrays on the device.

    The mesh's nodes keep their numbers 0 … N - 1. If parts of the forest are void, ancestors of leaves may have corners
    that belong to no leaf: these follow, and are unknowns of coarse levels only.

    A multigrid cycle over all levels or every third needs the nodes of each level: ``nodes[: starts[level + 1]]`` are
    the nodes up to a level.

    Args:
        lattice: Lattice points of the N nodes of leaves, and of all nodes of no leaf, int32 [n, 3].
        ends: The two ends of the edge whose midpoint each of them is, in the mesh's own numbering, int32 [n, 2];
            -1, -1 for corners of roots.
        first_other: The number of the first node of no leaf there.
        sizes: The numbers of nodes and worlds.
        device: Where the arrays are.

    Attributes:
        version: ``sizes.version`` of the mesh whose levels these are.
        worlds, device: The number of copies of the mesh in nodal arrays, and their device.
        mesh_nodes: N, the number of nodes of leaves.
        node_count: All nodes, M.
        depth: The finest level of a node.
        others: Where the nodes N … M - 1 stand in the mesh's own numbering, among ``TetForest.lattice_points`` or in
            the pools, ascending, int32 [M - N].
        nodes: All nodes by level, in a level by number, int32 [M].
        starts: Where each level's nodes begin in ``nodes``, and where the last level's end; [depth + 2].
        ends: Both ends of each node's edge, vec2i [M], in the order of ``nodes``; -1, -1 for corners of roots.
    """

    def __init__(self, lattice: Ints, ends: Ints, first_other: int, sizes: Sizes, device: wp.Device):
        self.device, self.worlds, self.version = device, sizes.worlds, sizes.version
        self.mesh_nodes = count = sizes.world_nodes
        ends = np.where(ends < first_other, ends, ends - (first_other - count))
        # Nodes of no leaf that are ends of the others, and so on upwards.
        named = np.arange(len(lattice)) < count
        found = ends[:count]
        while len(found := np.unique(found[found >= count])):
            found = found[~named[found]]
            named[found] = True
            found = ends[found]
        place = np.flatnonzero(named)
        number = np.cumsum(named, dtype=np.int32) - 1
        level = level_of_points(lattice[place])
        order = np.argsort(level, kind="stable")
        self.node_count, self.depth = len(place), int(level.max())
        self.starts = (0, *np.cumsum(np.bincount(level)).tolist())
        of_nodes = number[ends[place[order]]]
        of_nodes[: self.starts[1]] = -1
        self.others = wp.array(place[count:] + (first_other - count), dtype=wp.int32, device=device)
        self.nodes = wp.array(order, dtype=wp.int32, device=device)
        self.ends = wp.array(of_nodes, dtype=wp.vec2i, device=device)

    def __repr__(self) -> str:
        return f"Levels({self.node_count} nodes of levels 0 to {self.depth} on {self.device})"
