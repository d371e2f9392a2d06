"""The simplest preconditioner: the inverses of the 3x3 blocks on the diagonal."""

from __future__ import annotations

import warp as wp

from warp_corot.kernels.implicit.tangent import apply_blocks, invert_blocks

from .operator import LinearOperator


class BlockDiagonal:
    """z = B r with the inverse of each node's own block; blocks are made positive definite if necessary.

    Args:
        operator: The operator, for its sizes.
    """

    def __init__(self, operator: LinearOperator):
        self._operator, self.device = operator, operator.device
        # The arrays of a mesh that changes keep their length.
        self._inverses = wp.zeros(len(operator.inverse_mass), dtype=wp.mat33, device=self.device)

    def update(self, operator: LinearOperator) -> None:
        self._launch(invert_blocks, [operator.diagonal_blocks()], [self._inverses])

    def apply(self, r: wp.array, z: wp.array) -> None:
        self._launch(apply_blocks, [self._inverses, r], [z])

    def _launch(self, kernel: wp.Kernel, inputs: list, outputs: list) -> None:
        count = self._operator.worlds * self._operator.node_count
        wp.launch(kernel, count, inputs, outputs, device=self.device)
