"""The nodes of a forest by tree level.

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
from warp_corot.kernels.meshing.growth import gather_flagged
from warp_corot.kernels.plan import levels as kernels
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
        sizes: The number of worlds.

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
    """

    def __init__(self, tree: TreeNodes, sizes: Sizes):
        self.device, self.worlds, self.version = tree.lattice.device, sizes.worlds, sizes.version
        self.mesh_nodes = tree.mesh_nodes
        self.others, numbers = self._find_others(tree)
        self.node_count = tree.mesh_nodes + len(self.others)
        self._sort_nodes(tree)
        self.ends = wp.empty(self.node_count, dtype=wp.vec2i, device=self.device)
        inputs = [tree.mesh_nodes, self.starts[1], tree.first_other, tree.ends, numbers, self.others, self.nodes]
        self._launch(kernels.list_ends, self.node_count, inputs, [self.ends])

    def __repr__(self) -> str:
        return f"Levels({self.node_count} nodes of levels 0 to {self.depth} on {self.device})"

    # --- pieces ------------------------------------------------------------------------------------------------------

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

    def _sort_nodes(self, tree: TreeNodes) -> None:
        """Find the order of the nodes and the beginnings of levels."""
        count = self.node_count
        # Sorting needs twice the room.
        level, nodes = self._ints(2 * count), self._ints(2 * count)
        inputs = [tree.mesh_nodes, LATTICE_BITS, tree.lattice, self.others]
        self._launch(kernels.find_levels, count, inputs, [level, nodes])
        wp.utils.radix_sort_pairs(level, nodes, count, end_bit=LEVEL_BITS)
        self.nodes = self._ints(count)
        wp.copy(self.nodes, nodes, count=count)
        starts = self._ints(MAX_LEVEL + 2)
        self._launch(kernels.find_starts, len(starts), [count, level], [starts])
        found = starts.numpy()
        self.depth = int(np.flatnonzero(found < count)[-1])
        self.starts = tuple(found[: self.depth + 2].tolist())

    def _ints(self, count: int) -> wp.array:
        return wp.empty(count, dtype=wp.int32, device=self.device)

    def _launch(self, kernel: wp.Kernel, dim: int, inputs: list[Any], outputs: list[Any]) -> None:
        wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device=self.device)
