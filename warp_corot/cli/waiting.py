"""Waits of which nobody knows how long they take: after two seconds a terminal shows what is done and since when."""

from __future__ import annotations

import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager

#: What passes without a word [s], and how often the time is shown anew.
SILENT, EVERY = 2.0, 0.5


@contextmanager
def waiting(what: str) -> Iterator[None]:
    """Show what is waited for, and for how long, while the block runs; on terminals only.

    Args:
        what: In words, as in "meshing liver.stl".
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

    with tqdm(desc=what, leave=False, file=sys.stderr, bar_format="{desc}, {elapsed}") as line:
        line.start_t -= SILENT
        while not over.wait(EVERY):
            line.refresh()
