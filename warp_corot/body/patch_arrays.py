"""Cached device arrays of patches that a user holds, moves or loads repeatedly, so that each is copied once."""

from __future__ import annotations

from collections import deque

import numpy as np
import numpy.typing as npt
import warp as wp

#: Number of cached patches: those of two hands and their former ones.
KEPT = 4


class PatchArrays:
    """Indices of the last few patches on a device.

    Args:
        device: The device.

    Attributes:
        still: One vector of zeros, vec3 [1].
    """

    def __init__(self, device: wp.Device):
        self._device = device
        self._kept: deque[tuple[npt.NDArray[np.integer], wp.array]] = deque(maxlen=KEPT)
        self._vectors: dict[int, wp.array] = {}
        self.still = wp.zeros(1, dtype=wp.vec3, device=device)

    def nodes(self, indices: npt.NDArray[np.integer]) -> wp.array:
        """Node indices [k] as int32 [k] on the device. The array is shared: do not write to it."""
        for known, there in self._kept:
            if len(known) == len(indices) and np.array_equal(known, indices):
                return there
        there = wp.array(indices, dtype=wp.int32, device=self._device)
        self._kept.append((indices.copy(), there))
        return there

    def vectors(self, values: npt.NDArray[np.float64]) -> wp.array:
        """Vectors [k, 3] as vec3 [k] on the device, for launches that come before the next call."""
        count = len(values)
        if count not in self._vectors:
            if len(self._vectors) == KEPT:
                self._vectors.clear()
            self._vectors[count] = wp.empty(count, dtype=wp.vec3, device=self._device)
        there = self._vectors[count]
        there.assign(values.astype(np.float32))
        return there
