"""How a command ends: its exit status, and the line on stderr that says why."""

from __future__ import annotations

import os
import re
import signal
import sys
from contextlib import AbstractContextManager, nullcontext
from typing import TYPE_CHECKING, Any, TextIO

if TYPE_CHECKING:
    from warp_corot.io.write.animate import Recording

EXIT_CODES = """exit status:
  0    done
  1    a file could not be written, as when the disk is full
  2    the input or an option was wrong; nothing was simulated, no file was touched
  3    the simulation became unstable; the frames before that are kept
  130  interrupted (Ctrl-C), 143 terminated (SIGTERM); the frames written are kept"""


#: What Python's arguments are called that options have.
ARGUMENTS = ("young", "poisson", "density", "dt", "damping", "viscosity", "scale", "duration", "fps", "rotation_level")


class Terminated(KeyboardInterrupt):
    """SIGTERM has come."""


def interrupt_status(signalled: KeyboardInterrupt) -> int:
    """What a shell expects of a program that a signal has ended."""
    return 128 + (signal.SIGTERM if isinstance(signalled, Terminated) else signal.SIGINT)


def as_option(message: str) -> str:
    """A complaint of Python's about an argument, as one about the option of this name."""
    message = re.sub(rf"^({'|'.join(ARGUMENTS)}) is ", lambda found: f"--{found[1].replace('_', '-')} is ", message)
    return re.sub(r", or None$", "", message).replace("it must be None, a", "it must be a")


def kept_so_far(done: Recording) -> str:
    """What there is of a run that has ended early."""
    if not done.frames:
        return "no frame was written"
    return f"{done.frames} frames, {done.simulated:.3g} s, are kept in {done.path}"


def complain(message: str, kind: str = "error") -> None:
    """Print ``warp-corot: KIND: MESSAGE``, in one line whatever is in it."""
    text = " ".join(message.split())
    try:
        with _bars_aside():
            print(f"warp-corot: {kind}: {text}" if kind else f"warp-corot: {text}", file=sys.stderr, flush=True)
    except OSError:  # nobody can be told; what is simulated must not be lost to that
        silence(sys.stderr)


def _bars_aside() -> AbstractContextManager[Any]:
    """Bars that are shown, if any are, come back below what is printed inside."""
    bars = getattr(sys.modules.get("tqdm"), "tqdm", None)  # None also while it is being imported
    return nullcontext() if bars is None else bars.external_write_mode(file=sys.stderr)


def open_streams() -> None:
    """Give standard streams that were closed (``>&-``) to nobody, lest the next file opened takes their number, and
    what is printed goes into it."""
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest free number
    sys.stdout = sys.stdout or open(os.devnull, "w")  # noqa: SIM115
    sys.stderr = sys.stderr or open(os.devnull, "w")  # noqa: SIM115


def silence(stream: TextIO) -> None:
    """Let what is printed go to nobody, what still waits included: Python would complain again when it closes."""
    nobody = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nobody, stream.fileno())
    os.close(nobody)
