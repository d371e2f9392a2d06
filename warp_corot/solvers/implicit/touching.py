"""One implicit step with contact: linear solves with nodes held by obstacles, until these are the right ones."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Protocol

import warp as wp

from warp_corot.kernels.implicit.assembled import Couplings
from warp_corot.kernels.implicit.tangent import end_rounds, find_rest, judge_round

from .chosen import ChosenSolve
from .line_search import LineSearch, SharedLineSearch
from .newton import Newton
from .operator import LinearOperator, Preconditioner, Springs

if TYPE_CHECKING:
    from warp_corot.body.soft_body import SoftBody

#: A solve ends at this share of its first residual, because contact may change after it.
SHARE = 0.15
#: A step is solved for if the residual of a solve begins at less than this many times the tolerance.
SETTLED = 10.0
#: Places of contact are found again once the residual of a solve begins at less than this many times the tolerance.
NEAR = 100.0


class HeldNodes(Protocol):
    """Nodes that are held along directions, by ``contact.active_set.ActiveSet``, which explains the members."""

    def launch_again(self) -> None: ...

    def launch_free(self, v: wp.array) -> None: ...

    def launch_yielding(self, v: wp.array) -> None: ...


class Held(Protocol):
    """Contact with obstacles, which holds nodes (``contact.active_set.ActiveSet``, which explains the members), or only
    consists of springs (``contact.borne_set.BorneSet``).
    """

    changed: wp.array
    #: Maximum number of linear solves in a step.
    rounds: int

    @property
    def count(self) -> int: ...

    @property
    def nodes(self) -> HeldNodes | None:
        """The nodes that are held; None if none ever are."""
        ...

    @property
    def springs(self) -> Springs | None:
        """Springs that a preconditioner may take into account, if there are any."""
        ...

    def prepare(self) -> None: ...

    def launch_begin(self, u: wp.array, d: wp.array, blocks: wp.array) -> None: ...

    def launch_imposed(self, d: wp.array) -> None: ...

    def launch_drag(self, x: wp.array, y: wp.array) -> None: ...

    def launch_friction(self, d: wp.array, r: wp.array) -> None: ...

    def launch_couplings(self, couplings: Couplings) -> None: ...

    def add_slopes(
        self, d: wp.array, change: wp.array, search: wp.array, slopes: wp.array, *, apart: bool = False
    ) -> None: ...

    def launch_judgement(self, b: wp.array, q: wp.array, d: wp.array) -> None: ...

    def launch_going(
        self, scalars: wp.array, near: float, changed: wp.array, rounds: wp.array, most: int, going: wp.array
    ) -> None: ...

    def launch_end(self, d: wp.array) -> None: ...

    def launch_meetings(self, met: wp.array, begins: wp.array) -> None: ...


class Rows(Protocol):
    """Forces between bodies, such as ``contact.joined_rows.JoinedRows``, which explains the members."""

    locates: wp.array
    solves: wp.array

    @property
    def total(self) -> wp.array: ...

    def prepare(self) -> None: ...

    def launch_begin(self, k: int, first: int, blocks: wp.array, increment: wp.array, guess: wp.array) -> None: ...

    def reserve(self, motion: float) -> None: ...

    def launch_meetings(self, offset: int, touched: Sequence[wp.array], begins: wp.array) -> None: ...

    def launch_touched(self, touched: Sequence[wp.array]) -> None: ...

    def launch_search(self, offset: int) -> None: ...

    def launch_located(self, d: wp.array, *, is_first: bool) -> None: ...

    def update(self, d: wp.array, *, is_solved: bool = False) -> None: ...

    def find_reached(self, d: wp.array, change: wp.array) -> None: ...

    def add_forces(self, y: wp.array) -> None: ...

    def add_products(self, x: wp.array, y: wp.array) -> None: ...

    def add_slopes(self, d: wp.array, change: wp.array, search: wp.array, slopes: wp.array) -> None: ...

    def launch_end(self, d: wp.array) -> None: ...


class Hold(Protocol):
    """A constraint that is a spring in implicit steps, such as ``contact.grasp.Grasp``."""

    def launch_begin(self) -> None:
        """Launch the beginning of a step."""
        ...

    def add_forces(self) -> None: ...

    def add_stiffness(self, body: SoftBody, p: wp.array, y: wp.array) -> None: ...

    def add_diagonal(self, body: SoftBody, blocks: wp.array) -> None: ...

    def launch_held(self, body: SoftBody) -> None:
        """Launch the addition of its forces on a body after the step to those of contact."""
        ...


class Touching(Protocol):
    """A constraint that implicit steps resolve, such as ``contact.contacts.Contacts``."""

    def launch_motion(self, offset: int) -> None:
        """Launch the motion of obstacles in the ``offset``-th step since the clock was last advanced."""
        ...

    def active_set(self, k: int) -> Held | None:
        """The contact of the k-th body with obstacles, if there are any."""
        ...

    def joined_rows(self) -> Rows | None:
        """The contact of bodies with one another, if they may touch."""
        ...


class FreeOperator:
    """S (A + D) of an operator A and the drag D of friction, for vectors in the range of the projector S.

    Args:
        operator: A.
        held: The source of S.
    """

    def __init__(self, operator: LinearOperator, held: Held):
        self._operator, self._held = operator, held

    def __getattr__(self, name: str) -> object:
        return getattr(self._operator, name)

    def apply(self, x: wp.array, y: wp.array) -> None:
        self._operator.apply(x, y)
        self._held.launch_drag(x, y)


class FreePreconditioner:
    """S T B T S of a preconditioner B, where T takes the stiffness of friction into account; ``update`` is B's."""

    def __init__(self, preconditioner: Preconditioner, held: Held, like: wp.array):
        self.plain, self._held, self._r = preconditioner, held, wp.zeros_like(like)

    def update(self, operator: LinearOperator) -> None:
        self.plain.update(operator)

    def take_springs(self) -> None:
        """Launch the exchange of the springs in B for the present ones."""
        if isinstance(self.plain, ChosenSolve):
            self.plain.take_contact(self._held)
            return
        springs = self._held.springs
        if springs is not None and hasattr(self.plain, "take_springs"):
            springs.update()
            self.plain.take_springs()

    def apply(self, r: wp.array, z: wp.array) -> None:
        nodes = self._held.nodes
        if nodes is None:
            self.plain.apply(r, z)
            return
        wp.copy(self._r, r)
        nodes.launch_yielding(self._r)
        self.plain.apply(self._r, z)
        nodes.launch_yielding(z)


