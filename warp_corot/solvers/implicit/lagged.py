"""A preconditioner that is kept over many steps, and set up again when solves take longer."""

from __future__ import annotations

from typing import Protocol

import warp as wp

from warp_corot.kernels.implicit import lagged as kernels
from warp_corot.solvers.halo import ALONE, Halo

from .operator import LinearOperator, Preconditioner, Springs


class CostlySetUp(Preconditioner, Protocol):
    """A preconditioner whose set-up costs as much as many iterations.

    Attributes:
        revision: Changes whenever its launches do, so that they must be recorded again.
    """

    revision: int

    def update(self, operator: LinearOperator) -> None: ...

    def apply(self, r: wp.array, z: wp.array) -> None: ...

    def follow(self) -> bool:
        """Follow the mesh; returns whether launches have changed."""
        ...


class At:
    """An operator at other displacements."""

    def __init__(self, operator: LinearOperator, displacements: wp.array):
        self._operator, self.displacements = operator, displacements

    def __getattr__(self, name: str) -> object:
        return getattr(self._operator, name)


class Lagged:
    """The preconditioner of an earlier state, as long as it is good enough.

    Args:
        preconditioner: The preconditioner that is set up now and then.
        operator: The operator of all solves.
        ranks: The ranks with other nodes of the body.

    Attributes:
        state: Arrays by name to be kept with the state of the body, so that a resumed run is the same.
    """

    def __init__(self, preconditioner: CostlySetUp, operator: LinearOperator, ranks: Halo = ALONE):
        self._ranks = ranks
        self.preconditioner, self._operator, self.device = preconditioner, operator, operator.device
        self._counts = wp.zeros(kernels.COUNTS, dtype=wp.int32, device=self.device)
        self._due = wp.zeros(1, dtype=wp.int32, device=self.device)
        self._is_prepared = False
        # Arrays of a mesh that changes keep their length.
        length = len(operator.inverse_mass)
        self._kept = wp.zeros(length, dtype=wp.vec4, device=self.device)
        self._held = wp.zeros(length, dtype=wp.uint8, device=self.device)
        self._then = At(operator, self._kept)

    @property
    def state(self) -> dict[str, wp.array]:
        return {"at": self._kept, "counts": self._counts, "due": self._due}

    def prepare(self) -> None:
        """Follow the mesh; not while launches are recorded. Launches must be recorded again after this."""
        self.preconditioner.follow()
        if self._is_prepared:
            self._due.fill_(int(kernels.PRESENT))
        elif not self._due.numpy()[0]:
            self._due.fill_(int(kernels.AGAIN))
        self._is_prepared = True

    def update(self, operator: LinearOperator) -> None:
        """Launch a set-up if one is due."""
        wp.launch(
            kernels.find_held_changes,
            len(self._held),
            [operator.inverse_mass, self._held, self._due],
            device=self.device,
        )
        self._ranks.max(self._due)
        wp.capture_if(self._due, self._set_up)

    def follow_springs(self, springs: Springs) -> None:
        """Make room for springs; not while launches are recorded, and after ``prepare``."""
        if hasattr(self.preconditioner, "follow_springs"):
            self.preconditioner.follow_springs(springs)

    def take_springs(self) -> None:
        """Launch the exchange of the springs in the preconditioner for the present ones."""
        if hasattr(self.preconditioner, "take_springs"):
            self.preconditioner.take_springs()

    def apply(self, r: wp.array, z: wp.array) -> None:
        self.preconditioner.apply(r, z)

    def judge(self, iterations: wp.array, status: wp.array) -> None:
        """Launch the decision, after a solve, whether the next one is worth a set-up.

        Args:
            iterations, status: Results of the solve, int32 [worlds].
        """
        wp.launch(kernels.judge_solve, 1, [iterations, status, self._counts, self._due], device=self.device)

    def _set_up(self) -> None:
        operator = self._operator
        inputs = [operator.displacements, operator.inverse_mass, self._due, self._counts]
        wp.launch(kernels.keep_state, len(self._held), inputs, [self._kept, self._held], device=self.device)
        wp.launch(kernels.note_setup, 1, [self._due, self._counts], device=self.device)
        self.preconditioner.update(self._then)  # type: ignore[arg-type]
