"""The lock of threads that simulate: one at a time launches."""

from __future__ import annotations

import functools
import time
from collections.abc import Callable
from threading import RLock
from typing import ParamSpec, TypeVar

P = ParamSpec("P")
R = TypeVar("R")

#: How long a thread that has released the lock leaves it to others [s].
PAUSE = 1.0e-4


class SimulationLock:
    """A lock that a thread may take again while it has it, and leave to threads that wait."""

    def __init__(self) -> None:
        self._lock = RLock()
        self._waiting: list[None] = []  # a list, whose changes are atomic

    def __enter__(self) -> None:
        if not self._lock.acquire(blocking=False):
            self._waiting.append(None)
            try:
                self._lock.acquire()
            finally:
                self._waiting.pop()

    def __exit__(self, *_: object) -> None:
        self._lock.release()

    def pass_on(self) -> None:
        """Let another thread have its turn if one waits; the caller has just ended its own."""
        if self._waiting:
            time.sleep(PAUSE)


#: Held while kernels are launched. Warp's captures and tapes belong to the process: what another thread launches in the
#: meantime would be recorded, too, and would run again with each replay.
SIMULATION_LOCK = SimulationLock()


def under_lock(function: Callable[P, R]) -> Callable[P, R]:
    """The same function, one thread at a time."""

    @functools.wraps(function)
    def alone(*args: P.args, **kwargs: P.kwargs) -> R:
        with SIMULATION_LOCK:
            return function(*args, **kwargs)

    return alone
