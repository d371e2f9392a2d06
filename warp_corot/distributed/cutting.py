"""A rank's part of a uniformly bisected box, found without the other ranks' parts."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from warp_corot.errors import InputError
from warp_corot.mesh.around import subtrees_around
from warp_corot.mesh.tree import Tree
from warp_corot.mesh.uniform import halvings
from warp_corot.mesh.uniform_part import SUBTREE_DEPTH, uniform_part, vertices_of

from .partition import checked_shares, nobody_empty

Ints = npt.NDArray[np.int32]
Longs = npt.NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Cut:
    """The elements around the nodes that a rank moves, and its own elements.

    Attributes:
        lattice: Grid coordinates of the nodes and the tree's other corners, 2**halvings(level) intervals a cube edge.
        ends, tree: As in ``TetForest``.
        elements: The leaves' numbers in the whole box, int64 [t].
        counted: Which of the leaves this rank counts, bool [t].
        owner: The rank that moves each node, int32 [n].
        keys: A number for each node, from its coordinates, int64 [n].
    """

    lattice: Ints
    ends: Ints
    tree: Tree
    elements: Longs
    counted: npt.NDArray[np.bool_]
    owner: Ints
    keys: Longs


def cut_box(cells: tuple[int, int, int], level: int, ranks: int, rank: int, costs: npt.ArrayLike | None = None) -> Cut:
    """The part that ``Partition`` and ``numbered_part`` make of ``TetForest.box``, with the same order.

    The leaves are divided in subtrees of eight along the order of the tree. A node is moved by the rank of the first
    leaf around it in this order.

    Args:
        cells, level: As for ``TetForest.box``; at least three levels.
        ranks, rank: The number of ranks, and the number of this rank.
        costs: The cost of an element on each rank, in any unit, [ranks]; None: the same everywhere.

    Raises:
        InputError: Fewer subtrees than ranks, or costs that are not positive.
    """
    depth, intervals = level - SUBTREE_DEPTH, 1 << halvings(level)
    starts = dealt_starts(6 * int(np.prod(cells, dtype=object)) << depth, ranks, costs)
    first, end = int(starts[rank]), int(starts[rank + 1])
    own = np.arange(first, end, dtype=np.int64)
    vertices = vertices_of(cells, level, own)
    node, subtree = subtrees_around(vertices, cells, intervals, depth, (first, end))
    is_others = np.zeros(len(vertices), bool)
    is_others[node[subtree < first]] = True
    copies = np.unique(subtree[(subtree >= end) & ~is_others[node]])
    needed = np.concatenate([own, copies])
    lattice, ends, tree = uniform_part(cells, level, needed)
    nodes = lattice[: int(tree.leaf_tets.max()) + 1]
    keys = keys_of(nodes, cells, intervals)
    owner = np.full(len(nodes), rank, np.int32)
    ghosts = np.flatnonzero(~np.isin(keys, keys_of(vertices[~is_others], cells, intervals)))
    place, subtree = subtrees_around(nodes[ghosts], cells, intervals, depth, (0, 0))
    of_first = np.full(len(ghosts), starts[-1])
    np.minimum.at(of_first, place, subtree)
    owner[ghosts] = np.searchsorted(starts, of_first, side="right") - 1
    elements = ((needed << SUBTREE_DEPTH)[:, None] + np.arange(1 << SUBTREE_DEPTH)).ravel()
    counted = np.repeat(needed < end, 1 << SUBTREE_DEPTH)
    return Cut(lattice, ends, tree, elements, counted, owner, keys)


def dealt_starts(subtrees: int, ranks: int, costs: npt.ArrayLike | None) -> Longs:
    """The first subtree of each rank, then the number of subtrees; int64 [ranks + 1].

    Raises:
        InputError: As for ``cut_box``.
    """
    shares = checked_shares(ranks, costs)
    if subtrees < ranks:
        raise InputError(f"the body has {subtrees} groups of elements for {ranks} ranks; take fewer ranks")
    leaves, half = 1 << SUBTREE_DEPTH, 1 << (SUBTREE_DEPTH - 1)
    # A subtree belongs to the rank whose share contains its middle.
    bounds = np.cumsum(shares)[:-1] * (leaves * subtrees)
    starts = np.concatenate([[0], np.ceil((bounds - half) / leaves)]).astype(np.int64)
    return np.append(nobody_empty(starts, subtrees), subtrees)


def keys_of(nodes: Ints, cells: tuple[int, int, int], intervals: int) -> Longs:
    """The places of grid points among all grid points of the box, int64 [n]."""
    _, ny, nz = (np.int64(n * intervals + 1) for n in cells)
    x, y, z = nodes.astype(np.int64).T
    return (x * ny + y) * nz + z
