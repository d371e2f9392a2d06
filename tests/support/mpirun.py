"""Commands on several ranks of this machine."""

import os
import shutil
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

_BESIDE = Path(sys.executable).with_name("mpirun")
MPIRUN = str(_BESIDE) if _BESIDE.exists() else shutil.which("mpirun")

needs_mpi = pytest.mark.skipif(
    MPIRUN is None or find_spec("mpi4py") is None, reason='needs MPI: pip install "warp-corot[distributed]"'
)


def on_ranks(count: int, *command: str, timeout: float = 240.0, **options) -> subprocess.CompletedProcess:
    """Run Python with these arguments on so many ranks, more than there are cores if need be."""
    assert MPIRUN is not None
    start = [MPIRUN, "--oversubscribe", "--allow-run-as-root", "-n", str(count), sys.executable]
    environment = {**os.environ, "OMPI_MCA_mpi_yield_when_idle": "1", "OMP_NUM_THREADS": "1"}
    environment["OPENBLAS_NUM_THREADS"] = "1"
    return subprocess.run(
        [*start, *command], env=environment, capture_output=True, text=True, check=False, timeout=timeout, **options
    )
