"""MPI, which only this module imports."""

from __future__ import annotations

import functools
import sys
import time
import traceback
from collections.abc import Callable
from types import TracebackType
from typing import Any, TypeVar, cast

import warp as wp

from warp_corot.errors import InputError
from warp_corot.inputs.processes import process_count

from .timeout import TimedCommunicator, longest_wait

V = TypeVar("V")

#: Time for which a waiting rank sleeps between two checks [s].
REST = 0.01
#: Time that ``mpirun`` gets to pass on what a rank says before that rank ends all [s].
SPOKEN = 0.2


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
    stream = sys.__stderr__ or sys.stderr
    stream.write(f"warp-corot: rank {comm.rank} of {comm.size} ends all others: {kind.__name__}: {error}\n")
    stream.flush()
    time.sleep(SPOKEN)
    comm.Abort(130 if isinstance(error, KeyboardInterrupt) else 1)
