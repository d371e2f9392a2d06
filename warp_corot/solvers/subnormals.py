"""Launches between which the CPU treats subnormal numbers as zero; see ``kernels.stepping.subnormals``."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import warp as wp

from warp_corot.kernels.stepping.subnormals import flush_subnormals, restore_subnormals


class FlushedSubnormals:
    """Sets the mode of the thread during launches, and restores it afterwards. It does nothing on CUDA.

    Each place that launches has its own, so that nested ones restore what they found.
    """

    def __init__(self, device: wp.Device):
        self._device = device
        if device.is_cpu:
            self._mode = wp.zeros(1, dtype=wp.uint32, device=device)
            # A recorded launch costs a quarter of a launch through Python's checks.
            self._begin, self._end = (
                wp.launch(kernel, dim=1, inputs=[self._mode], device=device, record_cmd=True)
                for kernel in (flush_subnormals, restore_subnormals)
            )

    @contextmanager
    def __call__(self) -> Iterator[None]:
        """Set the mode for the launches inside, also if they are recorded; it is restored even if they fail."""
        if not self._device.is_cpu:
            yield
            return
        self._begin.launch()
        try:
            yield
        finally:
            self._end.launch()
