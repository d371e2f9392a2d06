"""An implicit step of all bodies together by Newton's method: each linearisation is solved with contact."""

from __future__ import annotations

from collections.abc import Sequence

import warp as wp

from warp_corot.kernels.implicit import touching as kernels

from .joined import JoinedSolve
from .newton import Newton


class JoinedNewton:
    """Solves for the increments of all bodies, as ``TouchingNewton`` does for one; worlds are iterated together.

    Args:
        joined: The solve of one linearisation.
        newtons: Newton's method of each body; increments begin with zero at free nodes.
        tolerance: The iteration ends once no increment changes by more than this share of the largest displacement.
        most: Maximum number of linearisations.

    Attributes:
        iterations, linear_iterations, status: Of the step, as in ``kernels.implicit.conjugate_gradients``, int32
            [worlds].
    """

    def __init__(self, joined: JoinedSolve, newtons: Sequence[Newton], *, tolerance: float, most: int):
        self._joined, self._newtons, self._tolerance, self._most = joined, newtons, tolerance, most
        self.device, worlds = joined.device, newtons[0].worlds
        self._products = [wp.zeros_like(newton.step) for newton in newtons]
        self._sizes = wp.zeros((worlds, kernels.COLUMNS), dtype=wp.float32, device=self.device)
        self.iterations, self.linear_iterations, self.status = (
            wp.zeros(worlds, dtype=wp.int32, device=self.device) for _ in range(3)
        )
        self._going = wp.zeros(1, dtype=wp.int32, device=self.device)

    def launch(self, offset: int) -> None:
        """Launch the increments and displacements of the step, from guesses of the increments."""
        joined = self._joined
        self.iterations.zero_()
        self.linear_iterations.zero_()
        for newton in self._newtons:
            newton.launch_residual()
        joined.linearise()
        joined.launch_begin(offset)
        self._finish()
        wp.capture_while(self._going, self._go_on)
        joined.launch_end()

    def _go_on(self) -> None:
        for newton in self._newtons:
            newton.launch_residual()
        self._joined.linearise()
        for newton, product in zip(self._newtons, self._products, strict=True):
            inputs = [newton.body.conditions.inverse_mass, newton.share, newton.increment]
            wp.launch(kernels.take_free, len(product), inputs, [newton.step], device=self.device)
            newton.operator.apply(newton.step, product)
            wp.launch(kernels.add_product, len(product), [product], [newton.residual], device=self.device)
        self._joined.launch_again()
        self._finish()

    def _finish(self) -> None:
        """Launch the solve of a linearisation, and the decision whether another one follows."""
        joined = self._joined
        joined.launch_rounds()
        self._sizes.zero_()
        for newton in self._newtons:
            state = newton.body.state
            inputs = [newton.operator.node_count, newton.body.conditions.inverse_mass, newton.base]
            inputs += [newton.share, newton.step]
            outputs = [newton.increment, state.displacements, self._sizes]
            wp.launch(kernels.take_increments, len(newton.step), inputs, outputs, device=self.device)
        self._going.zero_()
        inputs = [self._sizes, joined.iterations, joined.status, self._tolerance, self._most]
        outputs = [self.iterations, self.linear_iterations, self.status, self._going]
        wp.launch(kernels.judge_increments, len(self.status), inputs, outputs, device=self.device)
