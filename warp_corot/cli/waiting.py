"""Progress on a terminal: after two seconds the activity and its time, and the progress of a run."""

from __future__ import annotations

import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from warp_corot.io.write.animate import Progress

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


@contextmanager
def progress_bar(count: int) -> Iterator[Progress]:
    """A bar of the frames of a run, on terminals only."""
    from tqdm import tqdm

    form = "{desc}  {percentage:3.0f} % |{bar}| frame {n_fmt} of {total_fmt}, {remaining} left"
    with tqdm(desc="simulating", total=count, leave=False, disable=None, file=sys.stderr, bar_format=form) as bar:
        yield lambda frame, _: bar.update(frame - bar.n)


def _show(what: str, over: threading.Event) -> None:
    if over.wait(SILENT):
        return
    from tqdm import tqdm

    with tqdm(desc=what, leave=False, file=sys.stderr, bar_format="{desc}, {elapsed}") as line:
        line.start_t -= SILENT
        while not over.wait(EVERY):
            line.refresh()
