"""What a command tells its terminal: exit statuses and the reason, signals, waiting, compiling; on several ranks."""

from __future__ import annotations

import _thread
import functools
import os
import re
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext, suppress
from types import FrameType
from typing import TYPE_CHECKING, Any, TextIO

from warp_corot.errors import InputError, UnstableError
from warp_corot.inputs.processes import process_count
from warp_corot.inputs.stopwatch import KERNELS, WATCH

if TYPE_CHECKING:
    import warp as wp

    from warp_corot.io.write.animate import Recording


class Terminated(KeyboardInterrupt):
    """SIGTERM arrived."""


def interrupt_status(signalled: KeyboardInterrupt) -> int:
    """The exit status that a shell expects from a program ended by a signal."""
    return 128 + (signal.SIGTERM if isinstance(signalled, Terminated) else signal.SIGINT)


#: Arguments of Python that the options name otherwise.
NAMED = {"target_elements": "--tets", "every": "--remesh-every"}
NAMED |= {f"{end}_level": f"--remesh-levels {end.upper()}" for end in ("min", "max")}


def as_option(message: str) -> str:
    """Turn a message about arguments of Python into one about the options with these names."""
    from .options import RUN, options_of

    names = {each.name: f"--{each.name.replace('_', '-')}" for each in options_of(RUN)}
    message = re.sub(rf"^({'|'.join(names)}) is ", lambda found: f"{names[found[1]]} is ", message)
    names = {name: option for name, option in names.items() if "_" in name or name in ("unit", "smoothing", "capacity")}
    for name, option in (names | NAMED).items():
        message = re.sub(rf"(?<![-\w]){name}(?=,? (which )?is )", option, message)
        message = re.sub(rf"(?<![-\w]){name}=", f"{option} ", message)
    message = message.replace("take a shorter step, or dt=None, which", "take a shorter --dt, or none, which")
    return re.sub(r", or None$", "", message).replace("it must be None, a", "it must be a")


def early_end(error: BaseException, done: Recording) -> int:
    """Say what ended a recording early, and what is kept; returns the exit status."""
    frames = "1 frame is" if done.frames == 1 else f"{done.frames} frames, {done.simulated:.3g} s, are"
    kept = f"{frames} kept in {done.path}" if done.frames else "no frame was written"
    if isinstance(error, KeyboardInterrupt):
        complain(f"interrupted; {kept}", kind="")
        return interrupt_status(error)
    if isinstance(error, UnstableError):
        complain(f"{as_option(str(error))}; {kept}")
        return 3
    complain(str(error))
    return 1


def complain(message: str, kind: str = "error") -> None:
    """Print ``warp-corot: KIND: MESSAGE``, always as one line."""
    text = " ".join(message.split())
    bars = getattr(sys.modules.get("tqdm"), "tqdm", None)  # None also during its import
    try:
        # Progress bars, if any, are shown again below what is printed.
        with nullcontext() if bars is None else bars.external_write_mode(file=sys.stderr):
            print(f"warp-corot: {kind}: {text}" if kind else f"warp-corot: {text}", file=sys.stderr, flush=True)
    except OSError:  # the message cannot be shown; the simulation must not be lost because of that
        silence(sys.stderr)


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


# --- SIGINT and SIGTERM ----------------------------------------------------------------------------------------------

#: Delay before a signal that could not end the run is checked again [s].
WAIT = 0.02

#: Whether the process may end during an import.
_may_leave = False


@contextmanager
def terminable() -> Iterator[None]:
    """Let SIGINT and SIGTERM end the block by an exception, after the current import or destructor, if any.

    During an import, USD's modules swallow the exception, and the run would continue; NumPy's turn it into
    another one. Python itself ignores exceptions of destructors. Signals that are ignored, as they are in background
    processes, stay so.
    """

    def handle(number: int, frame: FrameType | None) -> None:
        if _is_heard(frame):
            raise Terminated if number == signal.SIGTERM else KeyboardInterrupt
        if _may_leave:
            complain("interrupted", kind="")
            os._exit(128 + number)
        again = threading.Timer(WAIT, _thread.interrupt_main, [number])
        again.daemon = True
        again.start()

    mine = threading.current_thread() is threading.main_thread()
    before = {each: signal.getsignal(each) for each in (signal.SIGINT, signal.SIGTERM)} if mine else {}
    before = {number: handler for number, handler in before.items() if handler not in (signal.SIG_IGN, None)}
    try:
        for number in before:
            signal.signal(number, handle)
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def leaving_at_once() -> Iterator[None]:
    """Let a signal end the process at once, without waiting for long imports, while nothing can be lost."""
    global _may_leave
    before, _may_leave = _may_leave, True
    try:
        yield
    finally:
        _may_leave = before


