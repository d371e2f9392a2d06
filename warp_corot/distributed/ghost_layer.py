"""A rank's part of a forest that ranks have grown together: its own leaves, and copies of other ranks' around its
nodes."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from warp_corot.discretization.groups import group_numbers
from warp_corot.mesh import TetForest
from warp_corot.mesh.numbering import in_order_of_leaves, renumbered, with_virtual

from .divided_mesh import DividedForest, Numbers
from .faces import faces_of
from .parts import part_of_forest
from .rejoining import Arrays, joined_trees, pack_tree
from .root_cube_partition import RootCubePartition, numbered_points, places_of

Ints = npt.NDArray[np.int32]
Longs = npt.NDArray[np.int64]


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

    def branch(kept: npt.NDArray[np.bool_]) -> Arrays:
        """Some leaves with the tree above them, as arrays by number in the whole mesh."""
        forest, points, stays = part_of_forest(own, kept, groups[kept], True)
        inner = np.isin(outer, points[: forest.node_count]).all(axis=1)
        found = pack_tree(forest, forest.tree.leaves, first_row + stays.astype(np.int64), numbers[points])
        found |= {"owner": owner[points], "elements": first + np.flatnonzero(kept), "groups": first + groups[kept]}
        found |= {name: getattr(forest, name) for name in ("fill", "labels") if getattr(forest, name) is not None}
        return found | {"outer": numbers[outer[inner]]}

    given: list[Arrays | None] = [None] * comm.size
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
    return _together(own, branches, node_count=node_count, is_embedded=True, bounds=bounds, **whole)


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


def _together(own: TetForest, branches: list[Arrays], *, node_count: int, **whole: Any) -> DividedForest:
    """The part that branches of different ranks make, in the order of the ranks, the rank's own first."""
    points, rows = (np.unique(np.concatenate([each[name] for each in branches])) for name in ("points", "rows"))
    lattice, ends, tree = joined_trees(branches)
    owner = np.zeros(len(points), np.int32)
    for each in branches:
        owner[np.searchsorted(points, each["points"])] = each["owner"]
    order = with_virtual(in_order_of_leaves(tree), tree, lattice)
    ends, tree = renumbered(order, ends, tree)
    place = np.full(len(points), -1, np.int32)
    place[order] = np.arange(len(order), dtype=np.int32)
    joined: Arrays = {
        name: np.concatenate([each[name] for each in branches])
        for name in ("elements", "groups", "outer", "fill", "labels")
        if name in branches[0]
    }
    nodes, elements = order[: int(tree.leaf_tets.max()) + 1], joined["elements"]
    counted = np.arange(len(elements)) < len(own.tets)
    numbers = Numbers(points[nodes], elements, owner[nodes], counted, node_count, rows, points[order])
    return DividedForest(
        own.cells,
        own.cell_size,
        own.origin,
        lattice[order],
        ends,
        tree,
        own.up_axis,
        fill=joined["fill"],
        labels=joined.get("labels"),
        label_names=own.label_names,
        leaf_groups=np.unique(joined["groups"], return_inverse=True)[1].ravel().astype(np.int32),
        of_whole=whole | {"numbers": numbers, "outer": place[np.searchsorted(points, joined["outer"])]},
    )
