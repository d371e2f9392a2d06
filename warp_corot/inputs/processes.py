"""The start of Warp, and the number of processes that ``mpirun`` started, from the environment."""

from __future__ import annotations

import os
import sys
import tempfile

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


def start_warp() -> None:
    """Start Warp, which writes straight to the terminal; hide its message that there is no NVIDIA driver.

    Raises:
        OSError: Warp cannot make the folder of its kernel cache.
    """
    import warp as wp

    sys.stderr.flush()
    with tempfile.TemporaryFile() as said:
        kept = os.dup(2)
        os.dup2(said.fileno(), 2)
        try:
            wp.init()
        finally:
            os.dup2(kept, 2)
            os.close(kept)
        said.seek(0)
        for line in said.read().decode(errors="replace").splitlines():
            if "Could not find or load the NVIDIA CUDA driver" not in line:
                print(line, file=sys.stderr)
