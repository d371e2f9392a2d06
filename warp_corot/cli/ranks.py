"""The command on several ranks: every rank runs it, rank 0 speaks and writes."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from warp_corot.inputs.processes import process_count, process_number

#: Time for rank 0 to come as far as another one that failed, and to say so [s].
WAIT = 5.0


def are_several() -> bool:
    """Whether ``mpirun`` has started several processes."""
    return process_count() > 1


def speaks() -> bool:
    """Whether this process prints: the only one, or the first of several."""
    return process_number() == 0


def leads() -> bool:
    """Whether this process writes; where there are several, MPI is started.

    Raises:
        InputError: MPI is not there.
    """
    if not are_several():
        return True
    from warp_corot.distributed import mpi

    return bool(mpi.world().rank == 0)


def fall_silent() -> None:
    """Print nothing from here on: what all ranks have to say, rank 0 says."""
    null = open(os.devnull, "w")  # noqa: SIM115 (open as long as the process lives)
    sys.stdout = sys.stderr = null


def let_others_speak() -> None:
    """Wait before the end of a rank that failed, at which ``mpirun`` ends all others: rank 0 says what is wrong."""
    time.sleep(WAIT)


@contextmanager
def one_first() -> Iterator[None]:
    """Rank 0 first, then all others at once: what it compiles they find."""
    if not are_several():
        yield
        return
    from warp_corot.distributed import mpi

    comm = mpi.world()
    if comm.rank > 0:
        comm.Barrier()
    try:
        yield
    finally:
        if comm.rank == 0:
            comm.Barrier()


def led_simulation(**options: Any) -> Any:
    """The simulation of all ranks, for ``stepping.make_simulation``."""
    from warp_corot.distributed.front import LedSimulation

    return LedSimulation(**options)
