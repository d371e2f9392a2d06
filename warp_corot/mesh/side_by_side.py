"""Launches on all cores of a CPU: Warp runs a kernel on one core, but the parts of a launch can run in parallel."""

from __future__ import annotations

import functools
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import warp as wp

from warp_corot.inputs.cpu_threads import core_count

#: A kernel with fewer threads is not worth a second core.
LEAST = 8192
#: Parts for each core, because some take longer than others.
PARTS = 4


def in_parts(device: wp.Device, count: int, work: Callable[[int, int], None]) -> None:
    """Do work on the numbers from 0 to ``count``: in parts on all cores of a CPU, in one call on other devices.

    Args:
        device: The device of the launches. While a kernel runs on the CPU, Python is free for other threads.
        count: The number of threads of the kernel.
        work: Called with the start and the end of a part; parts must not depend on one another.
    """
    if not count:
        return
    cores = core_count()
    if not device.is_cpu or count < LEAST or cores == 1:
        work(0, count)
        return
    bounds = [count * part // (PARTS * cores) for part in range(PARTS * cores + 1)]
    work(bounds[0], bounds[1])  # alone, because it may compile and load kernels
    for _ in _pool().map(work, bounds[1:-1], bounds[2:]):
        pass


@functools.cache
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(core_count(), thread_name_prefix="warp_corot")


if hasattr(os, "register_at_fork"):  # a forked process inherits the pool, but not its threads
    os.register_at_fork(after_in_child=_pool.cache_clear)
