"""A rank's part of a forest that ranks have grown together: its own leaves, and copies of other ranks' around its
nodes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from warp_corot.discretization.groups import group_numbers
from warp_corot.mesh import TetForest, Tree
from warp_corot.mesh.numbering import in_order_of_leaves, renumbered, with_virtual

from .divided_mesh import DividedForest, Numbers
from .faces import faces_of
from .parts import part_of_forest
from .root_cube_partition import RootCubePartition, numbered_points, places_of

Ints = npt.NDArray[np.int32]
Longs = npt.NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Branch:
    """Some leaves of one rank with the tree above them.

    Attributes:
        forest: These, with the groups of the leaves.
        keys: A key for each lattice point, int64.
        numbers, owner: Each lattice point's number in the whole mesh, and the rank that moves it if it is a node; int64
            and int32.
        elements: The leaves' numbers in the whole mesh, int64 [t].
        tree: The numbers that the tetrahedra of all levels have in the whole forest, int64.
        outer: The triangles on the surface of the whole mesh, by the forest's nodes, int32 [F, 3].
    """

    forest: TetForest
    keys: Longs
    numbers: Longs
    owner: Ints
    elements: Longs
    tree: Longs
    outer: Ints


def joined(own: TetForest, partition: RootCubePartition) -> DividedForest:
    """This rank's part of the mesh that all ranks' leaves make together; all ranks must call this.

    Args:
        own: The forest of this rank's root cubes, at least one leaf, with all levels in the order of the tree.
        partition: The cubes of each rank.
    """
    comm = partition.comm
    leaves, rows = (comm.allgather(len(each)) for each in (own.tets, own.tree.level))
    first, first_row = sum(leaves[: comm.rank]), sum(rows[: comm.rank])
    keys = partition.keys(own.lattice)
    owner = _owners(own, keys, partition)
    numbers, node_count = numbered_points(owner, keys, comm)
    groups = group_numbers(own, np.arange(len(own.tets)))
    outer = faces_of(own.tets, own.lattice, first, partition).outer

    def branch(kept: npt.NDArray[np.bool_]) -> Branch:
        forest, points, stays = part_of_forest(own, kept, groups[kept], True)
        place = np.full(len(own.lattice), -1, np.int32)
        place[points[: forest.node_count]] = np.arange(forest.node_count, dtype=np.int32)
        there = place[outer]
        return Branch(
            forest,
            keys[points],
            numbers[points],
            owner[points],
            first + np.flatnonzero(kept),
            first_row + stays.astype(np.int64),
            there[(there >= 0).all(axis=1)],
        )

    given: list[Branch | None] = [None] * comm.size
    # The first rank around a node moves it, so that copies go to ranks before this one.
    for rank in range(comm.rank):
        kept = np.isin(groups, groups[(owner == rank)[own.tets].any(axis=1)])
        given[rank] = branch(kept) if kept.any() else None
    taken = comm.alltoall(given)
    branches = [branch(np.ones(len(own.tets), bool)), *(each for each in taken if each is not None)]
    volumes = own.volumes
    told = comm.allgather((len(volumes), float(volumes.min()), own.points.min(axis=0), own.points.max(axis=0)))
    counts, smallest, low, high = zip(*told, strict=True)
    whole = {"element_count": sum(counts), "smallest_volume": min(smallest)}
    bounds = np.array([np.min(low, axis=0), np.max(high, axis=0)])
    return _together(branches, node_count=node_count, is_embedded=True, bounds=bounds, **whole)


def _owners(own: TetForest, keys: Longs, partition: RootCubePartition) -> Ints:
    """The rank that moves each lattice point, the first with a leaf around it; if no leaf has it, the first rank that
    has it, plus the number of ranks; int32."""
    comm = partition.comm
    claim = np.full(len(keys), comm.rank + comm.size, np.int32)
    claim[: own.node_count] = comm.rank
    owner = claim.copy()
    places = partition.shared(own.lattice)
    taken = comm.alltoall([(keys[each], claim[each]) for each in places])
    for mine, (their_keys, claims) in zip(places, taken, strict=True):
        found = places_of(keys[mine], their_keys)
        both = found >= 0
        owner[mine[both]] = np.minimum(owner[mine[both]], claims[found[both]])
    return owner


def _together(branches: list[Branch], *, node_count: int, **whole: Any) -> DividedForest:
    """The part that branches of different ranks make, in the order of the ranks, the rank's own first."""
    forests = [each.forest for each in branches]
    keys, place, inverse = np.unique(
        np.concatenate([each.keys for each in branches]), return_index=True, return_inverse=True
    )
    number = inverse.ravel().astype(np.int32)
    lattice = np.concatenate([each.lattice for each in forests])[place]
    numbers = np.concatenate([each.numbers for each in branches])[place]
    owner = np.concatenate([each.owner for each in branches])[place]
    firsts = np.cumsum([0, *(len(each.lattice) for each in forests)])
    ends = np.full((len(keys), 2), -1, np.int32)
    for forest, first in zip(forests, firsts, strict=False):
        known = np.flatnonzero(forest.node_ends[:, 0] >= 0)
        ends[number[first + known]] = number[first + forest.node_ends[known]]
    outer = np.concatenate([number[first + each.outer] for each, first in zip(branches, firsts, strict=False)])
    tree, rows = _one_tree(forests, [number[int(first) :] for first in firsts[:-1]])
    order = with_virtual(in_order_of_leaves(tree), tree, lattice)
    ends, tree = renumbered(order, ends, tree)
    place = np.full(len(keys), -1, np.int32)
    place[order] = np.arange(len(order), dtype=np.int32)
    count = int(tree.leaf_tets.max()) + 1
    elements = np.concatenate([each.elements for each in branches])
    groups: list[Ints] = []
    before = 0
    for forest in forests:
        assert forest.leaf_groups is not None
        groups.append((forest.leaf_groups + before).astype(np.int32))
        before += int(forest.leaf_groups.max()) + 1
    of_whole = Numbers(
        numbers[order[:count]],
        elements,
        owner[order[:count]],
        np.arange(len(elements)) < len(branches[0].elements),
        node_count,
        np.arange(count, dtype=np.int32),
        np.arange(len(elements), dtype=np.int32),
        tree=np.concatenate([each.tree for each in branches])[rows],
        lattice=numbers[order],
    )
    one = forests[0]
    return DividedForest(
        one.cells,
        one.cell_size,
        one.origin,
        lattice[order],
        ends,
        tree,
        one.up_axis,
        fill=np.concatenate([each.fill for each in forests]),
        labels=_together_or_none([each.labels for each in forests]),
        label_names=one.label_names,
        leaf_groups=np.concatenate(groups),
        numbers=of_whole,
        outer=place[outer],
        **whole,
    )


