"""Solves with the assembled matrix or with multigrid, whichever has been faster for the present state of the bodies."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import warp as wp

from warp_corot.kernels.implicit import chosen as kernels

from .assembled import AssembledSolve

if TYPE_CHECKING:
    from .block_system import BlockSystem
    from .lagged import Lagged
    from .tangent import TangentOperator

#: The time of an iteration of multigrid over that of an assembled one: on the CPU, the same with a shared dilatation,
#: which has twice as many entries in a row, and on CUDA. On an H200 it was 29 to 38 for organs of 20,000 and 100,000
#: elements.
COST_ON_CPU, SHARED_ON_CPU, COST = 5, 3, 32
#: So many times as much on the CPU with contact, whose springs multigrid takes into all its matrices before each solve.
WITH_CONTACT = 2
#: Multigrid is tried if assembled solves cost as much as so many of its iterations; never where soft surfaces meet,
#: whose contact it does not know, nor on the CPU with contact, which assembled solves know better there.
WORTH, NEVER = 10, 1 << 20
#: The length of a step times the largest frequency of a node among fixed ones, above which multigrid solves first. A
#: bunny of 20,000 elements has 70 at 5 kPa and 171 at 30 kPa, and takes 190 and 410 iterations on CUDA. With contact
#: solves need fewer digits: one of 5,000 elements and 1 MPa that falls takes half the time. The long steps of static
#: answers are beyond both.
STIFF, STIFF_WITH_CONTACT = 300.0, 3000.0


class ChosenSolve:
    """Both ways of solving, and the choice between them after each step.

    Args:
        assembled: The assembled matrix.
        operators: The operators of the bodies.
        lagged: Multigrid of each body.
        shares: Whether elements share their dilatation.
        dt: The length of a step [s].

    Attributes:
        diagonal: As for ``AssembledSolve``.
        is_open: Whether the choice is open; otherwise multigrid solves.
        state: Arrays by name to be kept with the state of the first body, so that a resumed run is the same.
    """

    def __init__(
        self,
        assembled: AssembledSolve,
        operators: Sequence[TangentOperator],
        lagged: Sequence[Lagged],
        *,
        shares: bool,
        dt: float,
    ):
        self._dt, self._is_prepared = dt, False
        self.assembled, self._operators, self._lagged = assembled, list(operators), list(lagged)
        self.device = assembled.device
        self._is_assembled = wp.ones(1, dtype=wp.int32, device=self.device)
        self._counts = wp.zeros(kernels.COUNTS, dtype=wp.int32, device=self.device)
        self.is_open = True
        on_cpu = (SHARED_ON_CPU if shares else COST_ON_CPU) * (WITH_CONTACT if assembled.touches else 1)
        # Threads share assembled solves, but not cycles of multigrid.
        self._cost = on_cpu * assembled.threads if self.device.is_cpu else COST

    @property
    def diagonal(self) -> wp.array:
        return self.assembled.diagonal

    @property
    def state(self) -> dict[str, wp.array]:
        return {"assembled": self._is_assembled, "choice": self._counts}

    def prepare(self) -> None:
        """Follow the meshes; not while launches are recorded. Launches must be recorded again after this."""
        self.assembled.follow()
        # A resumed run goes on with its choice.
        is_new = not self._is_prepared and not self._counts.numpy().any()
        most = STIFF_WITH_CONTACT if self.assembled.touches else STIFF
        if is_new and self._dt * self.assembled.largest_frequency() > most:
            self._is_assembled.zero_()
            self._counts[int(kernels.ASSEMBLED) : int(kernels.ASSEMBLED) + 1].fill_(int(kernels.DEAR))
        self._is_prepared = True

    def update(self) -> None:
        """Launch the update after new linearisations."""
        self._either(self.assembled.update, self._update_multigrid)

    def take_contact(self, system: BlockSystem) -> None:
        """Launch the exchange of the contacts of the system in the matrix for the present ones."""
        assert system.contact is not None
        contact = system.contact
        self._either(lambda: self.assembled.take_contact(contact), system.take_springs)

    def iterate(self, system: BlockSystem, x: wp.array) -> None:
        """Launch the iterations of a solve of the system that has begun."""
        self._either(lambda: self.assembled.iterate(system.solver, x), lambda: system.iterate(x))

    def judge(self, system: BlockSystem, iterations: wp.array, status: wp.array) -> None:
        """Launch the choice for the next step, after a step with these results, int32 [worlds]."""

        def judge_set_ups() -> None:
            system.judge_set_ups(iterations, status)

        self._either(None, judge_set_ups)
        if not self.is_open:
            return
        knows_more = system.couples or (self.assembled.touches and self.device.is_cpu)
        worth = NEVER if knows_more else WORTH
        inputs = [iterations, status, int(self.assembled.touches), worth, self._cost, self.assembled.couplings]
        wp.launch(kernels.choose, 1, inputs, [self._counts, self._is_assembled], device=self.device)

    def _update_multigrid(self) -> None:
        blocks = self.assembled.blocks.of(self.diagonal)
        for lagged, operator, own in zip(self._lagged, self._operators, blocks, strict=True):
            lagged.update(operator)
            if self.assembled.touches:
                wp.copy(own, operator.diagonal_blocks())

    def _either(self, assembled: Callable[[], None] | None, other: Callable[[], None]) -> None:
        if self.is_open:
            wp.capture_if(self._is_assembled, assembled, other)
        else:
            other()
