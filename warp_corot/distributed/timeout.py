"""Waits for other ranks: if one rank never comes, all ranks end with one line."""

from __future__ import annotations

import math
import os
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from warp_corot.errors import InputError

#: The environment variable with the time that a rank waits [s], and its default.
VARIABLE, SECONDS = "WARP_COROT_PATIENCE", 600.0
#: The calls of a communicator that wait for other ranks.
WATCHED = frozenset({"allgather", "allreduce", "alltoall", "Barrier", "bcast", "gather"})
#: Time that MPI has to end all ranks before this one ends by itself [s].
GRACE = 5.0


def patience() -> float:
    """The time that a rank waits for others [s].

    Raises:
        InputError: ``WARP_COROT_PATIENCE`` is not a positive number.
    """
    given = os.environ.get(VARIABLE, "")
    try:
        found = float(given or SECONDS)
    except ValueError:
        found = math.nan
    if not found > 0.0:
        raise InputError(f"{VARIABLE} is {given!r}; it must be a positive number of seconds")
    return found


class TimedCommunicator:
    """A communicator of MPI with limited waits: after that time it ends all ranks.

    Args:
        comm: The communicator.
        seconds: The longest wait.

    Attributes:
        rank, size: As the communicator's.
        unwatched: The communicator itself, for waits that may last.
    """

    def __init__(self, comm: Any, seconds: float):
        self.unwatched, self.rank, self.size, self._seconds = comm, comm.rank, comm.size, seconds
        self._wait: tuple[float, str] | None = None
        if comm.size > 1:
            threading.Thread(target=self._watch, daemon=True).start()

    def __getattr__(self, name: str) -> Any:
        call = getattr(self.unwatched, name)
        if name not in WATCHED:
            return call

        def watched(*args: Any, **options: Any) -> Any:
            with self.waiting(name):
                return call(*args, **options)

        setattr(self, name, watched)
        return watched

    @contextmanager
    def waiting(self, what: str) -> Iterator[None]:
        """Watch the time of the block, which waits for other ranks."""
        self._wait = time.monotonic(), what
        try:
            yield
        finally:
            self._wait = None

    def _watch(self) -> None:
        while True:
            time.sleep(min(1.0, 0.25 * self._seconds))
            wait = self._wait
            if wait is not None and time.monotonic() - wait[0] > self._seconds:
                self._end(wait[1])

    def _end(self, what: str) -> None:
        stream = sys.__stderr__ or sys.stderr
        stream.write(
            f"warp-corot: rank {self.rank} of {self.size} has waited {self._seconds:g} s for others ({what}), and ends "
            f"all; {VARIABLE} sets how long ranks wait\n"
        )
        stream.flush()
        last = threading.Timer(GRACE, os._exit, [1])
        last.daemon = True
        last.start()
        self.unwatched.Abort(1)
