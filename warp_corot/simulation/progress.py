"""Bars on terminals for whoever waits in Python for a simulation to advance."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

#: What passes without a bar [s].
SILENT = 2.0

_shown = True


def show_progress(shown: bool) -> None:
    """Whether terminals show a bar while ``Simulation.advance`` or ``record`` takes more than two seconds.

    They do unless this is called with False. Where stderr is no terminal nothing is shown.
    """
    global _shown
    _shown = bool(shown)


def is_shown() -> bool:
    """Whether there is a terminal to show a bar on, and it is wanted."""
    return _shown and sys.stderr is not None and sys.stderr.isatty()


@contextmanager
def hidden() -> Iterator[None]:
    """No bars but the caller's own inside."""
    global _shown
    before, _shown = _shown, False
    try:
        yield
    finally:
        _shown = before


@contextmanager
def bar_of(total: float, unit: str) -> Iterator[Callable[[float], None]]:
    """A bar that appears when what it tells of has taken two seconds, and goes with the block.

    Args:
        total: What there is to do.
        unit: In what: "s", "steps".

    Yields:
        To be called with how much is done.
    """
    began = time.perf_counter()
    bar: Any = None

    def update(done: float) -> None:
        nonlocal bar
        if bar is None:
            if time.perf_counter() - began < SILENT or not is_shown():
                return
            from tqdm import tqdm

            form = "{desc}  {percentage:3.0f} % |{bar}| {n:.4g} of {total:.4g} " + unit + ", {remaining} left"
            bar = tqdm(desc="simulating", total=total, leave=False, file=sys.stderr, bar_format=form)
            bar.start_t = bar.last_print_t = bar.start_t - (time.perf_counter() - began)
        bar.update(done - bar.n)

    try:
        yield update
    finally:
        if bar is not None:
            bar.close()
