"""An implicit step with contact by Newton's method: each linearisation is solved with contact."""

from __future__ import annotations

import warp as wp

from warp_corot.kernels.implicit import touching as kernels

from .touching import TouchingSolve


class TouchingNewton:
    """Solves for the increments of ``touching.newton``, which begin with zero at free nodes.

    The unknown of each linear problem is the whole motion d of the step: A d = r(d0) + A d0 + contact, with the
    residual r and its derivative -A at the motion d0 so far. So contact has the same unknowns in each of them. Where a
    scheme balances forces at a stage before the end of the step, increments are those of the stage, a share of d.
    Contact is that of the end of the step, with its whole force in the balance.

    Args:
        touching: The solve of one linearisation.
        tolerance: The iteration ends once no increment changes by more than this share of the largest displacement.
        most: Maximum number of linearisations.

    Attributes:
        iterations, linear_iterations, status: Of the step, as in ``kernels.implicit.conjugate_gradients``, int32
            [worlds].
    """

    def __init__(self, touching: TouchingSolve, *, tolerance: float, most: int):
        self._touching, self._tolerance, self._most = touching, tolerance, most
        newton = self._newton = touching.newton
        self.device, worlds = newton.device, newton.worlds
        self._operator, self._count = newton.operator, newton.operator.node_count
        self._product = wp.zeros_like(newton.step)
        self._sizes = wp.zeros((worlds, kernels.COLUMNS), dtype=wp.float32, device=self.device)
        self.iterations, self.linear_iterations, self.status = (
            wp.zeros(worlds, dtype=wp.int32, device=self.device) for _ in range(3)
        )
        self._going = wp.zeros(1, dtype=wp.int32, device=self.device)

    def launch(self) -> None:
        """Launch the increments and displacements of the step, from a guess of the increments in ``newton.step``."""
        held, newton = self._touching.held, self._newton
        self.iterations.zero_()
        self.linear_iterations.zero_()
        newton.launch_residual()
        newton.linearise()
        blocks = self._touching.diagonal_blocks()
        newton.move_held(to_end=True)
        held.launch_begin(newton.body.state.displacements, newton.step, blocks)
        newton.move_held(to_end=False)
        self._finish()
        wp.capture_while(self._going, self._go_on)
        held.launch_end(newton.step)

    def _go_on(self) -> None:
        newton, touching = self._newton, self._touching
        newton.launch_residual()
        newton.linearise()
        inputs = [newton.body.conditions.inverse_mass, newton.share, newton.increment]
        self._launch(kernels.take_free, inputs, [newton.step])
        self._operator.apply(newton.step, self._product)
        self._launch(kernels.add_product, [self._product], [newton.residual])
        if touching.held.nodes is not None:
            touching.held.nodes.launch_again()
        self._finish()

    def _finish(self) -> None:
        """Launch the solve of a linearisation, and the decision whether another one follows."""
        newton, touching = self._newton, self._touching
        body = newton.body
        touching.iterations.zero_()
        touching.launch_rounds()
        self._sizes.zero_()
        inputs = [self._count, body.conditions.inverse_mass, newton.base, newton.share, newton.step]
        outputs = [newton.increment, body.state.displacements, self._sizes]
        self._launch(kernels.take_increments, inputs, outputs)
        newton.ranks.exchange(newton.operator.number, body.state.displacements)
        newton.ranks.max(self._sizes.flatten())
        self._going.zero_()
        inputs = [self._sizes, touching.iterations, newton.solver.status, self._tolerance, self._most]
        outputs = [self.iterations, self.linear_iterations, self.status, self._going]
        wp.launch(kernels.judge_increments, newton.worlds, inputs, outputs, device=self.device)

    def _launch(self, kernel: wp.Kernel, inputs: list, outputs: list) -> None:
        wp.launch(kernel, len(self._product), inputs, outputs, device=self.device)
