"""The linear system of bodies that are solved for together, whose unknowns are those of one body after another's."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import accumulate
from typing import TYPE_CHECKING, Any

import warp as wp

from warp_corot.solvers.halo import ALONE, Halo

from .conjugate_gradients import ConjugateGradients
from .operator import Preconditioner

if TYPE_CHECKING:
    from .operator import Contact
    from .preconditioners import ChosenSolve
    from .tangent import TangentOperator


class VectorBlocks:
    """The bodies' blocks of vectors that they share.

    Args:
        lengths: Number of entries of each body.

    Attributes:
        starts, ends: The first entry of each body, and that after its last one.
        count: Number of entries of all bodies.
    """

    def __init__(self, lengths: Sequence[int]):
        self.ends, self.count = list(accumulate(lengths)), sum(lengths)
        self.starts = [0, *self.ends[:-1]]
        self._views: dict[int, list[wp.array]] = {}

    def of(self, vector: wp.array) -> list[wp.array]:
        """Each body's block of a vector."""
        if vector.ptr not in self._views:
            ends = zip(self.starts, self.ends, strict=True)
            self._views[vector.ptr] = [vector[start:end] for start, end in ends]
        return self._views[vector.ptr]


class BlockSystem:
    """(A + R) x = b: A of each body, and the derivative R of contact.

    The preconditioner is block diagonal: each body's own B, which takes the stiffness of obstacles into account, or G B
    G^T where G does; or the whole matrix is assembled, see ``choice``.

    Args:
        operators: A of each body.
        preconditioners: B of each body.
        contact: The contact of all bodies, or None.
        couples: Whether all bodies and worlds are solved for together.
        choice: Another way of solving, and which of the two is taken; or None.
        most: Maximum number of iterations of a linear solve.
        ranks: The ranks with other nodes of the same worlds.

    Attributes:
        worlds: Number of systems, which are solved each to its own tolerance.
        blocks: The bodies' blocks of vectors.
        x, b: The solution and the right side, vec4.
        solver: The linear solver.
    """

    def __init__(
        self,
        operators: Sequence[TangentOperator],
        preconditioners: Sequence[Preconditioner],
        *,
        contact: Contact | None = None,
        couples: bool = False,
        choice: ChosenSolve | None = None,
        most: int = 1000,
        ranks: Halo = ALONE,
    ):
        self.operators, self.preconditioners, self.contact = list(operators), list(preconditioners), contact
        self.couples = couples
        self.choice, self.ranks, self.device = choice, ranks, self.operators[0].device
        self.blocks = VectorBlocks([len(operator.inverse_mass) for operator in operators])
        self.worlds, self.node_count = 1, self.blocks.count
        if not couples:
            (operator,) = self.operators
            self.worlds, self.node_count = operator.worlds, operator.node_count
        self.x, self.b = (wp.zeros(self.blocks.count, dtype=wp.vec4, device=self.device) for _ in range(2))
        self._r = wp.zeros(0 if contact is None else self.blocks.count, dtype=wp.vec4, device=self.device)
        self.solver = ConjugateGradients(self, self.blocks.count, most=most, ranks=ranks)

    # --- as an operator ----------------------------------------------------------------------------------------------

    def apply(self, x: wp.array, y: wp.array) -> None:
        self.apply_bodies(x, y)
        if self.contact is not None:
            self.contact.add_products(x, y)

    def apply_bodies(self, x: wp.array, y: wp.array) -> None:
        """Launch y = A x, without contact."""
        for operator, a, b in zip(self.operators, self.blocks.of(x), self.blocks.of(y), strict=True):
            operator.apply(a, b)

    def diagonal_blocks(self) -> list[wp.array]:
        """Launch the blocks on the diagonal of each body's A, unless the last ``update`` has found them; mat33
        [worlds * nodes] or longer."""
        if self.choice is not None:
            return self.blocks.of(self.choice.diagonal)
        return [operator.diagonal_blocks() for operator in self.operators]

    # --- as a preconditioner -----------------------------------------------------------------------------------------

    def update(self) -> None:
        """Launch the update after new linearisations or new scales of the operators."""
        if self.choice is not None:
            self.choice.update()
            return
        for preconditioner, own in zip(self.preconditioners, self.operators, strict=True):
            preconditioner.update(own)

    def take_contact(self) -> None:
        """Launch the exchange of contact in the preconditioner for the present one."""
        if self.choice is None:
            self.take_springs()
        else:
            self.choice.take_contact(self)

    def take_springs(self) -> None:
        """Launch the same in the bodies' own preconditioners."""
        assert self.contact is not None
        self.contact.update_springs()
        preconditioners: list[Any] = [each for each in self.preconditioners if self._knows_springs(each)]
        for preconditioner in preconditioners:
            preconditioner.take_springs()

    def _knows_springs(self, preconditioner: Preconditioner) -> bool:
        return hasattr(preconditioner, "take_springs") and self.ranks.is_alone

    def apply_inverse(self, r: wp.array, z: wp.array) -> None:
        """Launch z = B r, or z = G B G^T r where B knows no contact."""
        each = zip(self.preconditioners, self.blocks.of(r), self.blocks.of(z), strict=True)
        for k, (preconditioner, a, b) in enumerate(each):
            if self.contact is None or self._knows_springs(preconditioner):
                preconditioner.apply(a, b)
                continue
            own = self.blocks.of(self._r)[k]
            wp.copy(own, a)
            self.contact.scale(k, own, is_after=False)
            preconditioner.apply(own, b)
            self.contact.scale(k, b, is_after=True)

    # --- solves ------------------------------------------------------------------------------------------------------

    def solve(
        self,
        b: wp.array | None = None,
        x: wp.array | None = None,
        *,
        guessed: bool = False,
        like: wp.array | None = None,
        share: float = 0.0,
    ) -> None:
        """Launch a solve; arguments as for ``ConjugateGradients.launch``, by default for ``x`` with ``b``."""
        b, x = self.b if b is None else b, self.x if x is None else x
        self.solver.begin(b, x, guessed=guessed, like=like, share=share)
        if self.choice is None:
            self.iterate(x)
        else:
            self.choice.iterate(self, x)

    def iterate(self, x: wp.array) -> None:
        """Launch iterations one by one."""
        self.solver.iterate(self.apply_inverse, x)

    def judge(self, iterations: wp.array, status: wp.array) -> None:
        """Launch the decisions about preconditioners after a step with these results, int32 [worlds]."""
        if self.choice is not None:
            self.choice.judge(self, iterations, status)
            return
        self.judge_set_ups(iterations, status)

    def judge_set_ups(self, iterations: wp.array, status: wp.array) -> None:
        """Launch the decisions whether the bodies' own preconditioners are set up again."""
        for preconditioner in self.preconditioners:
            if hasattr(preconditioner, "judge"):
                preconditioner.judge(iterations, status)
