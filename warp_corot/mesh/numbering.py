"""Renumbering of nodes and tetrahedra."""

from __future__ import annotations

import numpy as np

from .tree import LIVE, VOID, Tree


def in_order_of_leaves(tree: Tree) -> np.ndarray:
    """Nodes that live leaves name, in the order in which they first name them: neighbours stay neighbours."""
    touched = tree.leaf_tets.ravel()
    turn = np.arange(len(touched), dtype=np.int64)
    first = np.empty(int(touched.max()) + 1, np.int64)
    # The last write to a place wins, so walk backwards to keep the first value.
    first[touched[::-1]] = turn[::-1]
    return touched[first[touched] == turn]


def with_virtual(real: np.ndarray, tree: Tree, lattice: np.ndarray) -> np.ndarray:
    """The given nodes, followed by all others that the tree names, in the order of their lattice points."""
    named = np.zeros(len(lattice), bool)
    named[tree.tets] = True
    named[real] = False
    others = np.flatnonzero(named)
    return np.concatenate([real, others[np.lexsort(lattice[others].T)]])


def renumbered(order: np.ndarray, ends: np.ndarray, tree: Tree) -> tuple[np.ndarray, Tree]:
    """Ends and tree after node ``order[i]`` becomes node i; nodes that are not in ``order`` disappear."""
    number = np.full(len(ends), -1, np.int32)
    number[order] = np.arange(len(order), dtype=np.int32)
    moved = ends[order]
    moved = np.where(moved < 0, np.int32(-1), number[moved])
    moved.sort(axis=1)
    return moved, Tree(number[tree.tets], tree.level, tree.parent, tree.first_child, tree.cut)


def pruned(tree: Tree, empty: np.ndarray) -> tuple[Tree, np.ndarray]:
    """The tree without the descendants of tetrahedra that hold nothing.

    Args:
        tree: Its leaves are live or void.
        empty: Which void leaves hold nothing at all, bool [M]; two children of one parent become one leaf.

    Returns:
        The tree, and the old tetrahedra that are in it, ascending.
    """
    first_child, empty = tree.first_child.copy(), empty.copy()
    inner = np.flatnonzero(first_child >= 0)
    by_level = np.split(inner[np.argsort(tree.level[inner], kind="stable")], np.cumsum(np.bincount(tree.level[inner])))
    for elements in reversed(by_level):
        child = first_child[elements]
        hollow = elements[empty[child] & empty[child + 1]]
        empty[hollow] = True
        first_child[hollow] = VOID
    kept = np.ones(len(first_child), bool)
    for elements in by_level:
        gone = elements[~kept[elements] | (first_child[elements] < 0)]
        child = tree.first_child[gone]
        kept[child] = kept[child + 1] = False
    stays = np.flatnonzero(kept)
    number = np.cumsum(kept, dtype=np.int32) - 1
    parent, child = tree.parent[stays], first_child[stays]
    parent = np.where(parent < 0, np.int32(-1), number[parent])
    child = np.where(child < 0, child, number[child])
    return Tree(tree.tets[stays], tree.level[stays], parent, child), stays


def by_levels(tree: Tree) -> Tree:
    """The tree with level after level, each in the order of the tree, whatever the order in which it was grown."""
    rows = [np.flatnonzero(tree.parent < 0)]
    while len(inner := rows[-1][tree.first_child[rows[-1]] >= 0]):
        first = tree.first_child[inner]
        rows.append(np.stack([first, first + 1], axis=1).ravel())
    order = np.concatenate(rows)
    place = np.empty(len(order), np.int32)
    place[order] = np.arange(len(order), dtype=np.int32)
    parent, child = tree.parent[order], tree.first_child[order]
    parent, child = (np.where(each < 0, each, place[np.maximum(each, 0)]) for each in (parent, child))
    return Tree(tree.tets[order], tree.level[order], parent, child)


def live_or_void(tree: Tree, live: np.ndarray) -> Tree:
    """The tree in which the leaves in a mask bool [M] are live."""
    leaf = np.where(live, np.int32(LIVE), np.int32(VOID))
    return Tree(tree.tets, tree.level, tree.parent, np.where(tree.first_child < 0, leaf, tree.first_child), tree.cut)
