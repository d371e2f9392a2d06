"""The forest of bisected tetrahedra: a grid of cubes, six path tetrahedra each, every one the root of a binary tree.

Tetrahedra are bisected by Maubach's rule (``bisection``; Maubach 1995; Tagawa et al. 2013). Vertices lie on an integer
lattice. The tree knows every ancestor; the leaves are the mesh. All is built with array operations.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from ..errors import InputError
from ..indices import checked_indices
from .bisection import children, far_end
from .tree import Tree, UniformTree
from .uniform import halvings, uniform_leaves

#: A root cube has 2**LATTICE_BITS lattice intervals a side, so levels may go to 3 * LATTICE_BITS.
LATTICE_BITS = 16
MAX_LEVEL = 3 * LATTICE_BITS

#: Leaves are numbered in 32 bits.
MAX_LEAVES = 2**31 - 1


@dataclass(frozen=True, eq=False)
class TetForest:
    """A conforming mesh of right-angled tetrahedra of three shapes, the leaves of a forest of binary trees.

    Attributes:
        cells: Number of root cubes along x, y, z.
        cell_size: Edge length of a root cube [m].
        origin: Position of the lattice's point (0, 0, 0) [m].
        lattice: Lattice coordinates of the nodes, 2**16 intervals a cube edge, int32 [N, 3].
        node_ends: The two ends of the edge whose midpoint a node is, the lower number first; -1, -1 for corners of
            cubes; int32 [N, 2].
        tree: All tetrahedra of all levels.
        up_axis: "X", "Y" or "Z".
    """

    cells: tuple[int, int, int]
    cell_size: float
    origin: tuple[float, float, float]
    lattice: np.ndarray
    node_ends: np.ndarray
    tree: Tree
    up_axis: str = "Y"

    @classmethod
    def box(
        cls,
        cells: tuple[int, int, int] = (1, 1, 1),
        cell_size: float = 1.0,
        level: int = 0,
        *,
        origin: tuple[float, float, float] = (0.0, 0.0, 0.0),
        up_axis: str = "Y",
    ) -> TetForest:
        """A box of root cubes, uniformly bisected.

        Args:
            cells: Number of root cubes along x, y, z, each at least 1.
            cell_size: Edge length of a root cube [m].
            level: How often every root is bisected, 0 to 48; three levels halve the edge length.
            origin: Lower corner of the box [m].
            up_axis: Which axis points up where results are drawn.

        Raises:
            InputError: An argument is out of its range, or there would be 2**31 tetrahedra or more.
        """
        cells = _checked_cells(cells)
        if not (np.isfinite(cell_size) and cell_size > 0):
            raise InputError(f"cell_size is {cell_size}; it must be a positive length in metres")
        if level != int(level) or not 0 <= level <= MAX_LEVEL:
            raise InputError(f"level is {level}; it must be a whole number from 0 to {MAX_LEVEL}")
        if up_axis not in ("X", "Y", "Z"):
            raise InputError(f"up_axis is {up_axis!r}; it must be 'X', 'Y' or 'Z'")
        corners = np.asarray(origin, dtype=float)
        if corners.shape != (3,) or not np.isfinite(corners).all():
            raise InputError(f"origin is {origin}; it must be three finite coordinates in metres")
        level = int(level)
        count = 6 * math.prod(cells) << level
        if count > MAX_LEAVES:
            raise InputError(f"level is {level}: that is {count} tetrahedra; there can be {MAX_LEAVES} at most")
        lattice, ends, tets = uniform_leaves(cells, level)
        lattice <<= LATTICE_BITS - halvings(level)
        x, y, z = (float(c) for c in corners)
        return cls(cells, float(cell_size), (x, y, z), lattice, ends, UniformTree(tets, level), up_axis)

    @cached_property
    def points(self) -> np.ndarray:
        """Rest positions of the nodes [m], float64 [N, 3]."""
        return np.asarray(self.origin) + self.lattice * (self.cell_size / 2**LATTICE_BITS)

    @cached_property
    def tets(self) -> np.ndarray:
        """The leaves' nodes in Maubach order, in tree order, int32 [T, 4]."""
        return self.tree.leaf_tets

    @cached_property
    def levels(self) -> np.ndarray:
        """Level of each leaf, int32 [T]; of uniform leaves one number seen T times, which takes no memory."""
        return self.tree.leaf_levels

    @cached_property
    def volumes(self) -> np.ndarray:
        """Rest volume of each leaf [m^3], float64 [T], of uniform leaves as ``levels``."""
        level = np.arange(MAX_LEVEL + 1)
        h = self.cell_size * 0.5 ** (level // 3)
        volume = h**3 / np.array([6.0, 12.0, 24.0])[level % 3]
        if isinstance(self.tree, UniformTree):
            return np.broadcast_to(volume[self.tree.depth], self.levels.shape)
        return volume[self.levels]

    def ancestors(self, level: int) -> np.ndarray:
        """For each leaf the tetrahedron of the tree at ``level`` above it, or the leaf itself; indices int32 [T]."""
        return self.tree.ancestors(self.tree.leaves, level)

    def refine(self, leaves: npt.ArrayLike) -> TetForest:
        """A forest in which the chosen leaves are bisected, and as many others as conformity asks for.

        A leaf with an active midpoint on any edge must be bisected itself, until none has (the closure of the set of
        midpoints). Nodes keep their numbers; new ones are appended.

        Args:
            leaves: Mask bool [T] or indices into the leaves.

        Raises:
            InputError: Not a mask or indices of leaves, or a leaf already at the deepest level.
        """
        chosen = checked_indices(leaves, len(self.tets), "leaf")
        growing = _Growth.of_forest(self)
        wanted = np.unique(growing.edge_keys(growing.refinement_edges(self.tree.leaves[chosen])))
        active = np.union1d(wanted, growing.edge_keys(self.node_ends[self.node_ends[:, 0] >= 0]))
        while True:
            current = growing.leaves()
            tets = growing.tets()[current]
            edges = np.stack([growing.edge_keys(tets[:, [i, j]]) for i, j in itertools.combinations(range(4), 2)], 1)
            broken = current[np.isin(edges, active).any(axis=1)]
            if not len(broken):
                break
            active = np.union1d(active, growing.edge_keys(growing.refinement_edges(broken)))
            growing.bisect(broken)
        lattice, ends, tree = growing.finished()
        return TetForest(self.cells, self.cell_size, self.origin, lattice, ends, tree, self.up_axis)


def _checked_cells(cells: tuple[int, int, int]) -> tuple[int, int, int]:
    counts = np.asarray(cells)
    limit = 2 ** (31 - LATTICE_BITS) - 1
    if counts.shape != (3,) or not np.issubdtype(counts.dtype, np.integer) or counts.min() < 1 or counts.max() > limit:
        raise InputError(f"cells is {cells}; it must be three whole numbers from 1 to {limit}")
    x, y, z = (int(c) for c in counts)
    return x, y, z


class _Growth:
    """A forest being grown: lists of chunks that each bisection appends to."""

    def __init__(self, lattice, ends, tets, level, parent, first_child):
        self._lattice = [lattice]
        self._ends = [ends]
        self._tets = [tets]
        self._level = [level]
        self._parent = [parent]
        self._first_child = first_child
        self._nodes = len(lattice)

    @classmethod
    def of_forest(cls, forest: TetForest) -> _Growth:
        tree = forest.tree
        return cls(forest.lattice, forest.node_ends, tree.tets, tree.level, tree.parent, tree.first_child.copy())

    def tets(self) -> np.ndarray:
        return _merged(self._tets)

    def leaves(self) -> np.ndarray:
        return np.flatnonzero(self._first_child < 0).astype(np.int32)

    def refinement_edges(self, elements: np.ndarray) -> np.ndarray:
        """End nodes x0, xk of the edge on which each element is bisected [n, 2]."""
        tets, level = self.tets()[elements], _merged(self._level)[elements]
        k = far_end(level % 3)
        return np.stack([tets[:, 0], tets[np.arange(len(tets)), k]], axis=1)

    @staticmethod
    def edge_keys(ends: np.ndarray) -> np.ndarray:
        """One integer for each unordered pair of nodes, whatever nodes are added later."""
        low = ends.min(axis=1).astype(np.int64)
        return (low << 32) | ends.max(axis=1)

    def bisect(self, elements: np.ndarray) -> None:
        """Bisect the elements, making the midpoints that are not there yet."""
        tets, level = self.tets()[elements], _merged(self._level)[elements]
        if len(level) and level.max() >= MAX_LEVEL:
            raise InputError(f"a tetrahedron is already at level {MAX_LEVEL}, the deepest that the lattice can hold")
        middle = self._midpoints(self.refinement_edges(elements))
        both = np.empty((len(tets), 2, 4), np.int32)
        for kind in range(3):
            chosen = np.flatnonzero(level % 3 == kind)
            both[chosen] = children(tets[chosen], middle[chosen], kind)
        count = len(self._first_child)
        self._first_child[elements] = count + 2 * np.arange(len(elements), dtype=np.int32)
        self._first_child = np.concatenate([self._first_child, np.full(2 * len(elements), -1, np.int32)])
        self._tets.append(both.reshape(-1, 4))
        self._level.append(np.repeat(level + 1, 2))
        self._parent.append(np.repeat(elements, 2))

    def _midpoints(self, edges: np.ndarray) -> np.ndarray:
        """The node at the middle of each edge, made where there is none yet; int32."""
        keys, which = np.unique(self.edge_keys(edges), return_inverse=True)
        ends = np.stack([keys >> 32, keys & 0xFFFFFFFF], axis=1).astype(np.int32)
        node = np.full(len(keys), -1, np.int32)
        all_ends = _merged(self._ends)
        inner = np.flatnonzero(all_ends[:, 0] >= 0)
        known = self.edge_keys(all_ends[inner])
        order = np.argsort(known)
        if len(known):
            at = np.minimum(np.searchsorted(known, keys, sorter=order), len(known) - 1)
            there = known[order[at]] == keys
            node[there] = inner[order[at[there]]]
        new = np.flatnonzero(node < 0)
        node[new] = self._nodes + np.arange(len(new), dtype=np.int32)
        lattice = _merged(self._lattice)
        self._lattice.append((lattice[ends[new, 0]] + lattice[ends[new, 1]]) // 2)
        self._ends.append(ends[new])
        self._nodes += len(new)
        return node[which]

    def finished(self) -> tuple[np.ndarray, np.ndarray, Tree]:
        tree = Tree(_merged(self._tets), _merged(self._level), _merged(self._parent), self._first_child)
        return _merged(self._lattice), _merged(self._ends), tree


def _merged(chunks: list[np.ndarray]) -> np.ndarray:
    """All chunks as one array, and the list shortened to it."""
    if len(chunks) > 1:
        chunks[:] = [np.concatenate(chunks)]
    return chunks[0]
