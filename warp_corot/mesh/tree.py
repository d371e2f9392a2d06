"""The trees of a forest: the tetrahedra of all levels, stored, or computed if all leaves have one level."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from warp_corot.mesh.bisection import corner_leaves

#: Stored in place of a first child: a leaf of the mesh, or a leaf outside the body.
LIVE = -1
VOID = -2


@dataclass(frozen=True, eq=False)
class Tree:
    """Every tetrahedron of the forest, roots first, the two children of one parent next to each other.

    Attributes:
        tets: Nodes in Maubach order, int32 [M, 4].
        level: int32 [M].
        parent: Index of the parent, -1 for roots, int32 [M].
        first_child: Index of the first of the two children, ``LIVE`` (-1) for leaves, ``VOID`` (-2) for leaves that lie
            outside the body and not part of the mesh, int32 [M].
        cut: What cuts have separated, as ``kernels.plan.plan.Tree.cut``, int32 [M]; None: nothing.
    """

    tets: np.ndarray
    level: np.ndarray
    parent: np.ndarray
    first_child: np.ndarray
    cut: np.ndarray | None = None

    @cached_property
    def inner_by_level(self) -> list[np.ndarray]:
        """Tetrahedra with children, level by level."""
        inner = np.flatnonzero(self.first_child >= 0)
        inner = inner[np.argsort(self.level[inner], kind="stable")]
        return np.split(inner, np.cumsum(np.bincount(self.level[inner], minlength=1))[:-1])

    @cached_property
    def leaves(self) -> np.ndarray:
        """Live leaves in tree order (each subtree's leaves side by side, first child first), int32 [T]."""
        by_level = self.inner_by_level
        # The number of leaves below each element, from the bottom up; then the place of the first of them.
        count = (self.first_child == LIVE).astype(np.int32)
        for elements in reversed(by_level):
            first = self.first_child[elements]
            count[elements] = count[first] + count[first + 1]
        place = np.zeros(len(count), np.int32)
        roots = np.flatnonzero(self.parent < 0)
        place[roots] = np.cumsum(count[roots]) - count[roots]
        for elements in by_level:
            first = self.first_child[elements]
            place[first] = place[elements]
            place[first + 1] = place[elements] + count[first]
        ends = np.flatnonzero(self.first_child == LIVE)
        leaves = np.empty(len(ends), np.int32)
        leaves[place[ends]] = ends
        return leaves

    @cached_property
    def leaf_tets(self) -> np.ndarray:
        """The leaves' nodes in Maubach order, in tree order, int32 [T, 4]."""
        return self.tets[self.leaves]

    @cached_property
    def leaf_levels(self) -> np.ndarray:
        """Level of each leaf, int32 [T]."""
        return self.level[self.leaves]

    def taken(self, order: np.ndarray) -> Tree:
        """The tree of some tetrahedra, of which none is without its parent or one of two children, in another order."""
        number = np.full(len(self.level), -1, np.int32)
        number[order] = np.arange(len(order), dtype=np.int32)
        parent, child = self.parent[order], self.first_child[order]
        parent = np.where(parent < 0, np.int32(-1), number[parent])
        child = np.where(child < 0, child, number[child]).astype(np.int32)
        return Tree(self.tets[order], self.level[order], parent, child, None if self.cut is None else self.cut[order])

    def rows(self, elements: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Nodes, int32 [n, 4], and levels, int32 [n], of the elements with these indices."""
        return self.tets[elements], self.level[elements]

    def above(self, elements: np.ndarray, steps: int) -> np.ndarray:
        """The ancestor ``steps`` levels above each element, -1 if there is none; int32."""
        found = np.array(elements, dtype=np.int32)
        for _ in range(steps):
            found = np.where(found >= 0, self.parent[found], np.int32(-1))
        return found

    def ancestors(self, elements: np.ndarray, level: int) -> np.ndarray:
        """The ancestor at ``level`` of each element, or the element itself if it is above that level; int32."""
        found = np.array(elements, dtype=np.int32)
        below = np.flatnonzero(self.level[found] > level)
        while len(below):
            found[below] = self.parent[found[below]]
            below = below[self.level[found[below]] > level]
        return found


class UniformTree(Tree):
    """A tree whose leaves all have one level.

    Its elements are ordered by level, and each level is in tree order. So parents, children and levels can be computed,
    and an ancestor's corners are found among those of its leaves. Only the leaves are stored; the attributes of
    ``Tree`` are made on first use. Indices are int64 from 2**31 tetrahedra on.

    Args:
        leaf_tets: The leaves' nodes in Maubach order, in tree order, int32 [T, 4].
        depth: Their level.
    """

    def __init__(self, leaf_tets: np.ndarray, depth: int):
        self.__dict__.update(leaf_tets=leaf_tets)
        self.depth = depth
        roots = len(leaf_tets) >> depth
        #: The first element of each level, and the number of all elements.
        self.starts = roots * (2 ** np.arange(depth + 2, dtype=np.int64) - 1)
        self._index = np.int32 if self.starts[-1] < 2**31 else np.int64

    def __repr__(self) -> str:
        return f"UniformTree({len(self.leaf_tets)} leaves at level {self.depth})"

    @cached_property
    def tets(self) -> np.ndarray:
        tets = np.empty((self.starts[-1], 4), np.int32)
        for level in range(self.depth + 1):
            own = tets[self.starts[level] : self.starts[level + 1]]
            for corner, (leaf, place) in enumerate(corner_leaves(level, self.depth)):
                own[:, corner] = self.leaf_tets[leaf :: 2 ** (self.depth - level), place]
        return tets

    @cached_property
    def level(self) -> np.ndarray:
        return np.repeat(np.arange(self.depth + 1, dtype=np.int32), np.diff(self.starts))

    @cached_property
    def parent(self) -> np.ndarray:
        inner = np.arange(self.starts[-2], dtype=self._index)
        return np.concatenate([np.full(self.starts[1], -1, self._index), np.repeat(inner, 2)])

    @cached_property
    def first_child(self) -> np.ndarray:
        first = np.arange(self.starts[1], self.starts[-1], 2, dtype=self._index)
        return np.concatenate([first, np.full(len(self.leaf_tets), LIVE, self._index)])

    @cached_property
    def leaves(self) -> np.ndarray:
        return np.arange(self.starts[-2], self.starts[-1], dtype=self._index)

    @cached_property
    def leaf_levels(self) -> np.ndarray:
        return np.broadcast_to(np.int32(self.depth), len(self.leaf_tets))

    def rows(self, elements: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        level = self._common_level(elements)
        if level is None:
            return self.tets[elements], self.level[elements]
        below = (elements - self.starts[level]) << (self.depth - level)
        corners = [self.leaf_tets[below + leaf, place] for leaf, place in corner_leaves(level, self.depth)]
        return np.stack(corners, axis=1), np.full(len(elements), level, np.int32)

    def above(self, elements: np.ndarray, steps: int) -> np.ndarray:
        level = self._common_level(elements)
        if level is None:
            return super().above(elements, steps)
        if steps > level:
            return np.full(len(elements), -1, self._index)
        found = np.subtract(elements, self.starts[level], dtype=self._index, casting="unsafe")
        found >>= steps
        found += self._index(self.starts[level - steps])
        return found

    def ancestors(self, elements: np.ndarray, level: int) -> np.ndarray:
        own = self._common_level(elements)
        if own is None:
            return super().ancestors(elements, level)
        return self.above(elements, max(own - level, 0))

    def _common_level(self, elements: np.ndarray) -> int | None:
        """The common level of all elements, if there is one."""
        if not len(elements):
            return 0
        first, last = np.searchsorted(self.starts, [elements.min(), elements.max()], side="right") - 1
        return int(first) if first == last else None


def at_midpoints(values: np.ndarray | None, known: np.ndarray, ends: np.ndarray, *, first: bool = False) -> Any:
    """Values of nodes; those that are not known are the mean of both ends of the edge whose midpoint a node is.

    Args:
        values: Known values; None: there are none.
        known: The place of each node among them, -1 if it is not known [N].
        ends: The ends of each node's edge [N, 2].
        first: Take the first end's value, not the mean.
    """
    if values is None:
        return None
    found = np.zeros(len(known), values.dtype)
    there = known >= 0
    found[there] = values[known[there]]
    while not there.all():
        next_ones = np.flatnonzero(~there & there[ends].all(axis=1))
        at_ends = found[ends[next_ones]]
        found[next_ones] = at_ends[:, 0] if first else at_ends.mean(axis=1)
        there[next_ones] = True
    return found


def numbered(touched: np.ndarray, place_count: int) -> tuple[np.ndarray, np.ndarray]:
    """Number places in the order in which they are first named.

    Returns:
        The number of each place, int32 [place_count] (undefined if nothing names it), and the place of each number.
    """
    number = np.empty(place_count, np.int32)
    turn = np.arange(len(touched), dtype=np.int32)
    # The last write to a place wins, so walk backwards to keep the first value.
    number[touched[::-1]] = turn[::-1]
    place_of = touched[number[touched] == turn]
    number[place_of] = turn[: len(place_of)]
    return number, place_of


def in_order_of_leaves(tree: Tree) -> np.ndarray:
    """Nodes that live leaves name, in the order in which they first name them: neighbours stay neighbours."""
    return numbered(tree.leaf_tets.ravel(), int(tree.leaf_tets.max()) + 1)[1]


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
    if isinstance(tree, UniformTree):
        return moved, UniformTree(number[tree.leaf_tets], tree.depth)
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
    by_level = tree.inner_by_level
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
    return Tree(tree.tets, tree.level, tree.parent, first_child).taken(stays), stays


def by_levels(tree: Tree) -> Tree:
    """The tree with level after level, each in the order of the tree, whatever the order in which it was grown."""
    rows = [np.flatnonzero(tree.parent < 0)]
    while len(inner := rows[-1][tree.first_child[rows[-1]] >= 0]):
        first = tree.first_child[inner]
        rows.append(np.stack([first, first + 1], axis=1).ravel())
    return tree.taken(np.concatenate(rows))


def live_or_void(tree: Tree, live: np.ndarray) -> Tree:
    """The tree in which the leaves in a mask bool [M] are live."""
    leaf = np.where(live, np.int32(LIVE), np.int32(VOID))
    return Tree(tree.tets, tree.level, tree.parent, np.where(tree.first_child < 0, leaf, tree.first_child), tree.cut)
