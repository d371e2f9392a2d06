"""Readers in a separate process, which contains the effects of broken files on libraries.

On truncated or damaged files, libraries that read meshes crash, exit the interpreter, never return, exhaust memory or
write to the terminal. The process has limits on memory and time that depend on the file's size, and returns arrays.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import sysconfig
import tempfile
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray


def read_isolated(module: str, path: Path) -> tuple[dict[str, NDArray[Any]] | None, str | None]:
    """Let a reader read a file in another process.

    Args:
        module: Full name of a module with a function ``read(path)`` that returns an object with ``to_arrays()``, or
            arrays by name; None if the file has another format.
        path: The file.

    Returns:
        The arrays, or None; and the reason for None, which is None, too, if the file has another format.
    """
    with tempfile.TemporaryDirectory(prefix="warp-corot-") as folder:
        out = Path(folder) / "arrays.npz"
        report = Path(folder) / "report.json"
        command = [
            sys.executable,
            "-P",
            "-m",
            f"{__package__}.worker",
            module,
            os.fspath(path.absolute()),
            str(out),
            str(report),
        ]
        own = {"PYTHONPATH": _search_path(), "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
        done = subprocess.run(
            command,
            env={**os.environ, **own},
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            check=False,
        )
        said = json.loads(report.read_text()) if report.is_file() and report.stat().st_size else {}
        if done.returncode == 0 and out.is_file():
            with np.load(out, allow_pickle=False) as arrays:
                return {name: arrays[name] for name in arrays.files}, None
        if done.returncode == 0 and said.get("foreign"):
            return None, None
        return None, said.get("reason") or _death(done.returncode, done.stderr)


def _search_path() -> str:
    """The folders in which the process looks for modules: the standard library first, then the package.

    The script's folder and the current one are left out: a file ``json.py`` or ``nt.py`` there would be imported in
    place of another module, and a script named like that would run once more.
    """
    standard = [sysconfig.get_path(name) for name in ("stdlib", "platstdlib")]
    package = str(Path(__file__).parents[3])
    script = getattr(sys.modules.get("__main__"), "__file__", None)
    left_out = {os.path.dirname(os.path.abspath(script))} if script else set()
    with suppress(FileNotFoundError):
        left_out.add(os.getcwd())
    others = [path for path in sys.path if path and os.path.abspath(path) not in left_out]
    folders = [*standard, os.path.join(standard[1], "lib-dynload"), package, *others]
    return os.pathsep.join(dict.fromkeys(folders))


def _death(status: int, stderr: bytes) -> str:
    """Why a reader ended without a report."""
    if status == -getattr(signal, "SIGXCPU", 0):
        return "it did not finish"
    said = stderr.decode(errors="replace")
    if "bad_alloc" in said or "Unable to allocate" in said:
        return "it asks for more memory than such a file can need"
    if status < 0:
        return f"it crashed ({signal.Signals(-status).name})"
    lines = [line for line in said.splitlines() if line.strip()]
    return lines[-1] if lines else f"it ended with status {status}"