def _is_heard(frame: FrameType | None) -> bool:
    """Whether an exception ends the run: neither an import nor a destructor called from ``main`` is under way."""
    while frame is not None and not (frame.f_code.co_name == "main" and frame.f_globals.get("__name__") == __package__):
        if frame.f_code.co_filename == "<frozen importlib._bootstrap>" or frame.f_code.co_name == "__del__":
            return False
        frame = frame.f_back
    return True


# --- progress --------------------------------------------------------------------------------------------------------

#: Time before anything is shown [s], and the interval between updates.
SILENT, EVERY = 2.0, 0.5


@contextmanager
def waiting(what: str) -> Iterator[None]:
    """Show the activity and its duration while the block runs; on terminals only.

    Args:
        what: The activity in words: "meshing liver.stl".
    """
    if not sys.stderr.isatty():
        yield
        return
    over = threading.Event()
    shown = threading.Thread(target=_show, args=(what, over), daemon=True)
    shown.start()
    try:
        yield
    finally:
        over.set()
        shown.join()


def _show(what: str, over: threading.Event) -> None:
    if over.wait(SILENT):
        return
    from tqdm import tqdm

    from warp_corot.inputs.loading import progress

    with tqdm(desc=what, leave=False, file=sys.stderr, bar_format="{desc}, {elapsed}") as line:
        line.start_t -= SILENT
        while not over.wait(EVERY):
            words, found = what, progress()
            if found is not None:
                done, count, left = found
                words += f", compiling {done + 1} of {count} modules"
                words += "" if left is None else f", about {max(left, 1.0):.0f} s left"
            line.set_description_str(words)


# --- compiling -------------------------------------------------------------------------------------------------------
# Warp reports a module only when it is compiled. But it makes a folder in its kernel cache for each module that it
# begins to compile, and for none that it finds there; and Python reports every new folder to audit hooks (PEP 578).

#: The device of which the next compilation is said; "" for none.
_device = ""
#: Whether this process has compiled kernels; otherwise they were in Warp's cache.
has_compiled = False


def tell_compiling(device: wp.Device) -> None:
    """Say in one line that kernels are compiled for a device, as soon as any are; say nothing if all are in Warp's
    cache."""
    global _device
    _listen()
    _device = str(device)


def begin_compiling(device: str | None) -> None:
    """Begin to load what all runs launch, while Python imports the rest; that a device is not there is said later."""
    from warp_corot.inputs.checks import checked_device
    from warp_corot.inputs.loading import BODY, begin_loading

    _listen()
    with suppress(InputError):
        begin_loading(BODY, checked_device(device))


@functools.cache
def _listen() -> None:
    """Install the audit hook, and let the stopwatch count Warp's loading of modules; cached, since hooks cannot be
    removed."""
    import warp as wp

    sys.addaudithook(_heard)
    load = wp.Module.load

    @functools.wraps(load)
    def counted(*args: Any, **options: Any) -> Any:
        with WATCH.part(KERNELS):
            return load(*args, **options)

    wp.Module.load = counted


def _heard(event: str, args: tuple[Any, ...]) -> None:
    global has_compiled, _device
    if event != "os.mkdir":
        return
    import warp as wp

    cache = wp.config.kernel_cache_dir  # set when Warp starts
    if cache and os.fsdecode(args[0]).startswith(os.path.join(cache, "")):
        has_compiled = True
        device, _device = _device, ""
        if device:
            complain(f"compiling kernels for {device}, once: this takes some seconds ...", kind="")


# --- several ranks: every rank runs the command, and rank 0 prints and writes ----------------------------------------

#: Time for rank 0 to reach the place where another rank failed, and to report it [s].
REPORTED_WITHIN = 5.0


def are_several() -> bool:
    """Whether ``mpirun`` has started several processes."""
    return process_count() > 1


def end_others(status: int) -> None:
    """On rank 0 of several, after a report: end this process with a status at once, and so all others. MPI's own end
    would wait for them, and they wait for this report."""
    if are_several():
        for stream in (sys.stdout, sys.stderr):
            with suppress(OSError, ValueError):
                stream.flush()
        os._exit(status)
