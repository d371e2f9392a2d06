"""Bisection of some leaves of a forest."""

from __future__ import annotations

from dataclasses import replace
from typing import TypeVar

import numpy as np
import warp as wp

from warp_corot.mesh.forest_arrays import ForestArrays
from warp_corot.mesh.numbering import renumbered, with_virtual
from warp_corot.mesh.tree import VOID, Tree

from .growth import Growth

Forest = TypeVar("Forest", bound=ForestArrays)


def refined(forest: Forest, leaves: np.ndarray) -> Forest:
    """See `TetForest.refine`; leaves by their indices."""
    tree = forest.tree
    growth = Growth(forest.lattice, forest.node_ends, tree, wp.get_device("cpu"))
    wished = np.zeros(growth.element_count, np.uint8)
    wished[tree.leaves[leaves]] = 1
    growth.wished.assign(wished)
    if forest.phi is not None:
        # Leaves that were given up as nearly empty still contain a part of the surface.
        growth.bound.assign((tree.first_child == VOID) & (forest.phi[tree.tets] < 0).any(axis=1))
    growth.close()
    lattice, ends = growth.nodes()
    grown = growth.tree()
    named = np.zeros(len(lattice), bool)
    named[grown.leaf_tets] = True
    named[: forest.node_count] = False
    real = np.concatenate([np.arange(forest.node_count), np.flatnonzero(named)])
    order = with_virtual(real, grown, lattice)
    new_ends, new_tree = renumbered(order, ends, grown)
    whose = _leaves_before(forest.tree, grown)
    return replace(
        forest,
        lattice=lattice[order],
        node_ends=new_ends,
        tree=new_tree,
        phi=None if forest.phi is None else _interpolated(forest.phi, ends)[order],
        node_labels=None if forest.node_labels is None else _first_ends(forest.node_labels, ends)[order],
        fill=None if forest.fill is None else forest.fill[whose],
        labels=None if forest.labels is None else forest.labels[whose],
    )


def _leaves_before(before: Tree, after: Tree) -> np.ndarray:
    """For each leaf, the leaf of the former tree that it is or comes from."""
    found = after.leaves.copy()
    while (new := found >= len(before.level)).any():
        found[new] = after.parent[found[new]]
    number = np.full(len(before.level), -1, np.int32)
    number[before.leaves] = np.arange(len(before.leaves), dtype=np.int32)
    return number[found]


def _interpolated(values: np.ndarray, ends: np.ndarray) -> np.ndarray:
    """Values of the first nodes, and at every later one the mean of its two ends."""
    found = np.full(len(ends), np.nan, values.dtype)
    found[: len(values)] = values
    while len(missing := np.flatnonzero(np.isnan(found))):
        found[missing] = found[ends[missing]].mean(axis=1)
    return found


def _first_ends(values: np.ndarray, ends: np.ndarray) -> np.ndarray:
    """Values of the first nodes, and at every later one that of the end with the lower number."""
    origin = np.arange(len(ends))
    while (new := origin >= len(values)).any():
        origin[new] = ends[origin[new], 0]
    return values[origin]