def _together_or_none(values: list[Ints | None]) -> Ints | None:
    """Arrays one after another; None if they are None."""
    there = [each for each in values if each is not None]
    return np.concatenate(there) if there else None


def _one_tree(forests: list[TetForest], nodes: list[Ints]) -> tuple[Tree, npt.NDArray[np.intp]]:
    """One tree of the tetrahedra of several forests, level after level, with other numbers of their nodes; and the
    place of each row among all forests' rows."""
    trees = [each.tree for each in forests]
    firsts = np.cumsum([0, *(len(each.level) for each in trees)])
    level = np.concatenate([each.level for each in trees])
    order = np.argsort(level, kind="stable")
    place = np.empty(len(order), np.int32)
    place[order] = np.arange(len(order), dtype=np.int32)

    def moved(values: Ints, first: int) -> Ints:
        return np.where(values < 0, values, place[first + np.maximum(values, 0)]).astype(np.int32)

    tets, parent, child = (
        np.concatenate(each)[order]
        for each in (
            [number[tree.tets] for tree, number in zip(trees, nodes, strict=True)],
            [moved(tree.parent, first) for tree, first in zip(trees, firsts, strict=False)],
            [moved(tree.first_child, first) for tree, first in zip(trees, firsts, strict=False)],
        )
    )
    return Tree(tets, level[order], parent, child), order
