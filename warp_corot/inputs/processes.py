"""How many processes ``mpirun`` started, as it tells each of them, without a word to the others."""

from __future__ import annotations

import os

#: How many there are, and which this is: by Open MPI, MPICH and Intel MPI, and PMIx.
_NAMES = (("OMPI_COMM_WORLD_SIZE", "OMPI_COMM_WORLD_RANK"), ("PMI_SIZE", "PMI_RANK"), ("PMIX_SIZE", "PMIX_RANK"))


def process_count() -> int:
    """How many processes there are; 1 if nobody says."""
    return max(_number(size) for size, _ in _NAMES) or 1


def process_number() -> int:
    """The number of this process, from 0."""
    return max(_number(rank) for size, rank in _NAMES if _number(size) > 1) if process_count() > 1 else 0


def _number(name: str) -> int:
    given = os.environ.get(name, "")
    return int(given) if given.isdigit() else 0
