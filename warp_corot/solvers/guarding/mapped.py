"""Numbers that the host and the device share: memory of the host that kernels read and write."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import warp as wp


class Mapped:
    """Some float64 in one place for host and device.

    What a kernel has written is there for the host once the stream has come so far; few threads should use it.

    Args:
        count: How many.
        device: Which device.

    Attributes:
        values: For the host, float64 [count].
        array: For kernels, float64 [count].
    """

    def __init__(self, count: int, device: wp.Device):
        self._memory = wp.zeros(count, dtype=wp.float64, device="cpu", pinned=device.is_cuda)
        self.values: npt.NDArray[np.float64] = self._memory.numpy()
        self.array = self._memory
        if device.is_cuda:
            # The same memory: what is pinned has one address everywhere.
            self.array = wp.array(ptr=self._memory.ptr, shape=count, dtype=wp.float64, device=device)
