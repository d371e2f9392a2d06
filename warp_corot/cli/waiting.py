"""Progress on a terminal: after two seconds the activity and its time, and how many kernels are still to compile."""

from __future__ import annotations

import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager

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

    with tqdm(desc=what, leave=False, file=sys.stderr, bar_format="{desc}, {elapsed}") as line:
        line.start_t -= SILENT
        while not over.wait(EVERY):
            line.set_description_str(what + _left_to_compile())


def _left_to_compile() -> str:
    from warp_corot.inputs.loading import progress

    found = progress()
    if found is None:
        return ""
    done, count, left = found
    words = f", compiling {done + 1} of {count} modules"
    return words if left is None else f"{words}, about {max(left, 1.0):.0f} s left"
