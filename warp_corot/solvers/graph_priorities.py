"""Graphs whose kernels have the priorities of the streams on which they were recorded.

In graphs that Warp makes, all kernels have the priority of the stream that launches the graph. Then NCCL's blocks, each
with 640 threads, wait behind all blocks of the elements until these are nearly done.
"""

from __future__ import annotations

import ctypes
import functools
from typing import Any

import warp as wp

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
