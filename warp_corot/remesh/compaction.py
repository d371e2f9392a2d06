"""Pools put in the order of the leaves: what is near in the mesh is near in memory again."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import warp as wp

from ..kernels import remesh as kernels

if TYPE_CHECKING:
    from .pools import DeviceForest

Index = npt.NDArray[np.int32]


def compact(forest: DeviceForest) -> None:
    """See ``DeviceForest.compact``. Arrays stay the same ones, so that recorded passes stay valid."""
    pools, arrays = forest.pools, forest.carriage.arrays
    nodes, node_number = _numbering(_nodes_in_order(forest))
    elements, element_number = _numbering(_elements_in_order(forest))
    for name in ("lattice", "valence"):
        _permute(getattr(pools, name), nodes)
    for name in ("u", "v", "load", "mass", "held", "mass32", "inverse_mass"):
        _permute(getattr(arrays, name), nodes)
    for name in ("level", "parent", "first_child", "tets"):
        _permute(getattr(pools, name), elements)
    for name in ("density", "label", "values"):
        _permute(getattr(arrays, name), elements)
    _rename(pools.ends, node_number, nodes)
    _rename(pools.tets, node_number)
    _rename(pools.leaf_tets, node_number)
    _rename(pools.parent, element_number)
    _rename(pools.first_child, element_number)
    _rename(pools.leaves, element_number)
    # What is free are the last places now, and the lowest of them are taken first.
    free_nodes, free_pairs = forest.free_nodes, forest.free_leaves
    _write(pools.free_nodes, np.arange(free_nodes)[::-1] + forest.node_capacity - free_nodes)
    _write(pools.free_pairs, 2 * np.arange(free_pairs)[::-1] + forest.tree_capacity - 2 * free_pairs)
    # Rounds compare with what nodes were touched in; none of it counts after a pass.
    pools.touched.zero_()
    counts = pools.counts.numpy().copy()
    counts[kernels.NODE_TOP] = forest.node_capacity - free_nodes
    pools.counts.assign(counts)


def _nodes_in_order(forest: DeviceForest) -> Index:
    """All places for nodes: those that leaves name as they first do, then other ones in use, then free ones."""
    touched = forest.leaf_tets.ravel()
    nodes, first = np.unique(touched, return_index=True)
    named = nodes[np.argsort(first)]
    rest = np.ones(forest.node_capacity, bool)
    rest[named] = False
    others = np.flatnonzero(rest)
    used = forest.pools.valence.numpy()[others] > 0
    return np.concatenate([named, others[used], others[~used]]).astype(np.int32)


def _elements_in_order(forest: DeviceForest) -> Index:
    """All places for tetrahedra: roots, pairs in the order of the first leaf below, parents first, then free pairs."""
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
    used = used[np.lexsort((level[used], np.minimum(place[used], place[used + 1])))]
    pairs = np.concatenate([used, firsts[level[firsts] == kernels.UNUSED]])
    both = np.stack([pairs, pairs + 1], axis=1).ravel()
    return np.concatenate([np.arange(pools.roots), both]).astype(np.int32)


def _numbering(order: Index) -> tuple[Index, Index]:
    """The order, and each one's number in it; at the end -1 and -2 for themselves."""
    number = np.empty(len(order) + 2, np.int32)
    number[order] = np.arange(len(order), dtype=np.int32)
    number[-1], number[-2] = -1, -2
    return order, number


def _permute(array: wp.array, order: Index) -> None:
    array.assign(array.numpy()[order])


def _rename(array: wp.array, number: Index, order: Any = slice(None)) -> None:
    """Replace indices, negative ones but for themselves."""
    array.assign(number[array.numpy()[order]])


def _write(array: wp.array, values: np.ndarray) -> None:
    whole = array.numpy().copy()
    whole[: len(values)] = values
    array.assign(whole)
