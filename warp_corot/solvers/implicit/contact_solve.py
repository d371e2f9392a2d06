"""The linear problem of a step with contact: solves with the contacts that act, until these are the right ones."""

from __future__ import annotations

from typing import TYPE_CHECKING

import warp as wp

from warp_corot.kernels.implicit import contact_solve as kernels

from .block_system import BlockSystem
from .conjugate_gradients import LineSearch

if TYPE_CHECKING:
    from .newton import Newton

#: A solve ends at this share of its first residual, because contact may change after it.
SHARE = 0.3
#: Maximum number of linear solves in a step with contact.
ROUNDS = 100


class ContactSolve:
    """Solves for the motions of all bodies of a system that has contact.

    If the number of linear solves is not enough, the status of the linear solver says so.

    Args:
        system: The system, whose x are the motions.
        newtons: Newton's method of each body.

    Attributes:
        iterations: Linear iterations of all solves of a linearisation, int32 [worlds].
    """

    def __init__(self, system: BlockSystem, newtons: list[Newton]):
        assert system.contact is not None
        self.system, self._newtons, self.device, self._contact = system, newtons, system.device, system.contact
        length = system.blocks.count
        self._image, self._q, self._r, self._rest, self._change, self._like = (
            wp.zeros(length, dtype=wp.vec4, device=self.device) for _ in range(6)
        )
        sizes = system.worlds, system.node_count
        places = (0, 0)
        if not system.ranks.is_alone:
            body = newtons[0].operator.number
            places = (body, self._contact.places_of(body) // system.worlds)
        self._search = LineSearch(*sizes, self._contact, self.device, ranks=system.ranks, places=places)
        self.iterations = wp.zeros_like(system.solver.iterations)
        self._outer = wp.zeros(system.worlds, dtype=wp.float64, device=self.device)
        self._rounds, self._going, self._again, *none = (
            wp.zeros(1, dtype=wp.int32, device=self.device) for _ in range(6)
        )
        # Numbers of pairs, whether they are located, and of solves.
        contact = self._contact
        self._of_pairs = [contact.total, contact.locates, contact.solves] if newtons else none

    # --- launches ----------------------------------------------------------------------------------------------------

    def launch_begin(self, offset: int) -> None:
        """Launch the beginning of the ``offset``-th step, from a guess of the motions; increments must be zero at free
        nodes."""
        system, contact = self.system, self._contact
        blocks, each = system.diagonal_blocks(), system.blocks.of(system.x)
        for newton in self._newtons:
            newton.move_held(to_end=True)
        for k, (newton, x) in enumerate(zip(self._newtons, each, strict=True)):
            contact.launch_begin(newton.operator.number, system.blocks.starts[k], blocks[k], newton.increment, x)
        contact.launch_first(offset, system.x)
        for newton in self._newtons:
            newton.move_held(to_end=False)

    def launch(self, guess: wp.array | None = None) -> None:
        """Launch the linear solves, until contact no longer changes; with a guess of the motions' change, vec4, the
        first one begins there and is solved to the tolerance."""
        for count in (self._rounds, self.iterations, *self._of_pairs[1:]):
            count.zero_()
        self.system.apply_bodies(self.system.x, self._image)
        if guess is not None:
            wp.copy(self._change, guess)
            self._round(guessed=True)
        if not self.system.couples:
            self._until_settled()
        else:
            self._again.fill_(1)
            wp.capture_while(self._again, self._until_settled)

    def launch_end(self) -> None:
        """Launch the results of contact for users."""
        self._contact.launch_end(self.system.x)

    # --- pieces ------------------------------------------------------------------------------------------------------

    def _until_settled(self) -> None:
        self._going.fill_(1)
        wp.capture_while(self._going, self._round)
        if self.system.couples:
            self._contact.launch_searched_again(self.system.x, self._rounds, ROUNDS, self._again)

    def _round(self, *, guessed: bool = False) -> None:
        system, contact, d = self.system, self._contact, self.system.x
        contact.locate(d)
        contact.update(d)
        wp.launch(kernels.begin_round, len(d), [system.b, self._image, self._rest, self._r], device=self.device)
        contact.add_forces(self._r)
        wp.launch(kernels.find_scale, len(d), [system.b, self._rest, self._r, self._like], device=self.device)
        system.take_contact()
        system.solve(self._r, self._change, guessed=guessed, like=self._like, share=0.0 if guessed else SHARE)
        system.apply_bodies(self._change, self._q)
        contact.find_reached(d, self._change)
        self._search.launch(self._rest, self._q, self._change, d, self._image)
        self._judge()

    def _judge(self) -> None:
        """Launch the decision whether another round is needed."""
        system, d = self.system, self.system.x
        self._contact.update(d, is_solved=True)
        total, locates, solves = self._of_pairs
        solver = system.solver
        inputs = [solver.scalars, solver.iterations, total]
        outputs = [locates, self._outer, self._rounds, self.iterations, solves, self._going]
        wp.launch(kernels.judge_round, 1, inputs, outputs, device=self.device)
        self._contact.launch_going(d, self._rounds, ROUNDS, self._going)
        system.ranks.max(self._going)
        wp.launch(kernels.end_rounds, 1, [self._rounds, ROUNDS], [self._going, solver.status], device=self.device)
