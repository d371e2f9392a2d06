"""Springs at places between nodes on all levels; see ``kernels.implicit.multigrid.springs``."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import warp as wp

from warp_corot.kernels.implicit.multigrid import springs as kernels

from .level import Level, SmoothedLevel

if TYPE_CHECKING:
    from warp_corot.solvers.implicit.operator import Springs

    from .multigrid import Multigrid


class SpringsOnLevels:
    """The springs that come and go while the matrices of multigrid stay.

    Args:
        multigrid: The cycle, with its present levels.
        springs: Where springs may be.
        rank: The rank of each node number, int32.
        ends: The ends of each node by rank, vec2i.
    """

    def __init__(self, multigrid: Multigrid, springs: Springs, rank: wp.array, ends: wp.array):
        self.device, self._count, self._stiffness = multigrid.device, len(springs.nodes), springs.stiffness
        self._kept = wp.zeros(self._count, dtype=wp.mat33, device=self.device)
        sizes = [multigrid.discretization.sizes.world_nodes, multigrid.count]
        self._levels = [self._level(level, springs, sizes, rank, ends) for level in multigrid.levels]

    def keep_plain(self) -> None:
        """Launch the record of matrices without springs, after these were computed."""
        self._kept.zero_()
        for level, _rows, matrix in self._levels:
            if isinstance(level, Level):
                wp.copy(matrix.plain_blocks, level.blocks)
            wp.copy(matrix.plain_inverses, level.inverses)
            matrix.added.zero_()

    def take(self) -> None:
        """Launch the exchange of the springs in the matrices for the present ones."""
        for _level, rows, matrix in self._levels:
            self._launch(kernels.remove_springs, [self._kept, rows, matrix])
        wp.copy(self._kept, self._stiffness)
        for _level, rows, matrix in self._levels:
            self._launch(kernels.add_springs, [self._kept, rows, matrix])
            self._launch(kernels.invert_with_springs, [self._kept, rows, matrix])

    def _level(
        self, level: SmoothedLevel, springs: Springs, sizes: list[int], rank: wp.array, ends: wp.array
    ) -> tuple[SmoothedLevel, kernels.SpringRows, kernels.LevelMatrix]:
        has_matrix, device = isinstance(level, Level), self.device
        rows, matrix = kernels.SpringRows(), kernels.LevelMatrix()
        rows.nodes = wp.zeros(self._count, dtype=wp.vec4i, device=device)
        rows.weights = wp.zeros(self._count, dtype=wp.vec4, device=device)
        rows.entries = wp.zeros((self._count, 16 if has_matrix else 0), dtype=wp.int32, device=device)
        inputs: list[Any] = [*sizes, level.count, springs.nodes, springs.weights, rank, ends]
        self._launch(kernels.find_spring_nodes, [*inputs, rows])
        matrix.inverses, matrix.plain_inverses = level.inverses, wp.zeros_like(level.inverses)
        matrix.added = wp.zeros_like(level.inverses)
        if isinstance(level, Level):
            pattern = level.pattern
            matrix.blocks, matrix.plain_blocks = level.blocks, wp.zeros_like(level.blocks)
            inputs = [level.count, pattern.entries, pattern.starts, pattern.columns, rows]
            self._launch(kernels.find_spring_entries, inputs)
        return level, rows, matrix

    def _launch(self, kernel: wp.Kernel, inputs: list[Any]) -> None:
        wp.launch(kernel, self._count, inputs, device=self.device)
