"""Time steps of several bodies, recorded in graphs and replayed, so that Python does not run in every step.

In graphs that Warp makes, all kernels have the priority of the stream that launches the graph. Then NCCL's blocks, each
with 640 threads, wait behind all blocks of the elements until these are nearly done.
"""

from __future__ import annotations

import ctypes
import functools
from collections import Counter
from collections.abc import Callable, Hashable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

import warp as wp

from warp_corot.inputs.simulation_lock import SIMULATION_LOCK
from warp_corot.kernels.stepping.subnormals import flush_subnormals, restore_subnormals

from .guard import Guard
from .pace import CALM_CHECKS, LIVELY, UNKNOWN
from .stability import (
    BLOCK_INTERVAL,
    FIRST_INTERVAL,
    INTERVAL,
    LIVELY_BLOCK_INTERVAL,
    LIVELY_INTERVAL,
    SafeStep,
)
from .system import Stepper, System

#: Flags of ``cuGraphInstantiateWithFlags``: free what a launch has allocated at the next one, as Warp's graphs do;
#: kernels have the priorities with which they were recorded.
AUTO_FREE_ON_LAUNCH, USE_NODE_PRIORITY = 1, 8


def keep_priorities(graph: wp.Graph) -> None:
    """Let the launches of a graph that was just recorded on a card have the priorities of their streams.

    If the driver cannot do that, the graph is the one that Warp makes, which is slower.
    """
    made = ctypes.c_void_p()
    with wp.ScopedDevice(graph.device):
        flags = ctypes.c_ulonglong(AUTO_FREE_ON_LAUNCH | USE_NODE_PRIORITY)
        failed = _driver().cuGraphInstantiateWithFlags(ctypes.byref(made), graph.graph, flags)
    # Warp instantiates the graph only if nobody else has.
    if not failed:
        graph.graph_exec = made


@functools.cache
def _driver() -> Any:
    """The CUDA driver's library."""
    library = ctypes.CDLL("libcuda.so.1")
    library.cuGraphInstantiateWithFlags.argtypes = [ctypes.c_void_p, ctypes.c_void_p, ctypes.c_ulonglong]
    return library


class FlushedSubnormals:
    """Sets the mode of the thread during launches, and restores it afterwards. It does nothing on CUDA.

    Each place that launches has its own, so that nested ones restore what they found.
    """

    def __init__(self, device: wp.Device):
        self._device = device
        if device.is_cpu:
            self._mode = wp.zeros(1, dtype=wp.uint32, device=device)
            # A recorded launch costs a quarter of a launch through Python's checks.
            self._begin, self._end = (
                wp.launch(kernel, dim=1, inputs=[self._mode], device=device, record_cmd=True)
                for kernel in (flush_subnormals, restore_subnormals)
            )

    @contextmanager
    def __call__(self) -> Iterator[None]:
        """Set the mode for the launches inside, also if they are recorded; it is restored even if they fail."""
        if not self._device.is_cpu:
            yield
            return
        self._begin.launch()
        try:
            yield
        finally:
            self._end.launch()


#: The most recordings that are kept.
MOST = 8


class Replays:
    """Recordings of the same launches, by what may change in them.

    While a user records, launches are made as they are. The first time, too: loading kernels within a recording would
    end it on some drivers.

    Args:
        device: The device.
        loops: Whether launches have conditions, which not all drivers record.
    """

    def __init__(self, device: wp.Device, *, loops: bool = False):
        self._device = device
        self._records = device.is_cpu or not loops or wp.is_conditional_graph_supported()
        self._graphs: dict[Hashable, wp.Graph | None] = {}

    def launch(self, key: Hashable, launches: Callable[[], None]) -> None:
        """Make launches that use the same arrays and values whenever the key is the same."""
        if self._device.is_capturing or not self._records:
            launches()
            return
        if key not in self._graphs:
            if len(self._graphs) == MOST:
                self._graphs.clear()
            self._graphs[key] = None
            launches()
            return
        if self._graphs[key] is None:
            with SIMULATION_LOCK, wp.ScopedCapture(device=self._device) as capture:
                launches()
            self._graphs[key] = capture.graph
        wp.capture_launch(self._graphs[key])

    def forget(self) -> None:
        """Forget all recordings, because arrays have changed."""
        self._graphs.clear()


#: The most steps recorded in one graph: on the CPU, where a replay costs almost nothing and recording a step takes as
#: long as ten steps; and where one launch makes many steps. ``Stepper.graph_steps`` limits both.
CPU_GRAPH_STEPS = 8
BLOCK_STEPS = 1024
#: A segment of up to so many steps is recorded whole when it comes a second time; if the length of steps follows the
#: state, once it has come so often: then there are many different ones, and recording one takes as long as hundreds of
#: replays, which would be felt in a scene that has to keep up.
SHORT, OFTEN = 8, 64
#: The most graphs that are kept.
MOST_GRAPHS = 256