class TouchingSolve:
    """Solves for the step of ``newton`` with one linearisation, or with several; see ``TouchingNewton``.

    If the number of linear solves is not enough, the status of the linear solver in ``newton`` says so.

    Args:
        newton: Newton's method with the operator, residual, preconditioner and linear solver.
        held: The contact of its body.

    Attributes:
        iterations: Linear iterations of all solves of the step, int32 [worlds].
    """

    def __init__(self, newton: Newton, held: Held):
        self.newton, self.held, self.device = newton, held, newton.device
        self._operator = newton.operator
        newton.solver.operator = FreeOperator(newton.operator, held)  # type: ignore[assignment]
        self._preconditioner = FreePreconditioner(newton.preconditioner, held, newton.step)
        like = newton.step
        self._q, self._r, self._rest, self._change = (wp.zeros_like(like) for _ in range(4))
        worlds = self._operator.worlds
        sizes, self._ranks = (worlds, self._operator.node_count, held, self.device), newton.ranks
        self._search = LineSearch(*sizes) if self._ranks.is_alone else SharedLineSearch(*sizes, self._ranks)
        self.iterations = wp.zeros_like(newton.solver.iterations)
        self._rounds, self._going = (wp.zeros(1, dtype=wp.int32, device=self.device) for _ in range(2))

    def launch(self) -> None:
        """Launch the solve for ``newton.step``, from a guess; the residual must be known."""
        self.newton.linearise()
        self.iterations.zero_()
        self.held.launch_begin(self.newton.body.state.displacements, self.newton.step, self.diagonal_blocks())
        self.launch_rounds()
        self.held.launch_end(self.newton.step)

    def diagonal_blocks(self) -> wp.array:
        """Launch the blocks on the diagonal of the matrix without contact, unless the last linearisation has found
        them; mat33 [worlds * nodes] or longer."""
        solver = self.newton.preconditioner
        return solver.diagonal if isinstance(solver, ChosenSolve) else self._operator.diagonal_blocks()

    def launch_rounds(self) -> None:
        """Launch the linear solves, until contact no longer changes."""
        self._rounds.zero_()
        self._going.fill_(1)
        wp.capture_while(self._going, self._round)

    def _round(self) -> None:
        newton, held, d = self.newton, self.held, self.newton.step
        b = newton.residual
        held.launch_imposed(d)
        self._operator.apply(d, self._q)
        wp.launch(find_rest, len(d), [b, self._q], [self._rest], device=self.device)
        wp.copy(self._r, self._rest)
        held.launch_friction(d, self._r)
        self._preconditioner.take_springs()
        newton.solver.launch(self._preconditioner, self._r, self._change, like=b, share=SHARE)
        self._operator.apply(self._change, self._q)
        if held.nodes is not None:
            held.nodes.launch_free(self._q)
        self._search.launch(self._rest, self._q, self._change, d)
        self._operator.apply(d, self._q)
        held.launch_judgement(b, self._q, d)
        self._ranks.max(held.changed)
        inputs = [newton.solver.scalars, newton.solver.iterations, held.changed, SETTLED]
        wp.launch(judge_round, 1, inputs, [self._rounds, self.iterations, self._going], device=self.device)
        held.launch_going(newton.solver.scalars, NEAR, held.changed, self._rounds, held.rounds, self._going)
        outputs = [self._going, newton.solver.status]
        wp.launch(end_rounds, 1, [self._rounds, held.rounds], outputs, device=self.device)
