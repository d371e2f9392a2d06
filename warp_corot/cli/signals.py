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

from .say import Terminated, complain

#: Delay before a signal that came during an import is checked again [s].
WAIT = 0.02

#: Whether the process may end during an import.
_may_leave = False


@contextmanager
def terminable() -> Iterator[None]:
    """Let SIGINT and SIGTERM end the block by an exception, after the current import, if any.

    During an import, USD's modules swallow the exception, and the run would continue; NumPy's turn it into
    another one.
    """

    def interrupt() -> NoReturn:
        raise KeyboardInterrupt

    def terminate() -> NoReturn:
        raise Terminated

    with _handled(_after_imports(interrupt), signal.SIGINT), _handled(_after_imports(terminate), signal.SIGTERM):
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


def _after_imports(end: Callable[[], NoReturn]) -> Callable[[int, FrameType | None], None]:
    def handle(number: int, frame: FrameType | None) -> None:
        if not _is_importing(frame):
            end()
        if _may_leave:
            complain("interrupted", kind="")
            os._exit(128 + number)
        again = threading.Timer(WAIT, _thread.interrupt_main, [number])
        again.daemon = True
        again.start()

    return handle


def _is_importing(frame: FrameType | None) -> bool:
    """Whether a module is being imported by code called from ``main``."""
    while frame is not None and not (frame.f_code.co_name == "main" and frame.f_globals.get("__name__") == __package__):
        if frame.f_code.co_filename == "<frozen importlib._bootstrap>":
            return True
        frame = frame.f_back
    return False


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
