"""Whole numbers in ascending order, with their places: several times as fast as NumPy's sorting of places."""

from __future__ import annotations

import numpy as np
import warp as wp

#: Fewer numbers are left to NumPy.
FEW = 20_000


def sorted_keys(keys: np.ndarray, limit: int) -> tuple[np.ndarray, np.ndarray]:
    """Keys from 0 to below a limit in ascending order, and their places before; equal keys keep their order.

    Args:
        keys: int64 [n].
        limit: A number above all keys, at most 2**63.
    """
    count = len(keys)
    bits = max(count - 1, 1).bit_length()
    if (limit - 1).bit_length() + bits <= 63:
        # Numbers that hold key and place sort faster than places do by their keys.
        both = np.sort(keys << bits | np.arange(count))
        return both >> bits, both & ((1 << bits) - 1)
    if count < FEW:
        order = np.argsort(keys, kind="stable")
        return keys[order], order
    cpu = wp.get_device("cpu")
    # The sort needs as much room again.
    ordered, places = (wp.empty(2 * count, dtype=kind, device=cpu) for kind in (wp.int64, wp.int32))
    ordered.numpy()[:count], places.numpy()[:count] = keys, np.arange(count, dtype=np.int32)
    wp.utils.radix_sort_pairs(ordered, places, count)
    return ordered.numpy()[:count], places.numpy()[:count]
