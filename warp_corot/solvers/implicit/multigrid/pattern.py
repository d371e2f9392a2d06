"""The pattern of each level's matrix, found by launches; the host reads a few counts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import warp as wp

from warp_corot.discretization.groups import Members
from warp_corot.discretization.plan import Batch
from warp_corot.kernels.implicit.multigrid import pattern as kernels
from warp_corot.kernels.implicit.multigrid import subtrees as roots_kernels


@dataclass(frozen=True, eq=False)
class Pattern:
    """The entries of a level's matrix in one world, by rank.

    Attributes:
        count: Number of nodes of the level, n.
        entries: Number of entries.
        starts: The beginning of each row, and the end of the last one, int32 [n + 1].
        columns: int32 [entries], ascending in a row.
        pairs: Row and column of each entry, vec2i [entries].
        diagonal: The place of each row's diagonal entry, int32 [n].
        sums: The entries in the upper triangle and the contributions to them: ``upper``, rank and higher or equal rank
            of each, vec2i [U]; ``places`` of each and of its mirror image among the entries, vec2i [U]; ``starts``, the
            beginning of the contributions to each, and the end of the last ones, int32 [U + 1]; and these as ``codes``,
            int32: see ``kernels.implicit.multigrid.pattern``.
    """

    count: int
    entries: int
    starts: wp.array
    columns: wp.array
    pairs: wp.array
    diagonal: wp.array
    sums: kernels.EntrySums


@dataclass(frozen=True, eq=False)
class Midpoints:
    """For each node of a level, the finer level's nodes whose edges end there.

    Attributes:
        starts: The beginning of each node's list, and the end of the last one, int32 [n + 1].
        midpoints: Ranks, ascending for each node, int32.
    """

    starts: wp.array
    midpoints: wp.array


class PatternFinder:
    """Finds the patterns of levels.

    Args:
        ends: Ranks of the ends of each node's edge by rank, vec2i [M].
    """

    def __init__(self, ends: wp.array):
        self.ends, self.device = ends, ends.device
        # One more than the number of ranks, for keys past all others.
        self.bits = len(ends).bit_length()

    def of_leaves(
        self, tets: wp.array, leaves: int, rank: wp.array, members: Members | None = None
    ) -> tuple[Pattern, wp.array]:
        """The pattern of the finest level, from the nodes of the first leaves by number and the rank of each number.

        Args:
            tets: Node numbers of all leaves, vec4i.
            leaves: The number of leaves that count.
            rank: The rank of each node number, int32.
            members: Groups whose nodes are all coupled, if there are any.

        Returns:
            The pattern, and the pairs of the groups' nodes as ``kernels.implicit.multigrid.pattern`` has them, vec2i.
        """
        nodes = len(rank)
        before, pairs = 6 * leaves + nodes, 0
        if members is not None:
            sums = self._ints(members.count)
            self._launch(kernels.count_pairs, members.count, [members.arrays], [sums])
            wp.utils.array_scan(sums, sums, inclusive=True)
            pairs = int(sums[-1:].numpy()[0])
        keys, codes = self._keys(before + pairs)
        self._launch(kernels.list_leaf_pairs, leaves, [self.bits, tets, rank], [keys, codes])
        self._launch(kernels.list_diagonal, nodes, [6 * leaves, self.bits], [keys, codes])
        found = wp.empty(pairs, dtype=wp.vec2i, device=self.device)
        if members is not None:
            inputs = [before, self.bits, members.arrays, rank, sums]
            self._launch(kernels.list_pairs, members.count, inputs, [found, keys, codes])
        return self._pattern(nodes, before + pairs, keys, codes), found

    def of_roots(self, count: int, batches: Sequence[Batch], roots: int, nodes: wp.array, rank: wp.array) -> Pattern:
        """The pattern of the level of the roots of subtrees.

        Args:
            count: Number of nodes of the level.
            batches: The subtrees, world after world.
            roots: Number of subtrees in one world.
            nodes: Node numbers of all leaves, vec4i.
            rank: The rank of each node number, int32.
        """
        entries = len(roots_kernels.PAIRS) * roots
        keys, codes = self._keys(entries + count)
        self._launch(kernels.list_diagonal, count, [entries, self.bits], [keys, codes])
        worlds, first = sum(batch.count for batch in batches) // roots, 0
        for batch in batches:
            corners = wp.vec4i(*roots_kernels.CORNERS[batch.shape])
            inputs = [first, self.bits, batch.subtrees.first, nodes, corners, rank]
            self._launch(roots_kernels.list_root_pairs, batch.count // worlds, inputs, [keys, codes])
            first += batch.count // worlds
        return self._pattern(count, entries + count, keys, codes)

    def middles(self, pattern: Pattern, fine: int) -> wp.array:
        """The node of the next finer level, of ``fine`` nodes, between the nodes of each entry in the upper triangle;
        -1: none; int32 [entries]."""
        found = wp.full(pattern.entries, -1, dtype=wp.int32, device=self.device)
        inputs = [pattern.count, self.ends, pattern.starts, pattern.columns]
        self._launch(roots_kernels.find_middles, fine - pattern.count, inputs, [found])
        return found

    def of_products(self, fine: Pattern, coarse: int) -> Pattern:
        """The pattern of a level with this number of nodes, from the next finer one."""
        counts = self._ints(fine.entries)
        self._launch(kernels.count_products, fine.entries, [coarse, fine.pairs, self.ends], [counts])
        wp.utils.array_scan(counts, counts, inclusive=True)
        total = int(counts[-1:].numpy()[0])
        keys, codes = self._keys(total)
        inputs = [coarse, self.bits, fine.pairs, self.ends, counts]
        self._launch(kernels.list_products, fine.entries, inputs, [keys, codes])
        return self._pattern(coarse, total, keys, codes)

    def midpoints(self, coarse: int, fine: int) -> Midpoints:
        """The midpoints of levels with these numbers of nodes."""
        count = 2 * (fine - coarse)
        keys, midpoints = self._keys(count)
        self._launch(kernels.list_midpoints, fine - coarse, [coarse, self.bits, self.ends], [keys, midpoints])
        self._sort(keys, midpoints, count)
        return Midpoints(self._row_starts(coarse, count, keys), _first(midpoints, count))

    # --- pieces ------------------------------------------------------------------------------------------------------

    def _pattern(self, nodes: int, contributions: int, keys: wp.array, codes: wp.array) -> Pattern:
        self._sort(keys, codes, contributions)
        flags, numbers = self._ints(contributions), self._ints(contributions)
        self._launch(kernels.flag_first, contributions, [keys], [flags])
        wp.utils.array_scan(flags, numbers, inclusive=True)
        count = int(numbers[-1:].numpy()[0])
        starts = self._ints(count + 1)
        starts.fill_(contributions)
        self._launch(kernels.gather_flagged, contributions, [flags, numbers], [starts])
        upper = wp.empty(count, dtype=wp.vec2i, device=self.device)
        full, sources = self._keys(2 * count)
        self._launch(kernels.name_upper, count, [nodes, self.bits, keys, starts], [upper, full, sources])
        self._sort(full, sources, 2 * count)
        entries = 2 * count - nodes
        pairs = wp.empty(entries, dtype=wp.vec2i, device=self.device)
        columns, diagonal, places = self._ints(entries), self._ints(nodes), self._ints(2 * count)
        inputs = [self.bits, full, sources]
        self._launch(kernels.name_entries, entries, inputs, [pairs, columns, diagonal, places])
        sums = kernels.EntrySums()
        sums.upper, sums.starts, sums.codes = upper, starts, _first(codes, contributions)
        sums.places = places.reshape((count, 2)).view(wp.vec2i)
        return Pattern(nodes, entries, self._row_starts(nodes, entries, full), columns, pairs, diagonal, sums)

    def _row_starts(self, rows: int, count: int, keys: wp.array) -> wp.array:
        starts = self._ints(rows + 1)
        self._launch(kernels.find_row_starts, rows + 1, [count, self.bits, keys], [starts])
        return starts

    def _keys(self, count: int) -> tuple[wp.array, wp.array]:
        """Keys and values with twice the room, which sorting needs."""
        return wp.empty(2 * count, dtype=wp.int64, device=self.device), self._ints(2 * count)

    def _sort(self, keys: wp.array, values: wp.array, count: int) -> None:
        if count:
            wp.utils.radix_sort_pairs(keys, values, count, end_bit=2 * self.bits)

    def _ints(self, count: int) -> wp.array:
        return wp.empty(count, dtype=wp.int32, device=self.device)

    def _launch(self, kernel: wp.Kernel, dim: int, inputs: list[Any], outputs: list[Any]) -> None:
        wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device=self.device)


def _first(array: wp.array, count: int) -> wp.array:
    """A copy of the first places, in place of an array with twice the room."""
    kept = wp.empty(count, dtype=array.dtype, device=array.device)
    if count:
        wp.copy(kept, array, count=count)
    return kept
