"""One implicit step of all bodies together, whose soft surfaces touch one another or themselves."""

from __future__ import annotations

from collections.abc import Sequence

import warp as wp

from warp_corot.kernels.contact import joined as kernels
from warp_corot.kernels.implicit.tangent import end_rounds, find_rest

from .conjugate_gradients import ConjugateGradients
from .line_search import LineSearch
from .newton import Newton
from .operator import LinearOperator, Preconditioner
from .touching import NEAR, SETTLED, SHARE, FreePreconditioner, Held, Rows

#: Maximum number of linear solves in a step.
ROUNDS = 100


class Parts:
    """The bodies' parts of vectors that they share.

    Args:
        lengths: Number of entries of each body.
        device: The device.
    """

    def __init__(self, lengths: Sequence[int], device: wp.Device):
        self.device, self.count = device, sum(lengths)
        self.starts = [sum(lengths[:k]) for k in range(len(lengths))]
        self._lengths = list(lengths)
        self._views: dict[int, list[wp.array]] = {}

    def of(self, vector: wp.array) -> list[wp.array]:
        """Each body's part of a vector."""
        if vector.ptr not in self._views:
            ends = zip(self.starts, self._lengths, strict=True)
            self._views[vector.ptr] = [vector[start : start + length] for start, length in ends]
        return self._views[vector.ptr]


class JoinedOperator:
    """S (A + D + R) of all bodies: A of each, the drag D of obstacles, and the derivative R of forces between them."""

    def __init__(self, operators: Sequence[LinearOperator], held: Sequence[Held | None], rows: Rows, parts: Parts):
        self._operators, self._held, self._rows, self._parts = operators, held, rows, parts
        self.device, self.worlds, self.node_count = parts.device, 1, parts.count

    def apply(self, x: wp.array, y: wp.array) -> None:
        self._apply_each(x, y)
        self._rows.add_products(x, y)
        self._drag(x, y)

    def apply_freely(self, x: wp.array, y: wp.array) -> None:
        """Launch y = A x."""
        self._apply_each(x, y)

    def _apply_each(self, x: wp.array, y: wp.array) -> None:
        for operator, a, b in zip(self._operators, self._parts.of(x), self._parts.of(y), strict=True):
            operator.apply(a, b)

    def _drag(self, x: wp.array, y: wp.array) -> None:
        for held, a, b in zip(self._held, self._parts.of(x), self._parts.of(y), strict=True):
            if held is not None:
                held.launch_drag(a, b)


class JoinedPreconditioner:
    """The preconditioner of each body, as S T B T S where obstacles hold it; see ``FreePreconditioner``."""

    def __init__(
        self, preconditioners: Sequence[Preconditioner], held: Sequence[Held | None], like: wp.array, parts: Parts
    ):
        self._parts = parts
        self._each: list[Preconditioner | FreePreconditioner] = [
            preconditioner if own is None else FreePreconditioner(preconditioner, own, part)
            for preconditioner, own, part in zip(preconditioners, held, parts.of(like), strict=True)
        ]

    def update(self, operator: LinearOperator) -> None:
        """Do nothing: ``JoinedSolve`` keeps the bodies' preconditioners up to date."""

    def take_springs(self) -> None:
        """Launch the exchange of the springs of obstacles for the present ones."""
        for preconditioner in self._each:
            if isinstance(preconditioner, FreePreconditioner):
                preconditioner.take_springs()

    def apply(self, r: wp.array, z: wp.array) -> None:
        for preconditioner, a, b in zip(self._each, self._parts.of(r), self._parts.of(z), strict=True):
            preconditioner.apply(a, b)


