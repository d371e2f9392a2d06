"""Time steps of several bodies, recorded in graphs and replayed, so that Python is out of the loop."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import warp as wp

from ..kernels.integrate import advance_clock
from ..subnormals import FlushedSubnormals
from .integrator import Stepper

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
        clock: Number of steps done, int64 [1].
    """

    def __init__(self, bodies: Sequence[SoftBody], steppers: Sequence[Stepper], clock: wp.array):
        self._bodies = bodies
        self._steppers = steppers
        self._clock = clock
        self._flushed = FlushedSubnormals(clock.device)
        self._graphs: dict[tuple[int, bool], wp.Graph] = {}
        self._revisions: tuple[int, ...] = ()

    def launch(self, count: int, *, whole: bool) -> None:
        """Launch steps; ``whole`` ones take over positions first and publish them after."""
        with self._flushed():
            self._launch(count, whole)

    def _launch(self, count: int, whole: bool) -> None:
        if whole:
            for body in self._bodies:
                body.adopt_positions()
        for stepper in self._steppers:
            stepper.steps(count)
        wp.launch(advance_clock, dim=1, inputs=[count], outputs=[self._clock], device=self._clock.device)
        if whole:
            for body in self._bodies:
                body.publish_positions()

    def replay(self, count: int, *, whole: bool) -> None:
        """Replay recorded steps, recording them first where they are new or the bodies' launches have changed."""
        revisions = tuple(body.revision for body in self._bodies)
        if revisions != self._revisions:
            self._graphs.clear()
            self._revisions = revisions
        key = (count, whole)
        if key not in self._graphs:
            with wp.ScopedCapture(device=self._clock.device) as capture:
                self.launch(count, whole=whole)
            self._graphs[key] = capture.graph
        wp.capture_launch(self._graphs[key])

    def replay_runs(self, count: int) -> None:
        """Replay any number of steps as few recordings; positions are taken over before and published after."""
        for body in self._bodies:
            body.adopt_positions()
        in_blocks = all(stepper.many_a_launch for stepper in self._steppers)
        for size in (BLOCK_STEPS, GRAPH_STEPS, 1) if in_blocks else (GRAPH_STEPS, 1):
            for _ in range(count // size):
                self.replay(size, whole=False)
            count %= size
        for body in self._bodies:
            body.publish_positions()
