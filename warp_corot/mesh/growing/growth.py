"""A forest while it grows, on a device: arrays with spare room, and a hash table from edges to their midpoints."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from warp_corot.errors import InputError
from warp_corot.inputs.cpu_threads import launch_side_by_side
from warp_corot.kernels.meshing import growth as kernels
from warp_corot.mesh.lattice import LATTICE_BITS, MAX_LEVEL
from warp_corot.mesh.tree import Tree

#: Slots of the hash table per node, at least.
ROOM = 2


class Growth:
    """Tetrahedra, nodes and the edges whose midpoints the nodes are, bisected in rounds.

    Elements without children are LIVE (-1) or VOID (-2) in ``first_child``; void ones are not bisected, except those
    that ``bound`` requires to stay conforming with their neighbours.

    Args:
        lattice: int32 [n, 3].
        ends: int32 [n, 2].
        tree: The first tetrahedra.
        device: The device of the computation.
    """

    def __init__(self, lattice: np.ndarray, ends: np.ndarray, tree: Tree, device: wp.Device):
        self.device = device
        self.element_count = len(tree.level)
        self.node_count = len(lattice)
        self.tets = self._on_device(tree.tets, wp.vec4i)
        self.level = self._on_device(tree.level, wp.int32)
        self.parent = self._on_device(tree.parent, wp.int32)
        self.first_child = self._on_device(tree.first_child, wp.int32)
        self.wished = wp.zeros(self.element_count, dtype=wp.uint8, device=device)
        self.bound = wp.zeros(self.element_count, dtype=wp.uint8, device=device)
        self.lattice = self._on_device(lattice, wp.vec3i)
        self.ends = self._on_device(ends, wp.vec2i)
        self.active = self._on_device(ends[:, 0] >= 0, wp.uint8)
        self.touched = wp.zeros(self.node_count, dtype=wp.uint8, device=device)
        self._counts = self._on_device([self.node_count, 0], wp.int32)
        self._make_table()

    # --- rounds ------------------------------------------------------------------------------------------------------

    def bisect(self, elements: wp.array) -> None:
        """Bisect elements [n]: their children are the last 2n elements, in the same order.

        Raises:
            InputError: One of them is at the deepest level; the forest is then unusable.
        """
        if not len(elements):
            return
        slots = self.insert_edges(elements, of_refinement=True)
        self._activate(slots)
        base, count = self.element_count, self.element_count + 2 * len(elements)
        self._make_room(count, "tets", "level", "parent", "first_child", "wished", "bound")
        outputs = [self.tets, self.level, self.parent, self.first_child, self.bound]
        self.launch(kernels.bisect, len(elements), [elements, slots, self._values, base], outputs)
        self.element_count = count

    def bisect_edges(self, pairs: np.ndarray) -> np.ndarray:
        """Make the midpoints of edges active, as elements elsewhere do that are bisected there; returns the midpoints.

        Args:
            pairs: The nodes of each edge, int [n, 2].
        """
        if not len(pairs):
            return np.zeros(0, np.int32)
        slots = self.insert_pairs(self._on_device(pairs, wp.vec2i))
        self._activate(slots)
        middles: np.ndarray = self._values.numpy()[slots.numpy()]
        return middles

    def insert_edges(self, elements: wp.array, *, of_refinement: bool) -> wp.array:
        """Ensure that the elements' refinement edges, or all their edges, have midpoints; return slots in the table [n]
        or [6n].
        """
        count = len(elements) * (1 if of_refinement else 6)
        pairs = wp.empty(count, dtype=wp.vec2i, device=self.device)
        if of_refinement:
            self.launch(
                kernels.refinement_edges, len(elements), [elements, self.tets, self.level], [self._counts, pairs]
            )
        else:
            self.launch(kernels.all_edges, len(elements), [elements, self.tets], [pairs])
        return self.insert_pairs(pairs)

    def insert_pairs(self, pairs: wp.array) -> wp.array:
        """Ensure that edges between these nodes, vec2i [n], have midpoints; return slots in the table [n]."""
        count = len(pairs)
        slots = wp.empty(count, dtype=wp.int32, device=self.device)
        # About five elements share an edge: a part at a time needs less room than the worst case of all together.
        part = max(self.node_count, 1 << 16)
        for start in range(0, count, part):
            stop = min(start + part, count)
            moved = self._reserve_nodes(stop - start)
            if moved and start:
                return self.insert_pairs(pairs)
            table = [self.lattice, self.ends, self._keys, self._values, self._counts]
            self.launch(kernels.insert_midpoints, stop - start, [pairs[start:stop], *table], [slots[start:stop]])
            self._read_counts()
        return slots

    def midpoints(self, slots: wp.array) -> list[wp.array]:
        """The arrays from which kernels read the midpoints of slots."""
        return [slots, self._values]

    @property
    def table(self) -> list[wp.array]:
        """Keys and values of the hash table from edges to their midpoints."""
        return [self._keys, self._values]

    def hanging(self, first_new: int = 0) -> wp.array:
        """Leaves that must be bisected, by a wish or an active midpoint on an edge; ascending.

        Before ``first_new`` only those whose edges got an active midpoint since the last call.
        """
        flags = wp.empty(self.element_count, dtype=wp.int32, device=self.device)
        of_elements = [self.tets, self.first_child, self.wished, self.bound]
        shared = [self._keys, self._values, self.active, self.touched]
        launch_side_by_side(
            kernels.flag_hanging,
            self.element_count,
            lambda own: ([*map(own, of_elements), *shared, own(first_new)], [own(flags)]),
            self.device,
        )
        self.touched.zero_()
        return self.flagged(flags)

    def flagged(self, flags: wp.array, first: int = 0) -> wp.array:
        """The numbers, counted from ``first``, of flags [n] that are one."""
        return wp.array(np.flatnonzero(flags.numpy()) + first, dtype=wp.int32, device=self.device)

    def close(self, judge: Any = None, first: int = 0) -> None:
        """Bisect until the mesh is conforming.

        Args:
            judge: Called with the number of the first new element after each round; it may wish for more.
            first: The first element that is new since the mesh was last conforming.
        """
        while len(broken := self.hanging(first)):
            first = self.element_count
            self.bisect(broken)
            if judge is not None:
                judge(first)

    # --- what came out ---------------------------------------------------------------------------------------------

    def nodes(self) -> tuple[np.ndarray, np.ndarray]:
        """Lattice points int32 [n, 3] and ends int32 [n, 2]."""
        return self.lattice[: self.node_count].numpy(), self.ends[: self.node_count].numpy()

    def tree(self) -> Tree:
        count = self.element_count
        return Tree(*(a[:count].numpy() for a in (self.tets, self.level, self.parent, self.first_child)))

    def launch(self, kernel: wp.Kernel, count: int, inputs: list[Any], outputs: list[Any]) -> None:
        wp.launch(kernel, dim=count, inputs=inputs, outputs=outputs, device=self.device)

    # --- room ------------------------------------------------------------------------------------------------------

    def _activate(self, slots: wp.array) -> None:
        self.launch(kernels.activate, len(slots), [slots, self._values, self.ends], [self.active, self.touched])

    def _reserve_nodes(self, more: int) -> bool:
        """Reserve room for more nodes; return whether the table's slots have changed."""
        count = self.node_count + more
        self._make_room(count, "lattice", "ends", "active", "touched")
        if ROOM * count <= len(self._keys):
            return False
        self._make_table(count)
        return True

    def _make_table(self, count: int = 0) -> None:
        size = 1 << max(int(2 * ROOM * max(count, self.node_count)).bit_length(), 10)
        self._keys = wp.full(size, wp.int64(-1), dtype=wp.int64, device=self.device)
        self._values = wp.full(size, -1, dtype=wp.int32, device=self.device)
        self.launch(kernels.fill_table, self.node_count, [self.ends], [self._keys, self._values])

    def _make_room(self, count: int, *names: str) -> None:
        for name in names:
            setattr(self, name, with_room(getattr(self, name), count))

    def _read_counts(self) -> None:
        counts = self._counts.numpy()
        self.node_count = int(counts[kernels.NODES])
        if counts[kernels.DEEPEST] >= MAX_LEVEL:
            raise InputError(f"a tetrahedron is already at level {MAX_LEVEL}, the deepest that the lattice can hold")

    def _on_device(self, values: Any, dtype: type) -> wp.array:
        kind = np.uint8 if dtype is wp.uint8 else np.int32
        return wp.array(np.asarray(values, kind), dtype=dtype, device=self.device, copy=True)


def with_room(array: wp.array, count: int) -> wp.array:
    """The array, or a longer copy, padded with zeros, if it is shorter than ``count``."""
    if count <= len(array):
        return array
    longer = wp.zeros(max(count, 3 * len(array) // 2), dtype=array.dtype, device=array.device)
    wp.copy(longer, array, count=len(array))
    return longer


def lattice_spacing(cell_size: float) -> float:
    """Length of one lattice interval [m]."""
    return cell_size / 2**LATTICE_BITS