class JoinedSolve:
    """Solves for the steps of all bodies, with one linearisation of each.

    Args:
        newtons: Newton's method of each body, whose operator, residual, step and preconditioner are used.
        held: The contact of each body with obstacles, or None.
        rows: The contact of the bodies with one another.
        worlds: Number of worlds, which are solved together.
        tolerance: Residual of a linear solve over the forces that are out of balance at the beginning.
        most: Maximum number of iterations of a linear solve.

    Attributes:
        iterations, status: Results of the step's linear solves, the same for every world, int32 [worlds].
    """

    def __init__(
        self,
        newtons: Sequence[Newton],
        held: Sequence[Held | None],
        rows: Rows,
        *,
        worlds: int,
        tolerance: float,
        most: int,
    ):
        self._newtons, self._held, self._rows, self._worlds = newtons, held, rows, worlds
        self.device = newtons[0].device
        self._parts = parts = Parts([len(newton.step) for newton in newtons], self.device)
        self._d, self._b, self._rest, self._r, self._q, self._change = (
            wp.zeros(parts.count, dtype=wp.vec4, device=self.device) for _ in range(6)
        )
        for newton, step, residual in zip(newtons, parts.of(self._d), parts.of(self._b), strict=True):
            newton.step, newton.residual = step, residual
        self._operator = JoinedOperator([newton.operator for newton in newtons], held, rows, parts)
        self._preconditioner = JoinedPreconditioner([newton.preconditioner for newton in newtons], held, self._d, parts)
        self._solver = ConjugateGradients(self._operator, parts.count, most=most)  # type: ignore[arg-type]
        self._solver.tolerance.fill_(tolerance)
        self._search = LineSearch(1, parts.count, self, self.device)
        self._going, self._rounds, self._linear, self._changed = (
            wp.zeros(1, dtype=wp.int32, device=self.device) for _ in range(4)
        )
        self._both = wp.zeros((2, worlds), dtype=wp.int32, device=self.device)
        self.iterations, self.status = self._both[0], self._both[1]

    def launch(self, offset: int) -> None:
        """Launch the solve for the steps of all bodies, from guesses; the residuals must be known."""
        self.linearise()
        self.launch_begin(offset)
        self.launch_rounds()
        self.launch_end()

    def linearise(self) -> None:
        """Launch the linearisation of all bodies."""
        for newton in self._newtons:
            newton.linearise()

    def launch_begin(self, offset: int) -> None:
        """Launch the beginning of a step; increments must be zero at free nodes."""
        rows, blocks = self._rows, []
        for k, newton in enumerate(self._newtons):
            blocks.append(newton.operator.diagonal_blocks())
            newton.move_held(to_end=True)
            rows.launch_begin(k, self._parts.starts[k], blocks[k], newton.increment, newton.step)
        rows.launch_search(offset)
        for newton, held, d, own in zip(self._newtons, self._held, self._parts.of(self._d), blocks, strict=True):
            if held is not None:
                held.launch_begin(newton.body.state.displacements, d, own)
        rows.locates.fill_(1)
        rows.launch_located(self._d, is_first=True)
        for newton in self._newtons:
            newton.move_held(to_end=False)

    def launch_again(self) -> None:
        """Launch the beginning of another linearisation of the same step."""
        for held, _d in self._each_held(self._d):
            if held.nodes is not None:
                held.nodes.launch_again()

    def launch_rounds(self) -> None:
        """Launch the linear solves, until contact no longer changes."""
        for count in (self._rounds, self._linear, self._changed, self._rows.locates, self._rows.solves):
            count.zero_()
        self._going.fill_(1)
        wp.capture_while(self._going, self._round)
        wp.launch(kernels.spread, self._worlds, [self._linear, self._solver.status, self._both], device=self.device)

    def launch_end(self) -> None:
        """Launch the results of contact for users."""
        for held, d in self._each_held(self._d):
            held.launch_end(d)
        self._rows.launch_end(self._d)

    def _round(self) -> None:
        rows, d = self._rows, self._d
        for held, part in self._each_held(d):
            held.launch_imposed(part)
        rows.launch_located(d, is_first=False)
        rows.update(d)
        self._operator.apply_freely(d, self._q)
        self._launch(find_rest, [self._b, self._q, self._rest])
        wp.copy(self._r, self._rest)
        rows.add_forces(self._r)
        for (held, part), r in zip(self._each_held(d), self._held_parts(self._r), strict=True):
            held.launch_friction(part, r)
        self._preconditioner.take_springs()
        self._solver.launch(self._preconditioner, self._r, self._change, like=self._b, share=SHARE)
        self._operator.apply_freely(self._change, self._q)
        rows.find_reached(d, self._change)
        self._search.launch(self._rest, self._q, self._change, d)
        self._judge()

    def add_slopes(self, d: wp.array, change: wp.array, search: wp.array, slopes: wp.array) -> None:
        """Launch the power of all contacts along a change; see ``line_search``."""
        self._rows.add_slopes(d, change, search, slopes)
        for (held, own), part in zip(self._each_held(d), self._held_parts(change), strict=True):
            held.add_slopes(own, part, search, slopes)

    def _judge(self) -> None:
        """Launch the choice of the nodes that obstacles hold from now on, and whether another round is needed."""
        rows, d = self._rows, self._d
        rows.update(d, is_solved=True)
        self._operator.apply_freely(d, self._q)
        wp.copy(self._r, self._b)
        rows.add_forces(self._r)
        each = zip(self._each_held(d), self._held_parts(self._r), self._held_parts(self._q), strict=True)
        for (held, part), b, q in each:
            held.launch_judgement(b, q, part)
            wp.launch(kernels.gather_change, 1, [held.changed, self._changed], device=self.device)
        inputs = [self._solver.scalars, self._solver.iterations, self._changed, rows.total, SETTLED, NEAR]
        outputs = [rows.locates, self._rounds, self._linear, rows.solves, self._going]
        wp.launch(kernels.judge_round, 1, inputs, outputs, device=self.device)
        for held, _d in self._each_held(d):
            held.launch_going(self._solver.scalars, NEAR, held.changed, self._rounds, ROUNDS, self._going)
        outputs = [self._going, self._solver.status]
        wp.launch(end_rounds, 1, [self._rounds, ROUNDS], outputs, device=self.device)

    def _each_held(self, vector: wp.array) -> list[tuple[Held, wp.array]]:
        """The contacts of bodies with obstacles, and these bodies' parts of a vector."""
        each = zip(self._held, self._parts.of(vector), strict=True)
        return [(held, part) for held, part in each if held is not None]

    def _held_parts(self, vector: wp.array) -> list[wp.array]:
        return [part for _, part in self._each_held(vector)]

    def _launch(self, kernel: wp.Kernel, arguments: list) -> None:
        wp.launch(kernel, self._parts.count, arguments, device=self.device)
