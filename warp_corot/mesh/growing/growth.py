"""Forests that grow: arrays with spare room on a device, and elements bisected where a body's surface is not flat
enough, until the mesh is conforming.

A hash table leads from edges to their midpoints."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from warp_corot.errors import InputError
from warp_corot.inputs.cpu_threads import launch_side_by_side
from warp_corot.kernels.meshing import growth as kernels
from warp_corot.mesh.bisection import path_tetrahedra
from warp_corot.mesh.growing.refinement_criteria import Judge, Wishes
from warp_corot.mesh.lattice import LATTICE_BITS, MAX_CELLS, MAX_LEVEL, volume_shares
from warp_corot.mesh.surfaces.bound import leaves_at
from warp_corot.mesh.tree import LIVE, Tree

if TYPE_CHECKING:
    from warp_corot.domain import Domain

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

    Attributes:
        forest: ``kernels.meshing.growth.Forest``.
    """

    def __init__(self, lattice: np.ndarray, ends: np.ndarray, tree: Tree, device: wp.Device):
        self.device = device
        self.element_count = len(tree.level)
        self.node_count = len(lattice)
        forest = self.forest = kernels.Forest()
        forest.tets = self._on_device(tree.tets, wp.vec4i)
        forest.level = self._on_device(tree.level, wp.int32)
        forest.parent = self._on_device(tree.parent, wp.int32)
        forest.first_child = self._on_device(tree.first_child, wp.int32)
        forest.wished, forest.bound = (wp.zeros(self.element_count, wp.uint8, device=device) for _ in range(2))
        forest.lattice = self._on_device(lattice, wp.vec3i)
        forest.ends = self._on_device(ends, wp.vec2i)
        forest.active = self._on_device(ends[:, 0] >= 0, wp.uint8)
        forest.touched = wp.zeros(self.node_count, dtype=wp.uint8, device=device)
        forest.counts = self._on_device([self.node_count, 0], wp.int32)
        forest.need, forest.phi = (wp.empty(0, dtype=wp.float32, device=device) for _ in range(2))
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
        self.make_room(count, "tets", "level", "parent", "first_child", "wished", "bound")
        self.launch(kernels.bisect, len(elements), elements, slots, base, self.forest)
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
        middles: np.ndarray = self.forest.values.numpy()[slots.numpy()]
        return middles

    def insert_edges(self, elements: wp.array, *, of_refinement: bool) -> wp.array:
        """Ensure that the elements' refinement edges, or all their edges, have midpoints; return slots in the table [n]
        or [6n].
        """
        kernel, count = (kernels.refinement_edges, 1) if of_refinement else (kernels.all_edges, 6)
        pairs = wp.empty(count * len(elements), dtype=wp.vec2i, device=self.device)
        self.launch(kernel, len(elements), elements, self.forest, pairs)
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
            self.launch(kernels.insert_midpoints, stop - start, pairs[start:stop], self.forest, slots[start:stop])
            self._read_counts()
        return slots

    def hanging(self, first_new: int = 0) -> wp.array:
        """Leaves that must be bisected, by a wish or an active midpoint on an edge; ascending.

        Before ``first_new`` only those whose edges got an active midpoint since the last call.
        """
        flags = wp.empty(self.element_count, dtype=wp.int32, device=self.device)
        launch_side_by_side(
            kernels.flag_hanging,
            self.element_count,
            lambda own: ([-own(0), first_new, self.forest], [flags]),
            self.device,
        )
        self.forest.touched.zero_()
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
        return self.forest.lattice[: self.node_count].numpy(), self.forest.ends[: self.node_count].numpy()

    def tree(self) -> Tree:
        forest, count = self.forest, self.element_count
        return Tree(*(a[:count].numpy() for a in (forest.tets, forest.level, forest.parent, forest.first_child)))

    def launch(self, kernel: wp.Kernel, count: int, *arguments: Any) -> None:
        wp.launch(kernel, count, list(arguments), device=self.device)

    # --- room ------------------------------------------------------------------------------------------------------

    def make_room(self, count: int, *names: str) -> None:
        """Make these arrays of the forest at least so long; new places are zero."""
        for name in names:
            array = getattr(self.forest, name)
            if count > len(array):
                longer = wp.zeros(max(count, 3 * len(array) // 2), dtype=array.dtype, device=self.device)
                wp.copy(longer, array, count=len(array))
                setattr(self.forest, name, longer)

    def _activate(self, slots: wp.array) -> None:
        self.launch(kernels.activate, len(slots), slots, self.forest)

    def _reserve_nodes(self, more: int) -> bool:
        """Reserve room for more nodes; return whether the table's slots have changed."""
        count = self.node_count + more
        self.make_room(count, "lattice", "ends", "active", "touched")
        if ROOM * count <= len(self.forest.keys):
            return False
        self._make_table(count)
        return True

    def _make_table(self, count: int = 0) -> None:
        size = 1 << max(int(2 * ROOM * max(count, self.node_count)).bit_length(), 10)
        self.forest.keys = wp.full(size, wp.int64(-1), dtype=wp.int64, device=self.device)
        self.forest.values = wp.full(size, -1, dtype=wp.int32, device=self.device)
        self.launch(kernels.fill_table, self.node_count, self.forest)

    def _read_counts(self) -> None:
        counts = self.forest.counts.numpy()
        self.node_count = int(counts[kernels.NODES])
        if counts[kernels.DEEPEST] >= MAX_LEVEL:
            raise InputError(f"a tetrahedron is already at level {MAX_LEVEL}, the deepest that the lattice can hold")

    def _on_device(self, values: Any, dtype: type) -> wp.array:
        kind = np.uint8 if dtype is wp.uint8 else np.int32
        return wp.array(np.asarray(values, kind), dtype=dtype, device=self.device, copy=True)


#: The tetrahedra of a root cube.
TETS_OF_CUBE = 6
#: Each time a surface error is lowered to at least ``STEEPEST`` and at most ``FLATTEST`` of itself.
STEEPEST, FLATTEST = 0.2, 0.7
#: This fraction of the elements may remain as conformity made them.
LEFT_OVER = 2.0e-3


@dataclass(frozen=True)
class Grown:
    """A grown forest: all lattice points that were evaluated, and the results.

    Attributes:
        cells, origin: The grid.
        lattice, ends, phi: Coordinates, edge ends and signed function of the lattice points.
        tree: The tree of all bisections.
        need: The error of an element's piece of the surface if the element were not bisected [m], float32 [M].
        wished: The mesh before the body was sampled more finely, as the first child of each tetrahedron, int32 [m];
            without finer sampling it is the whole tree.
        growth: The same on the device.
        deepest: The level from which elements were not compared with the surface.
    """

    cells: tuple[int, int, int]
    origin: tuple[float, float, float]
    lattice: np.ndarray
    ends: np.ndarray
    tree: Tree
    phi: np.ndarray
    need: np.ndarray
    wished: np.ndarray
    growth: Growth
    deepest: int


def grid_around(bounds: np.ndarray, cell_size: float) -> tuple[tuple[int, int, int], tuple[float, float, float]]:
    """Root cubes along each axis and the lower corner of the grid that holds a box, the box in its middle."""
    bounds = np.asarray(bounds, dtype=float)
    cells = np.maximum(np.ceil((bounds[1] - bounds[0]) / cell_size - 1e-6), 1.0)
    if cells.max() > MAX_CELLS or cells.prod() * 6 > 2**27:
        raise InputError(
            f"cell_size is {cell_size:g} m: that is {' x '.join(f'{c:.0f}' for c in cells)} root cubes; "
            "make it larger and max_level higher"
        )
    x, y, z = (float(c) for c in bounds.mean(axis=0) - 0.5 * cells * cell_size)
    a, b, c = (int(n) for n in cells)
    return (a, b, c), (x, y, z)


class Growing:
    """A forest that grows to follow a domain.

    Args:
        domain: The body.
        cell_size: Edge of a root cube [m].
        wishes: The required fineness.
        device: The device of the computation.
        cubes: The root cubes that are bisected, in the order of `path_tetrahedra`: the first one, and the one after the
            last; None: all.
    """

    def __init__(
        self,
        domain: Domain,
        cell_size: float,
        wishes: Wishes,
        device: wp.Device,
        cubes: tuple[int, int] | None = None,
    ):
        self.cells, self.origin = grid_around(domain.bounds, cell_size)
        a, b, c = self.cells
        points = (a + 1, b + 1, c + 1)
        lattice = np.indices(points, dtype=np.int32).reshape(3, -1).T << LATTICE_BITS
        tets = path_tetrahedra(self.cells, points)
        if cubes is not None:
            tets = tets[TETS_OF_CUBE * cubes[0] : TETS_OF_CUBE * cubes[1]]
        roots = len(tets)
        leaf = np.full(roots, LIVE, np.int32)
        tree = Tree(tets, np.zeros(roots, np.int32), np.full(roots, -1, np.int32), leaf)
        self.growth = Growth(lattice, np.full((len(lattice), 2), -1, np.int32), tree, device)
        self.judge = Judge(domain, self.growth, self.cells, self.origin, cell_size, wishes)
        self.room: int | None = None

    def run(self, first: int = 0) -> None:
        """Bisect elements from ``first`` on by the wishes, then for conformity.

        If the number of elements is limited, a few of the elements that conformity made may remain too coarse, because
        refining all of them would take a round for every few elements.
        """
        growth, judge = self.growth, self.judge
        while True:
            self.run_down(first)
            if not judge.limited or len(left := judge.off()) <= LEFT_OVER * growth.element_count:
                break
            first = growth.element_count
            growth.bisect(self.chosen(left))
        judge.evaluate()

    def run_down(self, first: int) -> None:
        """Bisect from the top down, each level from only the one above, then for conformity."""
        growth, start = self.growth, first
        while first < growth.element_count:
            wished = self.chosen(self.judge.wished(first))
            first = growth.element_count
            growth.bisect(wished)
        growth.close(self.judge.wished, start)

    def run_until(self, elements: int, first_error: float) -> None:
        """Lower the surface error, from a first one [m], until so many leaves contain a part of the body."""
        judge = self.judge
        least = float(judge.closest[0])
        error, judge.limited = max(first_error, least), True
        judge.tolerances = np.full(MAX_LEVEL + 1, error, np.float32)
        self.run()
        while error > least and (share := judge.holding() / elements) < 1.0:
            error = max(error * min(max(share, STEEPEST), FLATTEST), least)
            self.lower(error)

    def run_finer(self, share: float, thin_share: float) -> None:
        """Lower the surface error once more, to a fraction of itself, for the drawn surface, and the error of thin
        parts to another.
        """
        error, least = float(self.judge.tolerances.max()), float(self.judge.closest[0])
        self.judge.thin_tolerance = thin_share * error
        if error > least and share < 1.0:
            self.lower(max(share * error, least))

    def lower(self, error: float) -> None:
        """Bisect elements whose error exceeds a smaller limit than before, and then their children."""
        self.judge.tolerances = np.full(MAX_LEVEL + 1, error, np.float32)
        first = self.growth.element_count
        self.growth.bisect(self.judge.off())
        self.run(first)

    def run_around(self, points: np.ndarray, largest: np.ndarray) -> None:
        """Bisect elements that hold points [n, 3] [m] until each is at most as large as its limit [m^3]."""
        growth, judge = self.growth, self.judge
        cell_size = float(judge.lengths[0])
        while True:
            tree = growth.tree()
            leaves = leaves_at(tree, self.cells, self.origin, cell_size, points)
            large = (leaves >= 0) & (cell_size**3 * volume_shares(tree.level[leaves]) > largest)
            if not large.any():
                break
            first = growth.element_count
            growth.bisect(wp.array(np.unique(leaves[large]), dtype=wp.int32, device=growth.device))
            self.run(first)

    def look_closer(self, levels: int, error: float, most_elements: int) -> None:
        """Continue in elements that do not represent the surface well.

        Args:
            levels: Number of levels below the mesh's deepest.
            error: The largest distance of the sampled surface from the domain's, as a fraction of an element's edge
                there.
            most_elements: The approximate largest number of tetrahedra of all levels: beyond it only the neediest of a
                level are bisected.
        """
        growth, judge = self.growth, self.judge
        self.room = most_elements
        first = growth.element_count
        growth.bisect(self.chosen(judge.unresolved(levels, error)))
        self.run(first)

    def grown(self, wished: np.ndarray | None = None) -> Grown:
        """The present forest.

        Args:
            wished: See `Grown`; None: the whole tree.
        """
        growth, judge = self.growth, self.judge
        lattice, ends = growth.nodes()
        phi, need = growth.forest.phi[: growth.node_count].numpy(), judge.needs()
        tree = growth.tree()
        wished = tree.first_child if wished is None else wished
        return Grown(self.cells, self.origin, lattice, ends, tree, phi, need, wished, growth, judge.max_level)

    def chosen(self, wished: wp.array) -> wp.array:
        """The elements with the largest need, as many as there is room for."""
        growth, judge = self.growth, self.judge
        if self.room is None:
            return wished
        room = max((self.room - growth.element_count) // 2, 0)
        if len(wished) <= room:
            return wished
        need = judge.needs()[wished.numpy()]
        least = np.partition(need, len(need) - room - 1)[len(need) - room - 1]
        judge.tolerances = np.maximum(judge.tolerances, least)
        growth.forest.wished.zero_()
        kept = wished.numpy()[need > least]
        return wp.array(kept, dtype=wp.int32, device=growth.device)
