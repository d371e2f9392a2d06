"""One pass over a changing forest: mark, refine, simplify, sort the leaves. The host reads nothing."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.errors import InputError
from warp_corot.kernels.remesh import bisect as remesh_bisect
from warp_corot.kernels.remesh import blocks as remesh_blocks
from warp_corot.kernels.remesh import dense as remesh_dense
from warp_corot.kernels.remesh import edges as remesh_edges
from warp_corot.kernels.remesh import order as remesh_order
from warp_corot.kernels.remesh import pools as pool_kernels
from warp_corot.kernels.remesh import simplify as remesh_simplify
from warp_corot.kernels.remesh import state as remesh_state
from warp_corot.kernels.remesh.mark import Contents, elongation, marking_kernel
from warp_corot.mesh.lattice import MAX_LEVEL, check_levels, lattice_spacing

from .checks import checked_criterion, checked_thresholds
from .pools import DeviceForest


class RemeshPass:
    """A criterion and two thresholds, turned into launches that can be recorded.

    A leaf is bisected if the criterion is above one threshold, and merged with its sibling if it is below the other.
    Between the two it stays. A pass bisects a leaf once; conformity may bisect larger neighbours too.

    Args:
        forest: The forest to change.
        criterion: A Warp function of a ``kernels.remesh.mark.ElementState`` and an array of numbers; the elongation of
            the longest edge, deformed over rest, if none is given.
        refine_above, simplify_below: Thresholds, in the criterion's unit; the first is the larger one.
        min_level, max_level: Leaves of these levels are not simplified and not refined. Without a ``min_level``, the
            mesh is nowhere coarser than it was at the beginning.
        parameters: Numbers for the criterion, float32 [n] on the device, which may change between passes.
        lame: Lamé's parameters for the criterion [Pa], or the names under which elements carry them.

    Attributes:
        contents: The material of leaves, ``kernels.remesh.mark.Contents``.

    Raises:
        InputError: The thresholds contradict each other, or the levels are out of order or beyond the lattice's depth.
    """

    def __init__(
        self,
        forest: DeviceForest,
        *,
        criterion: Any = elongation,
        refine_above: float = 1.25,
        simplify_below: float = 1.08,
        min_level: int | None = 0,
        max_level: int = MAX_LEVEL,
        parameters: wp.array | None = None,
        lame: tuple[float, float] | tuple[str, str] = (0.0, 0.0),
    ):
        self.thresholds = checked_thresholds(refine_above, simplify_below)
        check_levels(min_level, max_level)
        self.forest = forest
        self.device = forest.device
        self.levels = (int(min_level or 0), int(max_level))
        self._kept = forest.pools.roots if min_level is not None else forest.begun_with
        self.parameters = wp.zeros(1, dtype=wp.float32, device=self.device) if parameters is None else parameters
        self._mark = marking_kernel(checked_criterion(criterion))
        self._origin = wp.vec3d(*forest.source.origin)
        self._spacing = lattice_spacing(forest.source.cell_size)
        self.contents = self._make_contents(lame)
        self._edges = self._make_edges()
        self._blocks = self._make_blocks()
        self._removal = self._make_removal()
        self._moves = self._make_moves()
        self._demand = wp.zeros(1, dtype=wp.int64, device=self.device)
        self._goes_on = wp.zeros(1, dtype=wp.int32, device=self.device)
        self._sums, self._ends = (wp.zeros(forest.threads, dtype=wp.int32, device=self.device) for _ in range(2))
        self._graphs: dict[bool, wp.Graph] = {}

    def run(self) -> None:
        """Mark the leaves by the criterion and change the mesh. The first call records the launches; others replay."""
        self._replay(marked=False)

    def apply(self, marks: npt.ArrayLike) -> None:
        """Change the mesh by marks instead of the criterion.

        Args:
            marks: 1 for leaves to bisect, -1 for leaves that may be merged, 0 for the others, [T].

        Raises:
            InputError: The marks have other values or another number.
        """
        given = np.asarray(marks)
        count = self.forest.leaf_count
        if given.shape != (count,) or not np.isin(given, (-1, 0, 1)).all():
            raise InputError(f"marks must be -1, 0 or 1 for each of {count} leaves")
        whole = np.zeros(len(self.forest.pools.marks), np.int8)
        whole[:count] = given
        self.forest.pools.marks.assign(whole)
        self._replay(marked=True)

    def launch(self, *, marked: bool = False, goes_on: bool = False) -> None:
        """Launch a pass, or record it within the caller's capture.

        Args:
            marked: Whether the marks exist already.
            goes_on: Whether this pass and the last one count as one; neither may remove nodes.
        """
        forest = self.forest
        pools, carried, edges, removal = forest.pools, forest.carriage.arrays, self._edges, self._removal
        self._once(pool_kernels.begin_pass, int(goes_on), pools)
        if not marked:
            refine_above, simplify_below = self.thresholds
            inputs = [refine_above, simplify_below, self._origin, self._spacing, carried.u, self.parameters]
            self._many(self._mark, *inputs, self.contents, pools)
        self._many(remesh_edges.want_marked, self.levels[1], pools, edges)
        self._many(remesh_blocks.clear_blocks, pools, self._blocks)
        self._many(remesh_blocks.list_blocks, pools, self._blocks)
        self._many(remesh_edges.heat_wanted, pools, edges, self._blocks)
        self._once(remesh_bisect.begin_rounds, pools, self._goes_on)
        wp.capture_while(self._goes_on, self._launch_round)
        self._many(remesh_simplify.offer_nodes, self.levels[0], self._kept, carried, pools, removal)
        self._many(remesh_simplify.remove_nodes, pools, carried, removal)
        self._once(pool_kernels.give_back, pools)
        self._many(remesh_state.settle_ends, pools, carried)
        self._launch_moves()
        self._many(remesh_state.refresh_masses, pools, carried)
        self._many(remesh_order.count_leaves, pools, self._sums)
        wp.utils.array_scan(self._sums, self._ends, inclusive=True)
        self._many(remesh_order.list_leaves, self._ends, pools)
        self._many(remesh_order.adopt_list, self._moves, pools)
        self._many(remesh_dense.rename_void, self._moves, pools)
        self._once(remesh_order.adopt_count, pools)
        self._many(remesh_edges.clear_edges, pools, edges)

    # --- pieces ----------------------------------------------------------------------------------------------------

    def _launch_round(self) -> None:
        pools, edges, carried = self.forest.pools, self._edges, self.forest.carriage.arrays
        self._once(remesh_edges.begin_round, pools, self._demand)
        self._many(remesh_edges.visit_leaves, pools, edges, self._blocks)
        self._many(remesh_edges.visit_fresh, pools, edges, self._blocks)
        self._many(remesh_bisect.admit_edges, pools, edges, self._demand)
        self._many(remesh_bisect.bisect_edges, pools, edges, carried)
        self._once(remesh_bisect.end_round, pools, self._goes_on)

    def _launch_moves(self) -> None:
        pools, moves = self.forest.pools, self._moves
        self._many(remesh_dense.count_moves, pools, moves)
        wp.utils.array_scan(moves.sums, moves.ends, inclusive=True)
        self._many(remesh_dense.list_moves, pools, moves)
        self._once(remesh_dense.lower_top, pools)
        self._many(remesh_dense.move_nodes, pools, self.forest.carriage.arrays, moves)
        self._many(remesh_dense.rename_ends, moves, pools)

    def _replay(self, *, marked: bool) -> None:
        if self.device.is_cuda and not wp.is_conditional_graph_supported():
            self.launch(marked=marked)
            return
        if marked not in self._graphs:
            with wp.ScopedCapture(device=self.device) as capture:
                self.launch(marked=marked)
            self._graphs[marked] = capture.graph
        wp.capture_launch(self._graphs[marked])

    def _once(self, kernel: wp.Kernel, *arguments: Any) -> None:
        wp.launch(kernel, dim=1, inputs=list(arguments), device=self.device)

    def _many(self, kernel: wp.Kernel, *arguments: Any) -> None:
        """Launch a kernel in which each thread loops over a stretch of the items."""
        threads = self.forest.threads
        wp.launch(kernel, dim=threads, inputs=[threads, *arguments], device=self.device)

    def _make_contents(self, lame: tuple[float, float] | tuple[str, str]) -> Contents:
        names = self.forest.carriage.names

        def column(name: float | str) -> int:
            return names.index(name) if name in names else -1

        contents = Contents()
        contents.values = self.forest.carriage.arrays.values
        contents.mu_column, contents.lam_column = column(lame[0]), column(lame[1])
        contents.mu, contents.lam = (0.0 if isinstance(value, str) else float(value) for value in lame)
        contents.fill_column = column("fill")
        return contents

    def _make_edges(self) -> remesh_edges.WantedEdges:
        size = 1 << (2 * (self.forest.node_capacity + self.forest.threads)).bit_length()
        edges = remesh_edges.WantedEdges()
        edges.keys = wp.full(size, wp.int64(-1), dtype=wp.int64, device=self.device)
        edges.born = wp.full(size, int(remesh_edges.NEVER), dtype=wp.int32, device=self.device)
        edges.ring, edges.agreed, edges.pairs = (wp.zeros(size, dtype=wp.int32, device=self.device) for _ in range(3))
        edges.head, edges.node = (wp.full(size, -1, dtype=wp.int32, device=self.device) for _ in range(2))
        # Threads that add an edge at the same time may exceed the limit, but never fill the table.
        edges.most = size // 2
        edges.wanted = wp.empty(size, dtype=wp.int32, device=self.device)
        return edges

    def _make_blocks(self) -> remesh_blocks.Blocks:
        blocks = remesh_blocks.Blocks()
        shape = (self.forest.node_capacity, remesh_blocks.KEPT)
        blocks.of_node = wp.full(shape, int(remesh_blocks.NONE), dtype=wp.int32, device=self.device)
        blocks.latest = wp.full(shape[0], int(remesh_blocks.NONE), dtype=wp.int32, device=self.device)
        blocks.hot = wp.zeros(self.forest.capacity // int(remesh_blocks.BLOCK) + 1, dtype=wp.int32, device=self.device)
        blocks.all_hot = wp.zeros(1, dtype=wp.int32, device=self.device)
        return blocks

    def _make_removal(self) -> remesh_simplify.Removal:
        count = self.forest.node_capacity
        removal = remesh_simplify.Removal()
        removal.willing = wp.zeros(count, dtype=wp.int32, device=self.device)
        removal.head = wp.full(count, -1, dtype=wp.int32, device=self.device)
        removal.candidates = wp.empty(count, dtype=wp.int32, device=self.device)
        return removal

    def _make_moves(self) -> remesh_dense.Moves:
        moves = remesh_dense.Moves()
        nodes, threads = self.forest.node_capacity, self.forest.threads
        moves.sums, moves.ends = (wp.zeros(2 * threads, dtype=wp.int32, device=self.device) for _ in range(2))
        moves.holes, moves.movers, moves.forward = (
            wp.empty(nodes, dtype=wp.int32, device=self.device) for _ in range(3)
        )
        return moves
