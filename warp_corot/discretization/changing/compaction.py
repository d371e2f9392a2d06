"""Reorder the pools by the leaves, so that neighbours in the mesh are neighbours in memory again."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.kernels.remesh import pools as kernels

from .snapshot import CARRIED_BY_NODES, CARRIED_BY_TETRAHEDRA, OF_NODES, OF_TETRAHEDRA

if TYPE_CHECKING:
    from .pools import DeviceForest

Index = npt.NDArray[np.int32]


def compact(forest: DeviceForest) -> None:
    """See ``DeviceForest.compact``. Arrays stay the same ones, so that recorded passes stay valid."""
    pools, arrays = forest.pools, forest.carriage.arrays
    nodes, node_number = _numbering(_nodes_in_order(forest))
    elements, element_number = _numbering(_elements_in_order(forest))
    for struct, names, order in (
        (pools, OF_NODES, nodes),
        (arrays, CARRIED_BY_NODES, nodes),
        (pools, OF_TETRAHEDRA, elements),
        (arrays, CARRIED_BY_TETRAHEDRA, elements),
    ):
        for name in names:
            _permute(getattr(struct, name), order)
    leaves = forest.leaf_count
    for array in (pools.ends, pools.tets, pools.leaf_tets[:leaves]):
        _rename(array, node_number)
    for array in (pools.parent, pools.first_child, pools.leaves[:leaves], pools.void_leaves):
        _rename(array, element_number)
    # The free places are now the last ones; the lowest are used first.
    free_pairs = forest.free_leaves
    if free_pairs:
        first = forest.tree_capacity - 2 * free_pairs
        pools.free_pairs[:free_pairs].assign(np.arange(free_pairs, dtype=np.int32)[::-1] * 2 + first)
    # A round compares with the round in which a node was last touched; after a pass these numbers have no meaning.
    pools.touched.zero_()


def _nodes_in_order(forest: DeviceForest) -> Index:
    """All places for nodes: nodes of leaves in the order in which leaves name them; the others keep their places."""
    nodes, first = np.unique(forest.leaf_tets.ravel(), return_index=True)
    others = np.arange(len(nodes), forest.node_capacity)
    return np.concatenate([nodes[np.argsort(first)], others]).astype(np.int32)


def _elements_in_order(forest: DeviceForest) -> Index:
    """All places for tetrahedra: roots, pairs of the beginning, other pairs, free pairs; each in the order of the first
    leaf below, parents first."""
    pools = forest.pools
    level, parent = pools.level.numpy(), pools.parent.numpy()
    place = np.full(forest.tree_capacity, forest.capacity, np.int64)
    leaves = forest.leaf_elements
    place[leaves] = np.arange(len(leaves))
    for depth in range(int(level.max()), 0, -1):
        below = np.flatnonzero(level == depth)
        np.minimum.at(place, parent[below], place[below])
    firsts = np.arange(pools.roots, forest.tree_capacity, 2)
    used = firsts[level[firsts] != kernels.UNUSED]
    used = used[np.lexsort((level[used], np.minimum(place[used], place[used + 1]), used >= forest.begun_with))]
    pairs = np.concatenate([used, firsts[level[firsts] == kernels.UNUSED]])
    both = np.stack([pairs, pairs + 1], axis=1).ravel()
    return np.concatenate([np.arange(pools.roots), both]).astype(np.int32)


def _numbering(order: Index) -> tuple[Index, Index]:
    """The order, and each place's number in it; -1 and -2 at the end stand for themselves."""
    number = np.empty(len(order) + 2, np.int32)
    number[order] = np.arange(len(order), dtype=np.int32)
    number[-1], number[-2] = -1, -2
    return order, number


def _permute(array: wp.array, order: Index) -> None:
    values = array.numpy()
    values[: len(order)] = values[order]
    array.assign(values)


def _rename(array: wp.array, number: Index) -> None:
    """Replace indices; negative ones stay."""
    array.assign(number[array.numpy()])
