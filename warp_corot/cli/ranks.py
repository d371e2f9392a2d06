"""The command on several ranks: every rank runs it, rank 0 speaks and writes."""

from __future__ import annotations

import os
import sys
from typing import Any

#: What ``mpirun`` and SLURM tell each process of how many there are; the same as in ``distributed.mpi``, which starts
#: MPI when it is imported.
SIZES = ("OMPI_COMM_WORLD_SIZE", "PMI_SIZE", "SLURM_STEP_NUM_TASKS")


def are_several() -> bool:
    """Whether ``mpirun`` has started several processes."""
    return any(os.environ.get(name, "1").isdigit() and int(os.environ.get(name, "1")) > 1 for name in SIZES)


def leader() -> bool:
    """Whether this process is the one that speaks and writes; where there are several, MPI is started.

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


def led_simulation(**options: Any) -> Any:
    """The simulation of all ranks, for ``stepping.make_simulation``."""
    from warp_corot.distributed.front import LedSimulation

    return LedSimulation(**options)
