"""Files that are broken read by other libraries: nothing on the terminal, no more memory than they can need."""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path


@contextmanager
def quietly() -> Iterator[list[str]]:
    """Nothing that is written to stdout and stderr inside is seen, libraries' own writing included.

    Yields:
        What was written, a line each, once the block is left.
    """
    said: list[str] = []
    with tempfile.TemporaryFile() as file:
        kept = []
        _flush()
        for number in (1, 2):
            with suppress(OSError):  # closed, and so seen by nobody
                kept.append((number, os.dup(number)))
                os.dup2(file.fileno(), number)
        try:
            yield said
        finally:
            _flush()
            for number, before in kept:
                os.dup2(before, number)
                os.close(before)
            file.seek(0)
            said += file.read().decode(errors="replace").splitlines()


def _flush() -> None:
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError, ValueError, AttributeError):
            stream.flush()


#: Memory that reading a file may take [bytes]: at least, and more for each byte of the file.
MEMORY, MEMORY_PER_BYTE = 4 << 30, 200
#: The least for USD stages, whose arrays are hardly compressed: OpenUSD fills what it asks for, which takes time.
USD_MEMORY = 1 << 30


@contextmanager
def bounded(path: Path, memory: int = MEMORY) -> Iterator[None]:
    """Inside no more memory can be had than such a file can need, whatever a broken one says that it holds.

    Libraries then say that there is not enough. Only where the system has such bounds, as Linux has.

    Args:
        path: The file.
        memory: What it may take at least [bytes].
    """
    used = _data_in_use()
    if used is None:
        yield
        return
    import resource

    size = path.stat().st_size if path.is_file() else 0
    before = resource.getrlimit(resource.RLIMIT_DATA)
    most = used + memory + MEMORY_PER_BYTE * size
    known = [bound for bound in before if bound != resource.RLIM_INFINITY]
    resource.setrlimit(resource.RLIMIT_DATA, (min([most, *known]), before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_DATA, before)


def _data_in_use() -> int | None:
    """What Linux counts as this process's data [bytes]; None elsewhere."""
    try:
        for line in Path("/proc/self/status").read_text().splitlines():
            if line.startswith("VmData:"):
                return int(line.split()[1]) << 10
    except OSError:
        pass
    return None
