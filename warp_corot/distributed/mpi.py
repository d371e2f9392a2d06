"""MPI, which only this module imports, with limited waits: if one rank never comes, fails or was killed, all end with
one line."""

from __future__ import annotations

import functools
import math
import os
import select
import signal
import socket
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import TracebackType
from typing import Any, TypeVar, cast

import warp as wp

from warp_corot.errors import InputError
from warp_corot.inputs.processes import process_count

V = TypeVar("V")

#: Time for which a waiting rank sleeps between two checks [s].
REST = 0.01
#: Time that ``mpirun`` gets to pass on what a rank says before that rank ends all [s].
SPOKEN = 0.2
#: The environment variable with the time that a rank waits [s], and its default.
VARIABLE, SECONDS = "WARP_COROT_PATIENCE", 600.0
#: The calls of a communicator that wait for other ranks.
WATCHED = frozenset({"allgather", "allreduce", "alltoall", "Barrier", "bcast", "gather"})
#: Time that MPI has to end all ranks before this one ends by itself [s].
GRACE = 5.0
#: Time for other ranks to see that this one still lives, before it ends with them [s].
LAST_LOOK = 0.5


@functools.cache
def library() -> Any:
    """The module ``mpi4py.MPI``, which starts MPI when it is first imported.

    Raises:
        InputError: It is not installed.
    """
    try:
        from mpi4py import MPI
    except (ImportError, RuntimeError) as error:
        raise InputError(
            f'runs on several processes need mpi4py and an MPI library ({error}); pip install "warp-corot[distributed]"'
        ) from None
    return MPI


@functools.cache
def world() -> TimedCommunicator:
    """The program's own communicator of all ranks.

    An uncaught error on one rank ends all of them with one line; otherwise the others would wait for ever. So does a
    rank that has waited too long for others.

    Raises:
        InputError: MPI is not installed, or ``WARP_COROT_PATIENCE`` is not a positive number.
    """
    comm = TimedCommunicator(library().COMM_WORLD.Dup(), longest_wait())
    if comm.size > 1:
        sys.excepthook = functools.partial(_end_all, comm)
    return comm


def choose_device() -> None:
    """Give each process of one machine its own card, if there are cards, as Warp's default device."""
    if process_count() == 1:
        return
    local = library().COMM_WORLD.Split_type(library().COMM_TYPE_SHARED)
    count = wp.get_cuda_device_count()
    if count:
        wp.set_device(f"cuda:{local.rank % count}")
    local.Free()


def meet(comm: Any) -> None:
    """Wait until all ranks have come here, without keeping a core busy, as MPI's own calls do."""
    request = comm.Ibarrier()
    while not request.Test():
        time.sleep(REST)


def awaited(comm: Any, source: int, tag: int) -> Any:
    """The next message from a rank, received without keeping a core busy while it is not there."""
    while (message := comm.improbe(source=source, tag=tag)) is None:
        time.sleep(REST)
    return message.recv()


def all_or_none(act: Callable[[], V], comm: Any) -> V:
    """Call on every rank; if one fails, all raise its error, which names the rank.

    Raises:
        OSError, InputError: As one of the calls.
    """
    found, failed = None, None
    try:
        found = act()
    except (OSError, InputError) as error:
        failed = error
    everybody = comm.allgather(None if failed is None else (type(failed) is not InputError, str(failed)))
    for rank, told in enumerate(everybody):
        if told is not None:
            is_of_system, said = told
            raise (OSError if is_of_system else InputError)(f"rank {rank} of {comm.size}: {said}") from failed
    return cast(V, found)


def _end_all(comm: Any, kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    """End all ranks, because they cannot continue without this one."""
    if not isinstance(error, InputError | KeyboardInterrupt):
        traceback.print_exception(kind, error, trace)
    _say(f"rank {comm.rank} of {comm.size} ends all others: {kind.__name__}: {error}")
    time.sleep(SPOKEN)
    comm.Abort(130 if isinstance(error, KeyboardInterrupt) else 1)


# --- limited waits -------------------------------------------------------------------------------------------------


def longest_wait() -> float:
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
            here = socket.gethostname()
            everybody = comm.allgather((here, os.getpid()))
            #: The processes of this machine, by their ranks.
            self._beside = {rank: pid for rank, (where, pid) in enumerate(everybody) if where == here}
            self._signals, told = os.pipe()
            os.set_blocking(told, False)
            if threading.current_thread() is threading.main_thread():
                # Python would call a handler only after MPI's call, which waits for ever for a killed rank.
                signal.signal(signal.SIGTERM, lambda *_: None)
                signal.set_wakeup_fd(told, warn_on_full_buffer=False)
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
            ready, _, _ = select.select([self._signals], [], [], min(1.0, 0.25 * self._seconds))
            if ready and signal.SIGTERM in os.read(self._signals, 64):
                self._follow_killed()
            wait = self._wait
            if wait is not None and time.monotonic() - wait[0] > self._seconds:
                self._end(wait[1])

    def _follow_killed(self) -> None:
        """End this rank, as MPI's launcher asks all to do when one was killed; the first on each machine says so."""
        living = [rank for rank, pid in self._beside.items() if _lives(pid)]
        killed = [str(rank) for rank in self._beside if rank not in living]
        if killed and self.rank == living[0]:
            _say(f"rank {', '.join(killed)} of {self.size} was killed, which ends all others")
        time.sleep(LAST_LOOK)
        os._exit(128 + signal.SIGTERM)

    def _end(self, what: str) -> None:
        _say(
            f"rank {self.rank} of {self.size} has waited {self._seconds:g} s for others ({what}), and ends all; "
            f"{VARIABLE} sets how long ranks wait"
        )
        last = threading.Timer(GRACE, os._exit, [1])
        last.daemon = True
        last.start()
        self.unwatched.Abort(1)


def _say(line: str) -> None:
    stream = sys.__stderr__ or sys.stderr
    stream.write(f"warp-corot: {line}\n")
    stream.flush()


def _lives(pid: int) -> bool:
    """Whether a process of this machine has not ended."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        pass
    return True
