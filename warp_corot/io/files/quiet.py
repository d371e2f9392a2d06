"""Reading broken files with other libraries: no output on the terminal, and limited memory."""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path


@contextmanager
def quietly() -> Iterator[list[str]]:
    """Hide everything that is written to stdout and stderr inside, also by libraries.

    Yields:
        The hidden output, a list of lines, after the block.
    """
    said: list[str] = []
    with tempfile.TemporaryFile() as file:
        kept = []
        _flush()
        for number in (1, 2):
            with suppress(OSError):  # closed, so that nobody sees the output
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


#: Memory that reading a file may take [bytes]: a minimum, and more for each byte of the file.
MEMORY, MEMORY_PER_BYTE = 4 << 30, 200
#: The minimum for USD stages, whose arrays are hardly compressed: OpenUSD fills what it allocates, which takes time.
USD_MEMORY = 1 << 30


@contextmanager
def bounded(path: Path, memory: int = MEMORY) -> Iterator[None]:
    """Limit memory inside the block to what the file can need, whatever sizes a broken file claims.

    Libraries then report that memory is short. The limit exists only on systems that support it, for example Linux.

    Args:
        path: The file.
        memory: Minimum of the limit [bytes].
    """
    used = None  # Linux's count of this process's data
    with suppress(OSError):
        lines = Path("/proc/self/status").read_text().splitlines()
        used = next((int(line.split()[1]) << 10 for line in lines if line.startswith("VmData:")), None)
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
