"""The coarsest level: solved by its inverse where it has few nodes, else by a longer smoother."""

from __future__ import annotations

import warp as wp

from warp_corot.kernels.implicit.multigrid import dense as kernels

from .level import Level


class DenseInverse:
    """The inverse of a level's matrix, float32 [worlds, 3 n, 3 n]."""

    def __init__(self, level: Level):
        self.level = level
        size, worlds, device = 3 * level.count, level.worlds, level.device
        self._matrix = wp.zeros((worlds, size, size), dtype=wp.float64, device=device)
        self._scale, self._rows = (wp.zeros((worlds, size), dtype=wp.float64, device=device) for _ in range(2))
        self.inverse = wp.zeros((worlds, size, size), dtype=wp.float32, device=device)

    def update(self) -> None:
        """Launch the inversion of the present matrix."""
        level, pattern = self.level, self.level.pattern
        self._matrix.zero_()
        inputs = [level.lanes, pattern.entries, pattern.starts, pattern.columns, pattern.diagonal, level.blocks]
        level.launch(kernels.fill_dense, level.lanes * level.count, inputs, [self._matrix, self._scale])
        if level.device.is_cuda:
            kernel, block = kernels.invert_in_registers, kernels.SWEEPERS
            wp.launch(kernel, level.worlds * block, [self._matrix], device=level.device, block_dim=block)
        else:
            wp.launch(kernels.invert_dense, level.worlds, [self._matrix, self._rows], device=level.device)
        shape = self.inverse.shape
        inputs = [self._matrix, self._scale]
        wp.launch(kernels.store_inverse, dim=shape, inputs=inputs, outputs=[self.inverse], device=level.device)

    def solve(self) -> None:
        """Launch z = inverse r."""
        level = self.level
        inputs = [level.lanes, level.count, self.inverse, level.r]
        level.launch(kernels.apply_dense, level.count * level.lanes, inputs, [level.z])
