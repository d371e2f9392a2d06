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


def on_ranks(count: int, *command: str, timeout: float = 900.0) -> subprocess.CompletedProcess:
    """Run Python with these arguments on this number of ranks, even if there are fewer cores. Raises TimeoutError if
    the run hangs; all its processes are then ended."""
    assert MPIRUN is not None
    start = [MPIRUN, "--oversubscribe", "--allow-run-as-root", "-n", str(count), sys.executable, *command]
    environment = {**os.environ, "OMPI_MCA_mpi_yield_when_idle": "1", "OMP_NUM_THREADS": "1"}
    environment["OPENBLAS_NUM_THREADS"] = "1"
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with subprocess.Popen(start, env=environment, **pipes) as process:
        try:
            out, said = process.communicate(timeout=timeout)
        except subprocess.TimeoutExpired:
            process.terminate()  # mpirun ends its ranks
            process.communicate()
            raise TimeoutError(f"{' '.join(command)} on {count} ranks: no end after {timeout} s") from None
    return subprocess.CompletedProcess(start, process.returncode, out, said)
