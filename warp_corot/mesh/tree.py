"""The trees of a forest: the tetrahedra of all levels, stored, or computed if all leaves have one level."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from .bisection import corner_leaves

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
        cut: What cuts have separated, as ``kernels.plan.tree.Tree.cut``, int32 [M]; None: nothing.
    """

    tets: np.ndarray
    level: np.ndarray
    parent: np.ndarray
    first_child: np.ndarray
    cut: np.ndarray | None = None

    @cached_property
    def leaves(self) -> np.ndarray:
        """Live leaves in tree order (each subtree's leaves side by side, first child first), int32 [T]."""
        inner = np.flatnonzero(self.first_child >= 0)
        inner = inner[np.argsort(self.level[inner], kind="stable")]
        by_level = np.split(inner, np.cumsum(np.bincount(self.level[inner])))
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
