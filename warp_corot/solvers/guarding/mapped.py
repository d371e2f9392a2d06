"""Numbers that the host and the device share: host memory that kernels read and write."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import warp as wp


class Mapped:
    """float64 numbers in memory that host and device share.

    The host sees what a kernel wrote once the stream has finished it. Few threads should use this memory.

    Args:
        count: Number of values.
        device: The device.

    Attributes:
        values: For the host, float64 [count].
        array: For kernels, float64 [count].
    """

    def __init__(self, count: int, device: wp.Device):
        self._memory = wp.zeros(count, dtype=wp.float64, device="cpu", pinned=device.is_cuda)
        self.values: npt.NDArray[np.float64] = self._memory.numpy()
        self.array = self._memory
        if device.is_cuda:
            # The same memory: pinned memory has one address on host and device.
            self.array = wp.array(ptr=self._memory.ptr, shape=count, dtype=wp.float64, device=device)