@dataclass(frozen=True)
class Segment:
    """Steps without a measurement in between, and what is launched before and after them, in this order.

    Attributes:
        begins: Whether a run begins, for the guard.
        adopts: Whether positions are adopted without the beginning of a run.
        resumes: Whether the allowed step is taken again after shorter ones at the end of a run.
        measured: The number of steps for which the stable step is measured first; zero: it is not measured.
        fits: Whether the remaining steps are fitted to the end of the run.
        count: Number of steps.
        publishes: Whether positions are published.
        ends: Whether a run ends, for the guard.
        whole: Whether elastic energies are found at the end of the run.
    """

    count: int
    begins: bool = False
    adopts: bool = False
    resumes: bool = False
    measured: int = 0
    fits: bool = False
    publishes: bool = False
    ends: bool = False
    whole: bool = False

    def placed(self, *, begins: bool, ends: bool, whole: bool) -> Segment:
        """The same segment as the first of a run, or the last."""
        return replace(self, begins=begins, publishes=ends, ends=ends, whole=whole)

    def pieces(self, longest: int, *, edges: bool = False) -> Iterator[Segment]:
        """The segment in pieces of a power of two steps, at most ``longest``, so that there are few different pieces.

        With ``edges`` the first and the last piece are single steps: segments differ mostly in how they begin and end.
        """
        sizes = [1, *powers(self.count - 2, longest), 1] if edges and self.count > 2 else powers(self.count, longest)
        piece = replace(self, publishes=False, ends=False, whole=False)
        for size in sizes[:-1]:
            yield replace(piece, count=size)
            piece = Segment(0)
        yield replace(piece, count=sizes[-1], publishes=self.publishes, ends=self.ends, whole=self.whole)


def powers(count: int, longest: int) -> list[int]:
    """Powers of two that add up to a number, at most ``longest`` each, from the largest down; for zero, zero."""
    found = [longest] * (count // longest)
    found += [1 << bit for bit in reversed(range(longest.bit_length())) if count % longest >> bit & 1]
    return found or [0]


class RecordedSteps:
    """Steps that all bodies make together.

    Args:
        system: The bodies, and their clock.
        stepper: The stepper of their integrator.
        guard: The guard, which acts where runs begin and end.
        safe_step: Measures how long a step may be; None if the user gave the step.
    """

    def __init__(
        self,
        system: System,
        stepper: Stepper,
        guard: Guard,
        safe_step: SafeStep | None = None,
    ):
        self._system = system
        self._stepper = stepper
        self._pace = system.pace
        self._guard = guard
        self._safe_step = safe_step
        self._flushed = FlushedSubnormals(system.device)
        self._graphs: dict[Segment, wp.Graph] = {}
        self._asked: Counter[Segment] = Counter()
        #: How calm the bodies are; see ``Schedule``.
        self.calm = UNKNOWN
        self._revisions = (-1, -1)
        self._rewritten = -1

    @property
    def in_blocks(self) -> bool:
        """Whether one launch makes many steps."""
        return self._stepper.many_a_launch

    @property
    def interval(self) -> int:
        """Steps from one measurement to the next."""
        if self.calm == UNKNOWN:
            return FIRST_INTERVAL
        if self.calm == LIVELY:
            return LIVELY_BLOCK_INTERVAL if self.in_blocks else LIVELY_INTERVAL
        return (BLOCK_INTERVAL if self.in_blocks else INTERVAL) * (2 if self.calm == CALM_CHECKS else 1)

    def launch(self, segment: Segment) -> None:
        """Launch a segment; the caller may be recording."""
        if segment.begins:
            self._guard.launch_begin()
        if segment.adopts:
            self._system.adopt_positions()
        with self._flushed():
            self._launch_steps(segment)
        if segment.publishes:
            self._system.publish_positions()
        if segment.ends:
            self._guard.launch_end(whole=segment.whole)

    def _launch_steps(self, segment: Segment) -> None:
        safe_step = self._safe_step
        if segment.resumes:
            assert safe_step is not None
            safe_step.launch_resumption()
        if segment.measured:
            assert safe_step is not None
            self._stepper.forces()
            safe_step.launch(segment.measured)
        if segment.fits:
            assert safe_step is not None
            safe_step.launch_fit()
        self._stepper.steps(segment.count, forces_known=segment.measured > 0)
        self._pace.advance(segment.count)

    def replay(self, segment: Segment) -> None:
        """Replay a segment: one recording if it is short and comes often, else recordings of its pieces."""
        self._follow_bodies()
        if segment.count <= SHORT:
            self._asked[segment] += 1
        if segment in self._graphs or self._asked[segment] > (OFTEN if self._safe_step is not None else 1):
            self._replay_recording(segment)
            return
        if self.in_blocks:
            pieces = segment.pieces(BLOCK_STEPS)
        else:
            longest = CPU_GRAPH_STEPS if self._pace.device.is_cpu else self._stepper.graph_steps
            pieces = segment.pieces(min(longest, self._stepper.graph_steps), edges=True)
        for piece in pieces:
            self._replay_recording(piece)

    def _follow_bodies(self) -> None:
        """Forget the recordings if the bodies' launches have changed."""
        self._system.prepare()
        revision = self._system.launch_revision
        if (self._guard.revision, revision) == self._revisions:
            if self._system.rewritten != self._rewritten:
                self._stepper.prepare()
        else:
            self._graphs.clear()
            self._stepper.prepare()
            self._guard.prepare()
            self._revisions = (self._guard.revision, revision)
        self._rewritten = self._system.rewritten

    def _replay_recording(self, segment: Segment) -> None:
        apart = not self._system.ranks.is_alone
        # On several ranks, the number of iterations of implicit steps is not known.
        if apart and (self._pace.device.is_cpu or self._system.is_implicit):
            self.launch(segment)
            self._pace.forget()
            return
        if segment not in self._graphs:
            if len(self._graphs) >= MOST_GRAPHS:
                self._graphs.clear()
            with wp.ScopedCapture(device=self._pace.device) as capture:
                self.launch(segment)
            if apart:
                keep_priorities(capture.graph)
            self._graphs[segment] = capture.graph
        wp.capture_launch(self._graphs[segment])
        self._pace.forget()
