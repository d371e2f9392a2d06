"""SIGINT and SIGTERM: what they end, and when they have to wait."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import NoReturn

from .say import Terminated


@contextmanager
def terminable() -> Iterator[None]:
    """SIGTERM ends what runs as Ctrl-C does."""

    def terminate(*_: object) -> NoReturn:
        raise Terminated

    with _handled(terminate, signal.SIGTERM):
        yield


@contextmanager
def signals_waiting() -> Iterator[None]:
    """Both take effect only after what runs here: USD's modules swallow an exception that comes while they are
    imported, and the run would go on."""
    came: list[int] = []

    def wait(number: int, _: object) -> None:
        came.append(number)

    with _handled(wait, signal.SIGINT, signal.SIGTERM):
        yield
    for number in came:
        signal.raise_signal(number)


@contextmanager
def _handled(handler: Callable[..., None], *numbers: int) -> Iterator[None]:
    """Another handler for signals that are not ignored, as those of what is started in the background are."""
    before = {number: signal.getsignal(number) for number in numbers}
    mine = threading.current_thread() is threading.main_thread()
    changed = {number: kept for number, kept in before.items() if mine and kept not in (signal.SIG_IGN, None)}
    for number in changed:
        signal.signal(number, handler)
    try:
        yield
    finally:
        for number, kept in changed.items():
            signal.signal(number, kept)
