"""Launches in graphs: recordings that are replayed, priorities of streams, and the CPU's mode for subnormal numbers.

In graphs that Warp makes, all kernels have the priority of the stream that launches the graph. Then NCCL's blocks, each
with 640 threads, wait behind all blocks of the elements until these are nearly done.
"""

from __future__ import annotations

import ctypes
import functools
from collections.abc import Callable, Hashable, Iterator
from contextlib import contextmanager
from typing import Any

import warp as wp

from warp_corot.inputs.simulation_lock import SIMULATION_LOCK
from warp_corot.kernels.stepping.subnormals import flush_subnormals, restore_subnormals

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
