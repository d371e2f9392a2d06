"""Random numbers that depend only on a node's number in the whole body."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from warp_corot.mesh.scattered import uniform_numbers


def normal_numbers(numbers: npt.NDArray[np.int64], seed: int) -> npt.NDArray[np.float64]:
    """Three normally distributed numbers for each node, float64 [n, 3].

    They come from ``uniform_numbers`` by Box and Muller's transform.

    Args:
        numbers: Numbers of the nodes, int64 [n].
        seed: The seed of the numbers.
    """
    found = np.empty((len(numbers), 3))
    for axis in range(3):
        first, second = (uniform_numbers(numbers, seed * 6 + 2 * axis + half) for half in range(2))
        found[:, axis] = np.sqrt(-2.0 * np.log(first)) * np.cos(2.0 * np.pi * second)
    return found
