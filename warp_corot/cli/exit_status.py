"""The end of a command: its exit status, and the line on stderr with the reason."""

from __future__ import annotations

import os
import re
import signal
import sys
import warnings
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import fields
from typing import TYPE_CHECKING, Any, TextIO

from warp_corot.errors import InputError, UnstableError

if TYPE_CHECKING:
    from warp_corot.io.write.animate import Recording

EXIT_CODES = """exit status:
  0    done
  1    a file could not be written, for example because the disk is full
  2    the input or an option was wrong; nothing was simulated, no file was touched
  3    the simulation became unstable; the frames before that are kept
  130  interrupted (Ctrl-C), 143 terminated (SIGTERM); the written frames are kept"""


class Terminated(KeyboardInterrupt):
    """SIGTERM arrived."""


def interrupt_status(signalled: KeyboardInterrupt) -> int:
    """The exit status that a shell expects from a program ended by a signal."""
    return 128 + (signal.SIGTERM if isinstance(signalled, Terminated) else signal.SIGINT)


def as_option(message: str) -> str:
    """Turn a message that begins with an argument of Python into one about the option with this name."""
    from .options.run import RunOptions

    names = "|".join(each.name for each in fields(RunOptions))
    message = re.sub(rf"^({names}) is ", lambda found: f"--{found[1].replace('_', '-')} is ", message)
    message = message.replace("take a shorter step, or dt=None, which", "take a shorter --dt, or none, which")
    return re.sub(r", or None$", "", message).replace("it must be None, a", "it must be a")


@contextmanager
def as_options(names: Mapping[str, str]) -> Iterator[None]:
    """Replace names of Python's arguments by those of options, anywhere in errors and warnings."""

    def named(text: str) -> str:
        for name, option in names.items():
            text = re.sub(rf"(?<![-\w]){name}(?=,? (which )?is )", option, text)
            text = re.sub(rf"(?<![-\w]){name}=", f"{option} ", text)
        return text

    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        try:
            yield
        except InputError as error:
            raise InputError(named(str(error))) from None
    for warning in said:
        warnings.warn(named(str(warning.message)), warning.category, stacklevel=3)


def kept_so_far(done: Recording) -> str:
    """The result of a run that ended early."""
    if not done.frames:
        return "no frame was written"
    frames = "1 frame is" if done.frames == 1 else f"{done.frames} frames, {done.simulated:.3g} s, are"
    return f"{frames} kept in {done.path}"


def early_end(error: BaseException, done: Recording) -> int:
    """Say what ended a recording early, and what is kept; returns the exit status."""
    if isinstance(error, KeyboardInterrupt):
        complain(f"interrupted; {kept_so_far(done)}", kind="")
        return interrupt_status(error)
    if isinstance(error, UnstableError):
        complain(f"{as_option(str(error))}; {kept_so_far(done)}")
        return 3
    complain(str(error))
    return 1


def complain(message: str, kind: str = "error") -> None:
    """Print ``warp-corot: KIND: MESSAGE``, always as one line."""
    text = " ".join(message.split())
    try:
        with _bars_aside():
            print(f"warp-corot: {kind}: {text}" if kind else f"warp-corot: {text}", file=sys.stderr, flush=True)
    except OSError:  # the message cannot be shown; the simulation must not be lost because of that
        silence(sys.stderr)


def _bars_aside() -> AbstractContextManager[Any]:
    """Hide progress bars, if any, and show them again below what is printed inside."""
    bars = getattr(sys.modules.get("tqdm"), "tqdm", None)  # None also during its import
    return nullcontext() if bars is None else bars.external_write_mode(file=sys.stderr)


def open_streams() -> None:
    """Open standard streams that were closed (``>&-``) on the null device. Otherwise the next opened file would get
    their number, and printed text would go into it."""
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest free number
    sys.stdout = sys.stdout or open(os.devnull, "w")  # noqa: SIM115
    sys.stderr = sys.stderr or open(os.devnull, "w")  # noqa: SIM115


def silence(stream: TextIO) -> None:
    """Discard everything printed, waiting text included; Python would complain again when it closes the stream."""
    nobody = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nobody, stream.fileno())
    os.close(nobody)
