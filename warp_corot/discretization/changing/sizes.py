"""How many things a recorded launch goes through, where their number changes."""

from __future__ import annotations

#: A launch keeps its size down to this share of it.
SLACK = 0.8


def launch_size(count: int, present: int, granule: int = 1, limit: int | None = None) -> int:
    """A size for launches over ``count`` things and some padding, seldom another one than the present.

    A new size is too large by at most a sixteenth or one granule.

    Args:
        count: How many things there are.
        present: The present size, or 0.
        granule: A power of two; the size is a multiple of it.
        limit: How many places there are; a multiple of the granule where that matters.

    Returns:
        At least ``count``; 0 if that is 0.
    """
    if SLACK * present <= count <= present:
        return present
    if count == 0:
        return 0
    step = max(granule, 1 << max(count.bit_length() - 5, 0))
    size = -(-count // step) * step
    return size if limit is None else min(size, limit)
