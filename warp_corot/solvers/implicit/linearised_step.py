"""An implicit step by linearisations without a line search on the energy: each is solved with contact."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import warp as wp

from warp_corot.kernels.implicit import increments as kernels

from .contact_solve import ContactSolve

if TYPE_CHECKING:
    from .block_system import BlockSystem
    from .newton import Newton


class LinearisedStep:
    """Solves for the increments of all bodies of a system.

    Without contact there is one linearisation, and its unknown is what increments change by. With contact they begin
    with zero at free nodes, and the unknown of each linear problem is the whole motion d of the step: A d = r(d0) + A
    d0 + contact, with the residual r and its derivative -A at the motion d0 so far. So contact has the same unknowns in
    each of them. Where a scheme balances forces at a stage before the end of the step, increments are those of the
    stage, a share of d. Contact is that of the end of the step, with its whole force in the balance.

    Args:
        system: The linear system.
        newtons: Newton's method of each body, whose residuals are used.
        tolerance: The iteration ends once no increment changes by more than this share of the largest displacement.
        most: Maximum number of linearisations.

    Attributes:
        iterations, linear_iterations, status: Of the step, as in ``kernels.implicit.conjugate_gradients``, int32
            [worlds].
    """

    def __init__(self, system: BlockSystem, newtons: list[Newton], *, tolerance: float | None, most: int):
        self._system, self._newtons, self.device = system, newtons, system.device
        self._tolerance, self._most = math.inf if tolerance is None else tolerance, 1 if tolerance is None else most
        self._contact = None if system.contact is None else ContactSolve(system, newtons)
        self.iterations = wp.ones(system.worlds, dtype=wp.int32, device=self.device)
        self.linear_iterations, self.status = system.solver.iterations, system.solver.status
        if self._contact is not None:
            self.linear_iterations = self._contact.iterations
        repeats = self._most > 1
        self._sizes = wp.zeros((system.worlds * repeats, kernels.COLUMNS), dtype=wp.float32, device=self.device)
        if repeats:
            self._product = wp.zeros_like(system.x)
            self.iterations, self.linear_iterations, self.status = (
                wp.zeros(system.worlds, dtype=wp.int32, device=self.device) for _ in range(3)
            )
            self._going = wp.zeros(1, dtype=wp.int32, device=self.device)

    def launch(self, offset: int) -> None:
        """Launch the increments and displacements of the ``offset``-th step, from a guess of the unknowns."""
        self._linearise()
        if self._contact is None:
            self._system.solve(guessed=True)
            self._take_increments()
            return
        self._contact.launch_begin(offset)
        self._contact.launch()
        self._take_increments()
        if self._most > 1:
            self.iterations.zero_()
            self.linear_iterations.zero_()
            self._judge()
            wp.capture_while(self._going, self._go_on)
        self._contact.launch_end()

    def _linearise(self) -> None:
        for newton in self._newtons:
            newton.launch_residual()
        for newton in self._newtons:
            newton.linearise()
        self._system.update()

    def _go_on(self) -> None:
        assert self._contact is not None
        self._linearise()
        system = self._system
        for newton in self._newtons:
            inputs = [newton.body.conditions.inverse_mass, newton.share, newton.increment]
            self._launch(kernels.take_free, inputs, [newton.step])
        system.apply_bodies(system.x, self._product)
        self._launch(kernels.add_product, [self._product], [system.b])
        self._contact.launch()
        self._take_increments()
        self._judge()

    def _take_increments(self) -> None:
        self._sizes.zero_()
        ranks = self._system.ranks
        for newton in self._newtons:
            body = newton.body
            inputs = [int(self._contact is None), newton.operator.node_count, body.conditions.inverse_mass]
            inputs += [newton.base, newton.share, newton.step]
            self._launch(kernels.take_increments, inputs, [newton.increment, body.state.displacements, self._sizes])
            ranks.exchange(newton.operator.number, body.state.displacements)

    def _judge(self) -> None:
        """Launch the decision whether another linearisation follows."""
        assert self._contact is not None
        self._system.ranks.max(self._sizes.flatten())
        self._going.zero_()
        inputs = [self._sizes, self._contact.iterations, self._system.solver.status, self._tolerance, self._most]
        outputs = [self.iterations, self.linear_iterations, self.status, self._going]
        wp.launch(kernels.judge_increments, len(self.status), inputs, outputs, device=self.device)

    def _launch(self, kernel: wp.Kernel, inputs: list, outputs: list) -> None:
        wp.launch(kernel, len(outputs[0]), inputs, outputs, device=self.device)
