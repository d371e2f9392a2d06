"""The wall time of a thread, divided among the parts of its work."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

#: The part in which kernels are compiled, or loaded from Warp's cache.
KERNELS = "kernels"


class Stopwatch(threading.local):
    """Each moment counts for one part: for the innermost one that has begun.

    Attributes:
        parts: Wall time of each part so far [s], in the order in which parts began.
    """

    def __init__(self) -> None:
        self.begin("", 0.0)

    def begin(self, part: str, spent: float) -> None:
        """Start anew with a part on which some time [s] has been spent already."""
        self.parts, self._part, self._since = {part: spent}, part, time.perf_counter()

    def switch(self, part: str) -> str:
        """Go on with another part; returns the one before."""
        now, before = time.perf_counter(), self._part
        self.parts[before] += now - self._since
        self.parts.setdefault(part, 0.0)
        self._part, self._since = part, now
        return before

    @contextmanager
    def part(self, name: str, into: Any = None) -> Iterator[None]:
        """Count the block for a part; its time is also added to the attribute of that name of ``into``."""
        before = self.switch(name)
        so_far = self.parts[name]
        try:
            yield
        finally:
            self.switch(before)
            if into is not None:
                setattr(into, name, getattr(into, name) + self.parts[name] - so_far)

    def clock(self) -> float:
        """A time [s] that stands still while kernels are compiled or loaded."""
        return time.perf_counter() - self.parts.get(KERNELS, 0.0)


#: The stopwatch of each thread.
WATCH = Stopwatch()
