"""Time steps of several bodies, recorded in graphs and replayed, so that Python is out of the loop."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import warp as wp

from ..subnormals import FlushedSubnormals
from .integrator import Stepper
from .pace import Pace
from .safe_step import BLOCK_INTERVAL, INTERVAL, SafeStep

if TYPE_CHECKING:
    from ..body import SoftBody

#: Steps recorded in one graph; more where a launch is many steps.
GRAPH_STEPS = 64
BLOCK_STEPS = 1024


class RecordedSteps:
    """Steps that all bodies make together.

    Args:
        bodies: On one device.
        steppers: One for each body.
        pace: The clock.
        safe_step: What measures how long a step may be, if none was given.
    """

    def __init__(
        self, bodies: Sequence[SoftBody], steppers: Sequence[Stepper], pace: Pace, safe_step: SafeStep | None = None
    ):
        self._bodies = bodies
        self._steppers = steppers
        self._pace = pace
        self._safe_step = safe_step
        self._flushed = FlushedSubnormals(pace.device)
        self._graphs: dict[tuple[int, bool, int], wp.Graph] = {}
        #: Whether the bodies have hardly been strained for a while, so that their stiffness needs a look half as often.
        self.is_calm = False
        self._revisions: tuple[int, ...] = ()

    @property
    def in_blocks(self) -> bool:
        """Whether many steps are one launch."""
        return all(stepper.many_a_launch for stepper in self._steppers)

    @property
    def interval(self) -> int:
        """Steps from one measurement to the next."""
        return (BLOCK_INTERVAL if self.in_blocks else INTERVAL) * (2 if self.is_calm else 1)

    def launch(self, count: int, *, whole: bool = False, measured: bool = False) -> None:
        """Launch steps.

        Args:
            count: How many; none with ``measured`` measures only.
            whole: Whether positions are taken over before and published after.
            measured: Whether it is measured first how long these steps may be.
        """
        with self._flushed():
            self._launch(count, whole, measured)

    def _launch(self, count: int, whole: bool, measured: bool) -> None:
        if whole:
            self.adopt_positions()
        if measured:
            assert self._safe_step is not None
            for stepper in self._steppers:
                stepper.forces()
            self._safe_step.launch(self.interval)
        if count:
            for stepper in self._steppers:
                stepper.steps(count, forces_known=measured)
            self._pace.advance(count)
        else:
            for body in self._bodies:
                body.node_forces.zero_()
        if whole:
            self.publish_positions()

    def replay(self, count: int, *, whole: bool = False, measured: bool = False) -> None:
        """Replay recorded steps, recording them first where they are new or the bodies' launches have changed."""
        revisions = tuple(body.revision for body in self._bodies)
        if revisions != self._revisions:
            self._graphs.clear()
            self._revisions = revisions
            for stepper in self._steppers:
                stepper.prepare()
        key = (count, whole, self.interval if measured else 0)
        if key not in self._graphs:
            with wp.ScopedCapture(device=self._pace.device) as capture:
                self.launch(count, whole=whole, measured=measured)
            self._graphs[key] = capture.graph
        wp.capture_launch(self._graphs[key])

    def retime(self) -> None:
        """Take the step that the state allows now, also where it is another at once."""
        assert self._safe_step is not None
        with self._flushed():
            for stepper in self._steppers:
                stepper.forces()
            self._safe_step.retime()
        for body in self._bodies:
            body.node_forces.zero_()

    def replay_many(self, count: int) -> None:
        """Replay any number of steps as few recordings."""
        for size in (BLOCK_STEPS, GRAPH_STEPS, 1) if self.in_blocks else (GRAPH_STEPS, 1):
            for _ in range(count // size):
                self.replay(size)
            count %= size

    def adopt_positions(self) -> None:
        """Take over what somebody wrote to positions since they were published."""
        for body in self._bodies:
            body.adopt_positions()

    def publish_positions(self) -> None:
        for body in self._bodies:
            body.publish_positions()
