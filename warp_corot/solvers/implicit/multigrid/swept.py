"""A level that the CPU smooths by Gauss-Seidel sweeps; see ``kernels.implicit.multigrid.sweeps``."""

from __future__ import annotations

from typing import Any

import warp as wp

from warp_corot.kernels.implicit.multigrid import sweeps as kernels

from .level import Level
from .pattern import Pattern


class SweptLevel(Level):
    """A level with sweeps in place of Chebyshev's iteration. Smoothing after is the transpose of smoothing before.

    Args:
        pattern, worlds, ranks, free: As for every level.
        sweeps: With one, a sweep forward before and one back after; with more, so many pairs of a sweep forward and one
            back, before and after.
    """

    def __init__(self, pattern: Pattern, worlds: int, ranks: int, free: wp.array, sweeps: int):
        super().__init__(pattern, worlds, ranks, free, degree=1)
        self._sweeps = sweeps

    def smooth_before(self) -> None:
        inputs = [*self._sizes, self.rows, self.pattern.diagonal, self.inverses, self.r]
        self._launch_worlds(kernels.sweep_from_zero, inputs, [self.z, self.other])
        for number in range(1, 2 * self._sweeps if self._sweeps > 1 else 1):
            self._sweep(backward=number % 2 == 1)

    def smooth_after(self) -> None:
        for number in range(2 * self._sweeps if self._sweeps > 1 else 1):
            self._sweep(backward=self._sweeps == 1 or number % 2 == 1)

    def find_residual(self) -> None:
        inputs = [*self._sizes, self._sweeps == 1, self.rows, self.pattern.diagonal, self.r, self.z, self.inverses]
        self._launch_worlds(kernels.find_rest, inputs, [self.other])

    @property
    def _first_factor(self) -> float:
        """Zero: sweeps begin by themselves."""
        return 0.0

    def _sweep(self, *, backward: bool) -> None:
        inputs = [*self._sizes, backward, self.rows, self.inverses, self.r]
        self._launch_worlds(kernels.sweep, inputs, [self.z])

    @property
    def _sizes(self) -> list[Any]:
        return [self.count, self.pattern.entries]

    def _launch_worlds(self, kernel: wp.Kernel, inputs: list[Any], outputs: list[Any]) -> None:
        wp.launch(kernel, self.worlds, inputs, outputs, device=self.device)
