"""The mesh of a forest at a coarser level: all ancestors of that level, and all leaves above it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from .bisection import corner_leaves
from .tree import LIVE, VOID, Tree, UniformTree, renumbered, with_virtual

if TYPE_CHECKING:
    from .forest import TetForest


@dataclass(frozen=True, eq=False)
class Coarser:
    """A coarser mesh of a forest, without its filled shares, labels and surface.

    Attributes:
        forest: The coarser mesh.
        nodes: The place of each of its nodes among the lattice points of the finer forest, [N].
        leaves: For each leaf of the finer forest the leaf of the coarser one that it is or lies in, [T].
    """

    forest: TetForest
    nodes: np.ndarray
    leaves: np.ndarray


def coarser(forest: TetForest, level: int) -> Coarser:
    """The mesh of all ancestors of ``level`` and all leaves above it; the level of some leaf must be larger."""
    tree = _uniform(forest.tree, level) if isinstance(forest.tree, UniformTree) else _cut(forest.tree, level)
    above = forest.tree.ancestors(forest.tree.leaves, level)
    starts_subtree = np.concatenate([[True], above[1:] != above[:-1]])
    leaves = np.cumsum(starts_subtree) - 1
    named = np.zeros(len(forest.lattice), bool)
    named[tree.leaf_tets] = True
    real = np.flatnonzero(named)
    order = real if isinstance(tree, UniformTree) else with_virtual(real, tree, forest.lattice)
    ends, tree = renumbered(order, forest.node_ends, tree)
    made = replace(
        forest,
        lattice=forest.lattice[order],
        node_ends=ends,
        tree=tree,
        phi=None,
        fill=None,
        labels=None,
        node_labels=None,
        label_names=(),
        detail=None,
        leaf_groups=None,
    )
    return Coarser(made, order[: len(real)], leaves)


def _uniform(tree: UniformTree, level: int) -> UniformTree:
    step = 2 ** (tree.depth - level)
    corners = [tree.leaf_tets[leaf::step, place] for leaf, place in corner_leaves(level, tree.depth)]
    return UniformTree(np.stack(corners, axis=1), level)


def _cut(tree: Tree, level: int) -> Tree:
    """The tree without the tetrahedra below a level."""
    kept, first_child = np.flatnonzero(tree.level <= level), tree.first_child.copy()
    lowest = (tree.level == level) & (first_child >= 0)
    live = np.zeros(len(first_child), bool)
    live[tree.ancestors(tree.leaves, level)] = True
    first_child[lowest] = np.where(live[lowest], LIVE, VOID)
    return Tree(tree.tets, tree.level, tree.parent, first_child).taken(kept)
