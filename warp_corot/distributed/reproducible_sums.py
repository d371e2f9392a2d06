"""Sums that are the same bit for bit in any order, and so for any number of ranks.

Each addend is split into whole numbers of smaller and smaller units, powers of two below the largest addend of all
ranks. Sums of whole numbers are exact.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]

#: Bits of the whole numbers into which addends are split, so that sums of 2**32 of them fit into int64; and the number
#: of splits.
BITS, ROUNDS = 30, 3


def reproducible_sums(addends: Floats, comm: Any) -> Floats:
    """The sums of all ranks' addends, [n, columns] -> [columns]; NaN where any addend is not finite."""
    columns = addends.shape[1]
    sizes = np.abs(addends).max(axis=0, initial=0.0)
    bad = ~np.isfinite(sizes)
    most = np.where(bad, 0.0, sizes)
    everywhere = np.array(comm.allgather(np.stack([most, bad])))
    most, bad = everywhere[:, 0].max(axis=0), everywhere[:, 1].max(axis=0) > 0
    left = np.where(bad, 0.0, addends)
    unit = np.ldexp(1.0, np.frexp(most)[1])
    total = np.zeros(columns)
    parts = np.zeros((ROUNDS, columns), np.int64)
    units = np.zeros((ROUNDS, columns))
    for number in range(ROUNDS):
        unit = np.ldexp(unit, -BITS)
        units[number] = unit
        known = unit > 0.0
        whole = np.where(known, np.rint(left / np.where(known, unit, 1.0)), 0.0)
        left = left - whole * unit
        parts[number] = whole.astype(np.int64).sum(axis=0)
    together = np.array(comm.allgather(parts)).sum(axis=0)
    # Add the smallest units first.
    for number in reversed(range(ROUNDS)):
        total += together[number] * units[number]
    return np.where(bad, np.nan, total)
