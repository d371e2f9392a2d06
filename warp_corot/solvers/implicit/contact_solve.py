"""The linear problem of a step with contact: solves with the contacts that act, until these are the right ones."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import warp as wp

from warp_corot.kernels.implicit import contact_solve as kernels
from warp_corot.kernels.implicit.tangent import find_rest

from .block_system import BlockSystem
from .conjugate_gradients import LineSearch, SharedLineSearch

if TYPE_CHECKING:
    from .contact_constraints import ObstacleContact
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
        self.system, self._newtons, self.device = system, newtons, system.device
        length = system.blocks.count
        self._image, self._q, self._r, self._rest, self._change = (
            wp.zeros(length, dtype=wp.vec4, device=self.device) for _ in range(5)
        )
        contacts = [each for each in system.contacts if each is not None]
        sizes = system.worlds, system.node_count
        self._search = LineSearch(*sizes, self, self.device)
        if not system.ranks.is_alone:
            self._search = SharedLineSearch(*sizes, contacts[0], self.device, system.ranks)
        self.iterations = wp.zeros_like(system.solver.iterations)
        self._outer = wp.zeros(system.worlds, dtype=wp.float64, device=self.device)
        self._rounds, self._going, self._again, *none = (
            wp.zeros(1, dtype=wp.int32, device=self.device) for _ in range(6)
        )
        self._holds = any(each.nodes is not None for each in contacts)
        self._is_alone = len(contacts) == 1
        self._changed = contacts[0].changed if self._is_alone else wp.zeros(1, dtype=wp.int32, device=self.device)
        soft = system.soft
        # Numbers of pairs, whether they are located, and of solves.
        self._of_pairs = none if soft is None else [soft.total, soft.locates, soft.solves]

    # --- launches ----------------------------------------------------------------------------------------------------

    def launch_begin(self, offset: int) -> None:
        """Launch the beginning of the ``offset``-th step, from a guess of the motions; increments must be zero at free
        nodes."""
        system, soft = self.system, self.system.soft
        blocks, each = system.diagonal_blocks(), system.blocks.of(system.x)
        for newton in self._newtons:
            newton.move_held(to_end=True)
        if soft is not None:
            for k, (newton, x) in enumerate(zip(self._newtons, each, strict=True)):
                soft.launch_begin(k, system.blocks.starts[k], blocks[k], newton.increment, x)
            soft.launch_search(offset)
        for newton, contact, x, own in zip(self._newtons, system.contacts, each, blocks, strict=True):
            if contact is not None:
                contact.launch_begin(newton.body.state.displacements, x, own)
        if soft is not None:
            soft.launch_first(system.x)
        for newton in self._newtons:
            newton.move_held(to_end=False)

    def launch_again(self) -> None:
        """Launch the beginning of another linearisation of the same step."""
        for contact in self.system.contacts:
            if contact is not None and contact.nodes is not None:
                contact.nodes.launch_again()

    def launch(self) -> None:
        """Launch the linear solves, until contact no longer changes."""
        for count in (self._rounds, self.iterations, *self._of_pairs[1:]):
            count.zero_()
        if not self._holds:
            self.system.apply_bodies(self.system.x, self._image)
        if self.system.soft is None:
            self._until_settled()
        else:
            self._again.fill_(1)
            wp.capture_while(self._again, self._until_settled)

    def launch_end(self) -> None:
        """Launch the results of contact for users."""
        for contact, (x,) in self._each(self.system.x):
            contact.launch_end(x)
        if self.system.soft is not None:
            self.system.soft.launch_end(self.system.x)

    def add_slopes(self, d: wp.array, change: wp.array, search: wp.array, slopes: wp.array) -> None:
        """Launch the power of all contacts along a change; see ``line_search``."""
        if self.system.soft is not None:
            self.system.soft.add_slopes(d, change, search, slopes)
        for contact, (own, part) in self._each(d, change):
            contact.add_slopes(own, part, search, slopes)

    # --- pieces ------------------------------------------------------------------------------------------------------

    def _until_settled(self) -> None:
        self._going.fill_(1)
        wp.capture_while(self._going, self._round)
        if self.system.soft is not None:
            self.system.soft.launch_searched_again(self.system.x, self._rounds, ROUNDS, self._again)

    def _round(self) -> None:
        system, soft, d = self.system, self.system.soft, self.system.x
        for contact, (own,) in self._each(d):
            contact.launch_imposed(own)
        if soft is not None:
            soft.launch_located(d)
            soft.update(d)
        if self._holds:
            system.apply_bodies(d, self._image)
        wp.launch(find_rest, len(d), [system.b, self._image, self._rest], device=self.device)
        wp.copy(self._r, self._rest)
        if soft is not None:
            soft.add_forces(self._r)
        for contact, (own, r) in self._each(d, self._r):
            contact.launch_friction(own, r)
        system.take_contact()
        system.solve(self._r, self._change, like=system.b, share=SHARE)
        system.apply_bodies(self._change, self._q)
        if soft is not None:
            soft.find_reached(d, self._change)
        self._search.launch(self._rest, self._q, self._change, d, self._image)
        self._judge()

    def _judge(self) -> None:
        """Launch the choice of the nodes that obstacles hold from now on, and whether another round is needed."""
        system, soft, d = self.system, self.system.soft, self.system.x
        b = system.b
        if soft is not None:
            soft.update(d, is_solved=True)
            wp.copy(self._r, b)
            b = self._r
            soft.add_forces(b)
        for contact, (forces, q, own) in self._each(b, self._image, d):
            contact.launch_judgement(forces, q, own)
            if not self._is_alone:
                wp.launch(kernels.gather_change, 1, [contact.changed, self._changed], device=self.device)
        system.ranks.max(self._changed)
        total, locates, solves = self._of_pairs
        solver = system.solver
        inputs = [solver.scalars, solver.iterations, self._changed, total]
        outputs = [locates, self._outer, self._rounds, self.iterations, solves, self._going]
        wp.launch(kernels.judge_round, 1, inputs, outputs, device=self.device)
        for contact, (own,) in self._each(d):
            contact.launch_going(own, locates, self._rounds, ROUNDS, self._going)
        if not self._is_alone:
            self._changed.zero_()
        wp.launch(kernels.end_rounds, 1, [self._rounds, ROUNDS], [self._going, solver.status], device=self.device)

    def _each(self, *vectors: wp.array) -> Iterator[tuple[ObstacleContact, list[wp.array]]]:
        """The contacts of bodies with obstacles, and these bodies' blocks of vectors."""
        blocks = [self.system.blocks.of(vector) for vector in vectors]
        for k, contact in enumerate(self.system.contacts):
            if contact is not None:
                yield contact, [each[k] for each in blocks]
