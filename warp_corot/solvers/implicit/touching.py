"""One implicit step with contact: linear solves with nodes held by obstacles, until these are the right ones."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

import warp as wp

from warp_corot.kernels.implicit.tangent import add_counts, add_vectors, find_rest

from .newton import Newton
from .operator import LinearOperator, Preconditioner

if TYPE_CHECKING:
    from warp_corot.body.soft_body import SoftBody


class Held(Protocol):
    """Something that holds nodes along directions, such as ``contact.active_set.ActiveSet``, which explains the
    members.
    """

    changed: wp.array

    def prepare(self) -> None: ...

    def launch_begin(self, d: wp.array) -> None: ...

    def launch_free(self, v: wp.array) -> None: ...

    def launch_imposed(self, d: wp.array) -> None: ...

    def launch_drag(self, x: wp.array, y: wp.array) -> None: ...

    def launch_friction(self, d: wp.array, r: wp.array) -> None: ...

    def launch_judgement(self, b: wp.array, q: wp.array, d: wp.array) -> None: ...

    def launch_end(self, d: wp.array) -> None: ...


class Rows(Protocol):
    """Forces between bodies, such as ``contact.joined_rows.JoinedRows``, which says what its members do."""

    locates: wp.array

    @property
    def total(self) -> wp.array: ...

    def prepare(self) -> None: ...

    def launch_begin(self, k: int, first: int, blocks: wp.array, increment: wp.array, guess: wp.array) -> None: ...

    def launch_search(self, offset: int) -> None: ...

    def launch_located(self, d: wp.array, *, is_first: bool) -> None: ...

    def update(self, d: wp.array) -> None: ...

    def add_forces(self, y: wp.array) -> None: ...

    def add_products(self, x: wp.array, y: wp.array) -> None: ...

    def add_slopes(self, d: wp.array, change: wp.array, search: wp.array, slopes: wp.array) -> None: ...

    def launch_end(self, d: wp.array) -> None: ...


class Hold(Protocol):
    """A constraint that is a spring in implicit steps, such as ``contact.grasp.Grasp``."""

    def launch_begin(self) -> None:
        """Launch what a step begins with."""
        ...

    def add_forces(self) -> None: ...

    def add_stiffness(self, body: SoftBody, p: wp.array, y: wp.array) -> None: ...

    def add_diagonal(self, body: SoftBody, blocks: wp.array) -> None: ...

    def launch_held(self, body: SoftBody) -> None:
        """Launch that its forces on a body after the step are among those of contact."""
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
    """S B of a preconditioner B; ``update`` is B's."""

    def __init__(self, preconditioner: Preconditioner, held: Held):
        self._preconditioner, self._held = preconditioner, held

    def update(self, operator: LinearOperator) -> None:
        self._preconditioner.update(operator)

    def apply(self, r: wp.array, z: wp.array) -> None:
        self._preconditioner.apply(r, z)
        self._held.launch_free(z)


class TouchingSolve:
    """Solves for the step of ``newton`` with one linearisation.

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
        self._preconditioner = FreePreconditioner(newton.preconditioner, held)
        like = newton.step
        self._q, self._r, self._change = (wp.zeros_like(like) for _ in range(3))
        self.iterations = wp.zeros_like(newton.solver.iterations)

    def launch(self) -> None:
        """Launch ``newton.step``, from a guess of it, after the residual."""
        newton, held = self.newton, self.held
        self._operator.take(newton.body.state.displacements)
        self._preconditioner.update(self._operator)
        self.iterations.zero_()
        held.launch_begin(newton.step)
        wp.capture_while(held.changed, self._round)
        held.launch_end(newton.step)

    def _round(self) -> None:
        newton, held, d = self.newton, self.held, self.newton.step
        b = newton.residual
        held.launch_imposed(d)
        self._operator.apply(d, self._q)
        wp.launch(find_rest, len(d), [b, self._q], [self._r], device=self.device)
        held.launch_friction(d, self._r)
        newton.solver.launch(self._preconditioner, self._r, self._change, like=b)
        wp.launch(add_vectors, len(d), [self._change], [d], device=self.device)
        inputs = [newton.solver.iterations]
        wp.launch(add_counts, len(self.iterations), inputs, [self.iterations], device=self.device)
        self._operator.apply(d, self._q)
        held.launch_judgement(b, self._q, d)
