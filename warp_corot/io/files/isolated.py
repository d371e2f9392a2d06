"""Readers in a separate process, which contains the effects of broken files on libraries.

On truncated or damaged files, libraries that read meshes and scans crash, exit the interpreter, never return, exhaust
memory or write to the terminal: of 500 randomly damaged binary .vtk files 30 ended VTK's process, of 300 .mha files
three ended ITK's. The process has limits on memory and time that depend on the file's size, and pickles what it reads.
"""

from __future__ import annotations

import importlib
import os
import pickle
import signal
import subprocess
import sys
import sysconfig
import tempfile
from contextlib import suppress
from pathlib import Path
from typing import Any

#: Memory [bytes] and processor time [s] that a reader may use: a minimum, and more for each byte of the file.
MEMORY, MEMORY_PER_BYTE = 3 * 2**30, 100
SECONDS, SECONDS_PER_BYTE = 30, 5e-6
SHORT_OF_MEMORY = "it asks for more memory than such a file can need"


def read_isolated(module: str, path: Path) -> tuple[Any, str | None]:
    """Let a reader read a file in another process.

    Args:
        module: Full name of a module with a function ``read(path)``.
        path: The file.

    Returns:
        The reader's result, or None; and the reason for None, which is None, too, if that is the reader's result.
    """
    with tempfile.TemporaryDirectory(prefix="warp-corot-") as folder:
        answer = Path(folder) / "answer"
        command = [sys.executable, "-P", "-m", __name__, module, os.fspath(path.absolute()), str(answer)]
        own = {"PYTHONPATH": _search_path(), "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
        done = subprocess.run(
            command,
            env={**os.environ, **own},
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            check=False,
        )
        if done.returncode == 0:
            return pickle.loads(answer.read_bytes())
        return None, _death(done.returncode, done.stderr)


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
    """Why a reader ended without an answer."""
    if status == -getattr(signal, "SIGXCPU", 0):
        return "it did not finish"
    said = stderr.decode(errors="replace")
    if "bad_alloc" in said or "Unable to allocate" in said:
        return SHORT_OF_MEMORY
    if status < 0:
        return f"it crashed ({signal.Signals(-status).name})"
    lines = [line for line in said.splitlines() if line.strip()]
    return lines[-1] if lines else f"it ended with status {status}"


def _bound_resources(path: Path) -> None:
    """Set this process's limits, where the system has them (not on Windows), for a file or all files in a folder."""
    try:
        import resource
    except ImportError:
        return
    size = sum(file.stat().st_size for file in (path.rglob("*") if path.is_dir() else [path]) if file.is_file())
    bounds = [(resource.RLIMIT_CORE, 0), (resource.RLIMIT_CPU, int(SECONDS + SECONDS_PER_BYTE * size))]
    if sys.platform == "linux":
        bounds.append((resource.RLIMIT_DATA, MEMORY + MEMORY_PER_BYTE * size))
    for what, bound in bounds:
        _, most = resource.getrlimit(what)
        wanted = bound if most == resource.RLIM_INFINITY else min(bound, most)
        resource.setrlimit(what, (wanted, most))


def _main(module: str, path: str, answer: str) -> None:
    """Run a reader in the other process, and end that."""
    _bound_resources(Path(path))
    found: tuple[Any, str | None]
    try:
        found = importlib.import_module(module).read(Path(path)), None
    except MemoryError:
        found = None, SHORT_OF_MEMORY
    except ModuleNotFoundError as error:
        found = None, f"it needs the package {error.name}: pip install {error.name}"
    except (Exception, SystemExit) as error:
        words = " ".join(str(error).split()) if not isinstance(error, SystemExit) else ""
        found = None, words if words and _speaks(error) else f"{type(error).__name__} {words}".strip()
    Path(answer).write_bytes(pickle.dumps(found))
    # Libraries that crash during shutdown have finished their work by now.
    os._exit(0)


def _speaks(error: BaseException) -> bool:
    """Whether an error's text is a sentence without its type's name; the text of `KeyError` is not."""
    return not isinstance(error, KeyError | IndexError | AttributeError | TypeError | StopIteration | AssertionError)


if __name__ == "__main__":
    _main(*sys.argv[1:])
