"""Sizes of recorded launches over items whose number changes."""

from __future__ import annotations

#: A launch keeps its size until it needs less than this fraction of it.
SLACK = 0.8


def launch_size(count: int, present: int, granule: int = 1, limit: int | None = None) -> int:
    """A size for launches over ``count`` items and some padding, rarely different from the present one.

    A new size is too large by at most a sixteenth or one granule.

    Args:
        count: Number of items.
        present: The present size, or 0.
        granule: A power of two; the size is a multiple of it.
        limit: Number of places; a multiple of the granule if that matters.

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
