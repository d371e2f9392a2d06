"""The linear system of bodies that are solved for together, whose unknowns are those of one body after another's."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import accumulate
from typing import TYPE_CHECKING

import warp as wp

from warp_corot.solvers.halo import ALONE, Halo

from .conjugate_gradients import ConjugateGradients
from .operator import Preconditioner

if TYPE_CHECKING:
    from .contact_constraints import ObstacleContact, SoftContact
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
    """S (A + D + R) x = b: A of each body, the drag D and the projector S of its contact with obstacles, and the
    derivative R of contact between soft surfaces.

    All vectors are in the range of S. The preconditioner is block diagonal: S T B T S of each body's own B, where T
    takes the stiffness of friction into account; or the whole matrix is assembled, see ``choice``.

    Args:
        operators: A of each body.
        preconditioners: B of each body.
        contacts: The contact of each body with obstacles, or None.
        soft: The contact of soft surfaces, or None. With it all bodies and worlds are solved for together.
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
        contacts: Sequence[ObstacleContact | None] = (),
        soft: SoftContact | None = None,
        choice: ChosenSolve | None = None,
        most: int = 1000,
        ranks: Halo = ALONE,
    ):
        self.operators, self.preconditioners, self.soft = list(operators), list(preconditioners), soft
        self.contacts = list(contacts) or [None] * len(self.operators)
        self.choice, self.ranks, self.device = choice, ranks, self.operators[0].device
        self.blocks = VectorBlocks([len(operator.inverse_mass) for operator in operators])
        self.worlds, self.node_count = 1, self.blocks.count
        if soft is None:
            (operator,) = self.operators
            self.worlds, self.node_count = operator.worlds, operator.node_count
        self.x, self.b = (wp.zeros(self.blocks.count, dtype=wp.vec4, device=self.device) for _ in range(2))
        holds = any(each is not None and each.nodes is not None for each in self.contacts)
        self._r = wp.zeros(self.blocks.count if holds else 0, dtype=wp.vec4, device=self.device)
        self.solver = ConjugateGradients(self, self.blocks.count, most=most, ranks=ranks)

    # --- as an operator ----------------------------------------------------------------------------------------------

    def apply(self, x: wp.array, y: wp.array) -> None:
        self.apply_bodies(x, y)
        if self.soft is not None:
            self.soft.add_products(x, y)
        for contact, a, b in zip(self.contacts, self.blocks.of(x), self.blocks.of(y), strict=True):
            if contact is not None:
                contact.launch_drag(a, b)

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
        for contact, preconditioner in zip(self.contacts, self.preconditioners, strict=True):
            springs = None if contact is None else contact.springs
            if springs is not None and hasattr(preconditioner, "take_springs"):
                springs.update()
                preconditioner.take_springs()

    def apply_inverse(self, r: wp.array, z: wp.array) -> None:
        """Launch z = S T B T S r."""
        each = zip(self.preconditioners, self.contacts, self.blocks.of(r), self.blocks.of(z), strict=True)
        for k, (preconditioner, contact, a, b) in enumerate(each):
            nodes = None if contact is None else contact.nodes
            if nodes is None:
                preconditioner.apply(a, b)
                continue
            own = self.blocks.of(self._r)[k]
            wp.copy(own, a)
            nodes.launch_yielding(own)
            preconditioner.apply(own, b)
            nodes.launch_yielding(b)

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
