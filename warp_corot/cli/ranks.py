"""The command on several ranks: every rank runs it with the whole bodies, and rank 0 prints and writes."""

from __future__ import annotations

import os
import sys
import time
from contextlib import suppress

from warp_corot.inputs.processes import process_count, process_number

#: Time for rank 0 to reach the place where another rank failed, and to report it [s].
WAIT = 5.0


def are_several() -> bool:
    """Whether ``mpirun`` has started several processes."""
    return process_count() > 1


def speaks() -> bool:
    """Whether this process prints: the only one, or the first of several."""
    return process_number() == 0


def fall_silent() -> None:
    """Print nothing from here on: rank 0 prints for all ranks."""
    null = open(os.devnull, "w")  # noqa: SIM115 (open as long as the process lives)
    sys.stdout = sys.stderr = null


def end_others(status: int) -> None:
    """On rank 0 of several, after a report: end this process with a status at once, and so all others. MPI's own end
    would wait for them, and they wait for this report."""
    if are_several():
        for stream in (sys.stdout, sys.stderr):
            with suppress(OSError, ValueError):
                stream.flush()
        os._exit(status)


def let_others_speak() -> None:
    """Wait before a failed rank ends, because ``mpirun`` then ends all others: rank 0 first reports the error."""
    time.sleep(WAIT)
