"""Progress bars on terminals, for calls from Python that advance a simulation."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

#: Time before a bar appears [s].
SILENT = 2.0

_shown = True


def show_progress(shown: bool) -> None:
    """Whether terminals show a bar while ``Simulation.advance`` or ``record`` takes more than two seconds.

    They do unless this is called with False. Nothing is shown if stderr is not a terminal.
    """
    global _shown
    _shown = bool(shown)


def is_shown() -> bool:
    """Whether there is a terminal for a bar and bars are not turned off."""
    return _shown and sys.stderr is not None and sys.stderr.isatty()


@contextmanager
def hidden() -> Iterator[None]:
    """Show no bars inside, except the caller's own."""
    global _shown
    before, _shown = _shown, False
    try:
        yield
    finally:
        _shown = before


@contextmanager
def bar_of(
    total: float, unit: str, what: str = "simulating", *, wanted: bool = True
) -> Iterator[Callable[[float], None]]:
    """A bar that appears when the work has taken two seconds, and disappears at the end of the block.

    Args:
        total: The amount of work.
        unit: Its unit: "s", "steps".
        what: What the work is.
        wanted: Whether there is a bar at all.

    Yields:
        A function to be called with the amount that is done.
    """
    if not (wanted and is_shown()):
        yield lambda _: None
        return
    from tqdm import tqdm

    form = "{desc}  {percentage:3.0f} % |{bar}| {n:.4g} of {total:.4g} " + unit + ", {remaining} left"
    options: dict[str, Any] = {"leave": False, "file": sys.stderr, "bar_format": form, "delay": SILENT}
    with tqdm(desc=what, total=total, **options) as bar:

        def update(done: float) -> None:
            bar.update(done - bar.n)

        yield update
