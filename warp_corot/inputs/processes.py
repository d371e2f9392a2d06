"""The number of processes that ``mpirun`` started, read from the environment, without any communication."""

from __future__ import annotations

import os

#: Variables with the number of processes and of this one: of Open MPI, of MPICH and Intel MPI, and of PMIx.
_NAMES = (("OMPI_COMM_WORLD_SIZE", "OMPI_COMM_WORLD_RANK"), ("PMI_SIZE", "PMI_RANK"), ("PMIX_SIZE", "PMIX_RANK"))


def process_count() -> int:
    """The number of processes; 1 if the environment has none."""
    return max(_number(size) for size, _ in _NAMES) or 1


def process_number() -> int:
    """The number of this process, from 0."""
    return max(_number(rank) for size, rank in _NAMES if _number(size) > 1) if process_count() > 1 else 0


def _number(name: str) -> int:
    given = os.environ.get(name, "")
    return int(given) if given.isdigit() else 0
