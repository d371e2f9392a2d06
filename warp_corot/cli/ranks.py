"""The command on several ranks: every rank runs it, and rank 0 prints and writes."""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import Any

from warp_corot.errors import InputError
from warp_corot.inputs.processes import process_count, process_number

#: Time for rank 0 to reach the place where another rank failed, and to report it [s].
WAIT = 5.0


def are_several() -> bool:
    """Whether ``mpirun`` has started several processes."""
    return process_count() > 1


def speaks() -> bool:
    """Whether this process prints: the only one, or the first of several."""
    return process_number() == 0


def leads() -> bool:
    """Whether this process writes files; starts MPI if there are several processes.

    Raises:
        InputError: MPI is not installed.
    """
    if not are_several():
        return True
    from warp_corot.distributed import mpi

    return bool(mpi.world().rank == 0)


def fall_silent() -> None:
    """Print nothing from here on: rank 0 prints for all ranks."""
    null = open(os.devnull, "w")  # noqa: SIM115 (open as long as the process lives)
    sys.stdout = sys.stderr = null


def end_others(status: int) -> None:
    """On rank 0 of several, after a report: end this process with a status at once, and so all others. MPI's own end
    would wait for them, and they wait for this report."""
    if are_several():
        for stream in (sys.stdout, sys.stderr):
            with suppress(OSError, ValueError):
                stream.flush()
        os._exit(status)


def let_others_speak() -> None:
    """Wait before a failed rank ends, because ``mpirun`` then ends all others: rank 0 first reports the error."""
    time.sleep(WAIT)


@contextmanager
def one_first(others: WaitingRanks | None) -> Iterator[None]:
    """Run the block on rank 0 first, then on all other ranks together, which find the kernels that rank 0 compiled;
    only on rank 0 if the others wait for it."""
    if others is not None or not are_several():
        yield
        return
    from warp_corot.distributed import mpi

    comm = mpi.world()
    if comm.rank > 0:
        mpi.meet(comm)
    try:
        yield
    finally:
        if comm.rank == 0:
            mpi.meet(comm)


def hands_out(options: Sequence[argparse.Namespace]) -> bool:
    """Whether rank 0 makes the bodies and hands out parts; otherwise every rank makes them whole, as contact, shared
    rotations and multigrid require."""
    from warp_corot.solvers import INTEGRATORS

    from .options import integrator_name, is_static

    args = options[0]
    touches = (args.tool, args.tool_path, args.blade, args.drop, args.touch, args.self_contact)
    whole = any(each.remesh or each.rotation_level is not None for each in options)
    implicit = is_static(args) or INTEGRATORS[integrator_name(args)].is_implicit
    return are_several() and args.ground is None and not any(touches) and not whole and not implicit


class WaitingRanks:
    """On rank 0: the ranks that wait for their parts of the bodies."""

    def __init__(self) -> None:
        self._are_waiting = True
        self._sim: Any = None

    def simulation(self, **options: Any) -> Any:
        """The simulation of the bodies, whose parts these ranks get."""
        from warp_corot.distributed.root_facade import RootSimulation

        self._are_waiting = False
        self._sim = RootSimulation(in_parts=True, **options)
        return self._sim

    def dismiss(self, error: InputError) -> None:
        """End these ranks, because of an error before the first step."""
        from warp_corot.distributed import mpi, scatter_mesh

        if self._are_waiting:
            self._are_waiting = False
            scatter_mesh.dismiss(error, mpi.world())
        elif self._sim is not None:
            self._sim.end()


def serve(device: str | None) -> None:
    """On other ranks than 0: make the steps of the parts that rank 0 hands out.

    Raises:
        InputError, UnstableError: As on rank 0.
    """
    from warp_corot.distributed.root_facade import Workers

    Workers.joined(device).serve()


def led_simulation(**options: Any) -> Any:
    """The simulation of all ranks, each of which has the whole bodies."""
    from warp_corot.distributed.root_facade import RootSimulation

    return RootSimulation(**options)
