"""Solves with the assembled matrix or with multigrid, whichever has been faster for the body's present state."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import warp as wp

from warp_corot.kernels.implicit import chosen as kernels

from .assembled import AssembledSolve
from .lagged import Lagged
from .operator import LinearOperator, Preconditioner, Springs

if TYPE_CHECKING:
    from .conjugate_gradients import ConjugateGradients
    from .touching import Held

#: The time of an iteration of multigrid over that of an assembled one: on the CPU, the same with a shared dilatation,
#: which has twice as many entries in a row, and on CUDA. On an H200 it was 29 to 38 for organs of 20,000 and 100,000
#: elements.
COST_ON_CPU, SHARED_ON_CPU, COST = 5, 3, 32
#: The length of a step times the largest frequency of a node among fixed ones, above which multigrid solves first. A
#: bunny of 20,000 elements has 70 at 5 kPa and 171 at 30 kPa, and takes 190 and 410 iterations on CUDA.
STIFF = 300.0


class ChosenSolve:
    """Both ways of solving, and the choice between them after each step.

    Args:
        assembled: The assembled matrix.
        lagged: Multigrid.
        shares: Whether elements share their dilatation.
        dt: The length of a step [s].

    Attributes:
        diagonal: As for ``AssembledSolve``.
        is_open: Whether the choice is open; otherwise multigrid solves.
        state: Arrays by name to be kept with the state of the body, so that a resumed run is the same.
    """

    def __init__(self, assembled: AssembledSolve, lagged: Lagged, *, shares: bool, dt: float):
        self._dt, self._is_prepared = dt, False
        self.assembled, self.lagged, self.device = assembled, lagged, assembled.device
        self._is_assembled = wp.ones(1, dtype=wp.int32, device=self.device)
        self._counts = wp.zeros(kernels.COUNTS, dtype=wp.int32, device=self.device)
        self.is_open = True
        on_cpu = SHARED_ON_CPU if shares else COST_ON_CPU
        self._cost = on_cpu if self.device.is_cpu else COST

    @property
    def diagonal(self) -> wp.array:
        return self.assembled.diagonal

    @property
    def state(self) -> dict[str, wp.array]:
        return {**self.lagged.state, "assembled": self._is_assembled, "choice": self._counts}

    def prepare(self) -> None:
        """Follow the mesh; not while launches are recorded. Launches must be recorded again after this."""
        self.assembled.follow()
        self.lagged.prepare()
        # A resumed run goes on with its choice.
        is_new = not self._is_prepared and not self._counts.numpy().any()
        if is_new and self._dt * self.assembled.largest_frequency() > STIFF:
            self._is_assembled.zero_()
            self._counts[int(kernels.ASSEMBLED) : int(kernels.ASSEMBLED) + 1].fill_(int(kernels.DEAR))
        self._is_prepared = True

    def follow_springs(self, springs: Springs) -> None:
        self.lagged.follow_springs(springs)

    def update(self, operator: LinearOperator) -> None:
        def other() -> None:
            self.lagged.update(operator)
            if self.assembled.touches:
                wp.copy(self.assembled.diagonal, operator.diagonal_blocks(), count=len(self.assembled.diagonal) - 1)

        self._either(lambda: self.assembled.update(operator), other)

    def take_contact(self, held: Held) -> None:
        """Launch the exchange of the contacts in the matrix for the present ones."""

        def other() -> None:
            if held.springs is not None:
                held.springs.update()
                self.lagged.take_springs()

        self._either(lambda: self.assembled.take_contact(held), other)

    def iterate(self, solver: ConjugateGradients, preconditioner: Preconditioner, x: wp.array, r: wp.array) -> None:
        self._either(
            lambda: self.assembled.iterate(solver, preconditioner, x, r),
            lambda: solver.launch_iterations(preconditioner, x),
        )

    def apply(self, r: wp.array, z: wp.array) -> None:
        self.lagged.apply(r, z)

    def judge(self, iterations: wp.array, status: wp.array) -> None:
        """Launch the choice for the next step, after a step with these results, int32 [worlds]."""
        if not self.is_open:
            self.lagged.judge(iterations, status)
            return
        wp.capture_if(self._is_assembled, None, lambda: self.lagged.judge(iterations, status))
        inputs = [iterations, status, int(self.assembled.touches), self._cost, self.assembled.couplings]
        wp.launch(kernels.choose, 1, inputs, [self._counts, self._is_assembled], device=self.device)

    def _either(self, assembled: Callable[[], None], other: Callable[[], None]) -> None:
        if self.is_open:
            wp.capture_if(self._is_assembled, assembled, other)
        else:
            other()
