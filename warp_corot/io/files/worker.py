"""The main function of a reader's process; see `warp_corot.io.files.isolated`."""

from __future__ import annotations

import importlib
import json
import os
import sys
from pathlib import Path
from typing import Any

import numpy as np

#: Memory [bytes] and processor time [s] that a reader may use: a minimum, and more for each byte of the file.
MEMORY, MEMORY_PER_BYTE = 3 * 2**30, 100
SECONDS, SECONDS_PER_BYTE = 30, 5e-6


def _bound_resources(size: int) -> None:
    """Set this process's limits, where the system has them (not on Windows)."""
    try:
        import resource
    except ImportError:
        return
    bounds = [(resource.RLIMIT_CORE, 0), (resource.RLIMIT_CPU, int(SECONDS + SECONDS_PER_BYTE * size))]
    if sys.platform == "linux":
        bounds.append((resource.RLIMIT_DATA, MEMORY + MEMORY_PER_BYTE * size))
    for what, bound in bounds:
        _, most = resource.getrlimit(what)
        wanted = bound if most == resource.RLIM_INFINITY else min(bound, most)
        resource.setrlimit(what, (wanted, most))


def _size(path: Path) -> int:
    """Size of a file, or of all files in a folder [bytes]."""
    files = path.rglob("*") if path.is_dir() else [path]
    return sum(file.stat().st_size for file in files if file.is_file())


def main(module: str, path: str, out: str, report: str) -> int:
    """Run a reader in the other process."""
    _bound_resources(_size(Path(path)))
    said: dict[str, Any] = {}
    try:
        result = importlib.import_module(module).read(Path(path))
        if result is None:
            said = {"foreign": True}
        else:
            np.savez(out, **(result if isinstance(result, dict) else result.to_arrays()))
    except MemoryError:
        said = {"reason": "it asks for more memory than such a file can need"}
    except ModuleNotFoundError as error:
        said = {"reason": f"it needs the package {error.name}: pip install {error.name}"}
    except (Exception, SystemExit) as error:
        words = " ".join(str(error).split()) if not isinstance(error, SystemExit) else ""
        said = {"reason": words if words and _speaks(error) else f"{type(error).__name__} {words}".strip()}
    Path(report).write_text(json.dumps(said))
    sys.stdout.flush()
    # Libraries that crash during shutdown have finished their work by now.
    os._exit(1 if "reason" in said else 0)


def _speaks(error: BaseException) -> bool:
    """Whether an error's text is a sentence without its type's name; the text of `KeyError` is not."""
    return not isinstance(error, KeyError | IndexError | AttributeError | TypeError | StopIteration | AssertionError)


if __name__ == "__main__":
    main(*sys.argv[1:])
