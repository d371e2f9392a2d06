"""Random numbers that depend only on a node's number in the whole body."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt


def normal_numbers(numbers: npt.NDArray[np.int64], seed: int) -> npt.NDArray[np.float64]:
    """Three normally distributed numbers for each node, float64 [n, 3].

    They come from SplitMix64 (Steele, Lea and Flood 2014) and Box and Muller's transform.

    Args:
        numbers: Numbers of the nodes, int64 [n].
        seed: The seed of the numbers.
    """
    found = np.empty((len(numbers), 3))
    for axis in range(3):
        first, second = (_uniform(numbers, np.uint64(seed * 6 + 2 * axis + half)) for half in range(2))
        found[:, axis] = np.sqrt(-2.0 * np.log(first)) * np.cos(2.0 * np.pi * second)
    return found


def _uniform(numbers: npt.NDArray[np.int64], stream: np.uint64) -> npt.NDArray[np.float64]:
    """Uniformly distributed numbers, above 0 and up to 1."""
    with np.errstate(over="ignore"):
        state = numbers.astype(np.uint64) * np.uint64(64) + stream
        state = (state + np.uint64(1)) * np.uint64(0x9E3779B97F4A7C15)
        state = (state ^ state >> np.uint64(30)) * np.uint64(0xBF58476D1CE4E5B9)
        state = (state ^ state >> np.uint64(27)) * np.uint64(0x94D049BB133111EB)
        state ^= state >> np.uint64(31)
    return ((state >> np.uint64(11)).astype(np.float64) + 1.0) * 2.0**-53
