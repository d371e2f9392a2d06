"""SIGINT and SIGTERM: what they end, and when they are delayed."""

from __future__ import annotations

import _thread
import os
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import NoReturn

from .exit_status import Terminated, complain

#: Delay before a signal that could not end the run is checked again [s].
WAIT = 0.02

#: Whether the process may end during an import.
_may_leave = False


@contextmanager
def terminable() -> Iterator[None]:
    """Let SIGINT and SIGTERM end the block by an exception, after the current import or destructor, if any.

    During an import, USD's modules swallow the exception, and the run would continue; NumPy's turn it into
    another one. Python itself ignores exceptions of destructors.
    """

    def interrupt() -> NoReturn:
        raise KeyboardInterrupt

    def terminate() -> NoReturn:
        raise Terminated

    with _handled(_when_heard(interrupt), signal.SIGINT), _handled(_when_heard(terminate), signal.SIGTERM):
        yield


@contextmanager
def leaving_at_once() -> Iterator[None]:
    """Let a signal end the process at once, without waiting for long imports, while nothing can be lost."""
    global _may_leave
    before, _may_leave = _may_leave, True
    try:
        yield
    finally:
        _may_leave = before


def _when_heard(end: Callable[[], NoReturn]) -> Callable[[int, FrameType | None], None]:
    def handle(number: int, frame: FrameType | None) -> None:
        if _is_heard(frame):
            end()
        if _may_leave:
            complain("interrupted", kind="")
            os._exit(128 + number)
        again = threading.Timer(WAIT, _thread.interrupt_main, [number])
        again.daemon = True
        again.start()

    return handle


def _is_heard(frame: FrameType | None) -> bool:
    """Whether an exception ends the run: neither an import nor a destructor called from ``main`` is under way."""
    while frame is not None and not (frame.f_code.co_name == "main" and frame.f_globals.get("__name__") == __package__):
        if frame.f_code.co_filename == "<frozen importlib._bootstrap>" or frame.f_code.co_name == "__del__":
            return False
        frame = frame.f_back
    return True


@contextmanager
def _handled(handler: Callable[[int, FrameType | None], None], number: signal.Signals) -> Iterator[None]:
    """Set another handler for a signal unless it is ignored, as it is in background processes."""
    before = signal.getsignal(number)
    mine = threading.current_thread() is threading.main_thread()
    changed = mine and before not in (signal.SIG_IGN, None)
    if changed:
        signal.signal(number, handler)
    try:
        yield
    finally:
        if changed:
            signal.signal(number, before)
