"""The nodes of a forest by tree level, and the transfers between levels.

The mesh of level l is all tetrahedra of level l that have leaves below them or are leaves, and all leaves above that
level. Every node but a root's corner is the midpoint of an edge of the next coarser level, so a function that is linear
in each tetrahedron of a level is, at the nodes that the next level adds, the mean of two values.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from warp_corot.errors import InputError
from warp_corot.kernels.elements.elements import ForestElements
from warp_corot.kernels.meshing.growth import gather_flagged
from warp_corot.kernels.plan import levels as kernels
from warp_corot.kernels.plan.levels import average_ends, gather_midpoints
from warp_corot.mesh import TetForest
from warp_corot.mesh.lattice import LATTICE_BITS, MAX_LEVEL

from .elements import Mesh
from .sizes import Sizes

#: Bits of a level in a key.
LEVEL_BITS = MAX_LEVEL.bit_length()


@dataclass(frozen=True, eq=False)
class TreeNodes:
    """The nodes of a forest in the mesh's numbering: nodes of leaves are 0 … N - 1.

    Attributes:
        lattice: Lattice points, vec3i.
        ends: The two ends of the edge whose midpoint each node is, vec2i; -1, -1 for corners of roots.
        mesh_nodes: N.
        first_other: The first node of no leaf.
        other_count: Number of nodes of no leaf.
    """

    lattice: wp.array
    ends: wp.array
    mesh_nodes: int
    first_other: int
    other_count: int

    @classmethod
    def of_mesh(cls, mesh: Mesh, device: wp.Device) -> TreeNodes:
        """The levels of a mesh on the host.

        Raises:
            InputError: A general mesh.
        """
        if not isinstance(mesh, TetForest):
            raise InputError(f"only a TetForest has levels; this mesh is a {type(mesh).__name__}, which has no tree")
        count, total = mesh.node_count, len(mesh.lattice)
        lattice = wp.array(mesh.lattice, dtype=wp.vec3i, device=device)
        return cls(lattice, wp.array(mesh.node_ends, dtype=wp.vec2i, device=device), count, count, total - count)


class Levels:
    """The nodes of one world by level with the ends of their edges, in arrays on the device.

    The mesh's nodes keep their numbers 0 … N - 1. If parts of the forest are void, ancestors of leaves may have corners
    that belong to no leaf: these follow, and are unknowns of coarse levels only.

    A multigrid cycle over all levels or every third needs the nodes of each level: ``nodes[: starts[level + 1]]`` are
    the nodes up to a level.

    Args:
        tree: The nodes.
        elements: The leaves as ``kernels.elements.elements.ForestElements``, the first world's first.
        sizes: Numbers of leaves in one world, and of worlds.

    Attributes:
        version: ``sizes.version`` of the mesh whose levels these are.
        worlds, device: The number of copies of the mesh in nodal arrays, and their device.
        mesh_nodes: N, the number of nodes of leaves.
        node_count: All nodes, M.
        depth: The finest level of a node.
        others: Where the nodes N … M - 1 stand in the mesh's own numbering, among ``TetForest.lattice_points`` or in
            the pools, ascending, int32 [M - N].
        nodes: All nodes by level, in a level by number, int32 [M].
        starts: Where each level's nodes begin in ``nodes``, and where the last level's end; [depth + 2].
        ends: Both ends of each node's edge, vec2i [M], in the order of ``nodes``; -1, -1 for corners of roots.
        finest: The finest level of the tetrahedra around each node that are leaves or have leaves below them, int32
            [M], by number. Tetrahedra of level l touch the nodes of level l and coarser that have l or more here.
        coarse: For each level in turn the coarser nodes that are ends of its nodes' edges, in a level by number, int32
            [K].
        coarse_starts: Where each level's begin in ``coarse``, and where the last level's end; [depth + 2].
        midpoint_starts: Where the midpoints of each of ``coarse`` begin, and where the last one's end, int32 [K + 1].
        midpoints: For each of ``coarse`` the level's nodes on whose edges it is an end, by number, int32
            [2 * (M - starts[1])].
    """

    def __init__(self, tree: TreeNodes, elements: ForestElements, sizes: Sizes):
        self.device, self.worlds, self.version = tree.lattice.device, sizes.worlds, sizes.version
        self.mesh_nodes = tree.mesh_nodes
        self.others, numbers = self._find_others(tree)
        self.node_count = tree.mesh_nodes + len(self.others)
        level, starts = self._sort_nodes(tree)
        keys = self._sort_ends(tree, level, numbers)
        self._list_coarse(keys, starts)
        self.finest = wp.zeros(self.node_count, dtype=wp.int32, device=self.device)
        self._launch(kernels.finest_of_leaves, sizes.world_elements, [elements.nodes, elements.code], [self.finest])
        roots = self.starts[1]
        self._launch(kernels.finest_of_edges, self.node_count - roots, [roots, level, self.ends], [self.finest])

    def __repr__(self) -> str:
        return f"Levels({self.node_count} nodes of levels 0 to {self.depth} on {self.device})"

    def prolongate(self, x: wp.array, coarse: int = 0, fine: int | None = None) -> None:
        """Extend a function linearly from the nodes up to a level: a finer node gets the mean of its edge's ends.

        May be recorded.

        Args:
            x: vec4 [worlds * M], changed in place at nodes of the levels coarse + 1 … fine.
            coarse: The level at which all nodes have values.
            fine: The level up to which values are found; None: the finest.

        Raises:
            InputError: The levels are not in order, or the array has too few nodes.
        """
        for level in self._levels_between(x, "x", coarse, fine):
            part = slice(self.starts[level], self.starts[level + 1])
            inputs = [self.node_count, self.nodes[part], self.ends[part]]
            self._launch(average_ends, (self.worlds, part.stop - part.start), inputs, [x])

    def restrict(self, y: wp.array, coarse: int = 0, fine: int | None = None) -> None:
        """The transpose of ``prolongate``: add values at finer nodes to the nodes up to a level, finest level first.

        Sums have a fixed order, so that they are the same bit by bit. May be recorded.

        Args:
            y: vec4 [worlds * M], changed in place at nodes up to the level fine - 1. The result is at the nodes up to
                the level coarse; values that remain at finer nodes are intermediate sums.
            coarse, fine: As for ``prolongate``.

        Raises:
            InputError: As ``prolongate``.
        """
        for level in reversed(self._levels_between(y, "y", coarse, fine)):
            first, last = self.coarse_starts[level], self.coarse_starts[level + 1]
            inputs = [self.node_count, self.coarse[first:last], self.midpoint_starts[first : last + 1], self.midpoints]
            self._launch(gather_midpoints, (self.worlds, last - first), inputs, [y])

    # --- pieces ------------------------------------------------------------------------------------------------------

    def _levels_between(self, array: wp.array, name: str, coarse: int, fine: int | None) -> range:
        fine = self.depth if fine is None else fine
        if not 0 <= coarse <= fine <= self.depth:
            raise InputError(f"coarse is {coarse} and fine is {fine}; they must be in order, from 0 to {self.depth}")
        if len(array) < self.worlds * self.node_count:
            raise InputError(f"{name} has {len(array)} places; it must have {self.worlds} * {self.node_count}")
        return range(coarse + 1, fine + 1)

    def _find_others(self, tree: TreeNodes) -> tuple[wp.array, wp.array]:
        """Places of the nodes that are ends of others but belong to no leaf, and the inclusive sum of flags of these
        places.
        """
        flags, sums = self._ints(tree.other_count), self._ints(tree.other_count)
        if tree.other_count == 0:
            return flags, sums
        flags.zero_()
        inputs = [LATTICE_BITS, tree.first_other, tree.lattice, tree.ends]
        self._launch(kernels.flag_ends, tree.mesh_nodes, [0, -1, *inputs], [flags])
        for level in range(MAX_LEVEL, 0, -1):
            self._launch(kernels.flag_ends, tree.other_count, [tree.first_other, level, *inputs], [flags])
        wp.utils.array_scan(flags, sums, inclusive=True)
        places = self._ints(int(sums[-1:].numpy()[0]))
        self._launch(gather_flagged, tree.other_count, [flags, sums, tree.first_other], [places])
        return places, sums

    def _sort_nodes(self, tree: TreeNodes) -> tuple[wp.array, wp.array]:
        """Find the order of the nodes and the beginnings of levels. Return the nodes' levels in that order, and the
        beginnings of all possible levels.
        """
        count = self.node_count
        # Sorting needs twice the room.
        level, nodes = self._ints(2 * count), self._ints(2 * count)
        inputs = [tree.mesh_nodes, LATTICE_BITS, tree.lattice, self.others]
        self._launch(kernels.find_levels, count, inputs, [level, nodes])
        wp.utils.radix_sort_pairs(level, nodes, count, end_bit=LEVEL_BITS)
        self.nodes = self._first(nodes, count)
        starts = self._ints(MAX_LEVEL + 2)
        self._launch(kernels.find_starts, len(starts), [count, level], [starts])
        found = starts.numpy()
        self.depth = int(np.flatnonzero(found < count)[-1])
        self.starts = tuple(found[: self.depth + 2].tolist())
        return level, starts

    def _sort_ends(self, tree: TreeNodes, level: wp.array, numbers: wp.array) -> wp.array:
        """Find the ends, and the midpoints by level and end. Return the level and end of each midpoint as a key."""
        count, roots = self.node_count, self.starts[1]
        pairs = 2 * (count - roots)
        self.ends = wp.empty(count, dtype=wp.vec2i, device=self.device)
        keys, midpoints = wp.empty(2 * pairs, dtype=wp.int64, device=self.device), self._ints(2 * pairs)
        inputs = [tree.mesh_nodes, roots, tree.first_other, tree.ends, numbers, self.others, level, self.nodes]
        self._launch(kernels.list_ends, count, inputs, [self.ends, keys, midpoints])
        # Midpoints of one level and end stay in their order.
        wp.utils.radix_sort_pairs(keys, midpoints, pairs, end_bit=32 + LEVEL_BITS)
        self.midpoints = self._first(midpoints, pairs)
        return keys

    def _list_coarse(self, keys: wp.array, node_starts: wp.array) -> None:
        """Find the coarser nodes of each level from the sorted keys of its ends."""
        roots, pairs = self.starts[1], len(self.midpoints)
        flags, sums = self._ints(pairs), self._ints(pairs)
        self._launch(kernels.flag_first, pairs, [keys], [flags])
        if pairs:
            wp.utils.array_scan(flags, sums, inclusive=True)
        starts = self._ints(self.depth + 2)
        self._launch(kernels.find_coarse_starts, len(starts), [roots, node_starts, sums], [starts])
        self.coarse_starts = tuple(starts.numpy().tolist())
        count = self.coarse_starts[-1]
        self.midpoint_starts = self._ints(count + 1)
        self.midpoint_starts.fill_(pairs)
        self._launch(gather_flagged, pairs, [flags, sums, 0], [self.midpoint_starts])
        self.coarse = self._ints(count)
        self._launch(kernels.name_coarse, count, [keys, self.midpoint_starts], [self.coarse])

    def _ints(self, count: int) -> wp.array:
        return wp.empty(count, dtype=wp.int32, device=self.device)

    def _first(self, array: wp.array, count: int) -> wp.array:
        """A copy of the first places, in place of an array with twice the room."""
        kept = self._ints(count)
        if count:
            wp.copy(kept, array, count=count)
        return kept

    def _launch(self, kernel: wp.Kernel, dim: int | tuple[int, int], inputs: list[Any], outputs: list[Any]) -> None:
        wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device=self.device)
