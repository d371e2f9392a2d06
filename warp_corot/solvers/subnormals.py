"""Launches between which the CPU takes subnormal numbers for zero; see ``kernels.stepping.subnormals``."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import warp as wp

from warp_corot.kernels.stepping.subnormals import flush_subnormals, restore_subnormals


class FlushedSubnormals:
    """Keeps the mode of the thread for the length of some launches. Nothing on CUDA.

    One for each place that launches: where two are nested, each puts back what it found.
    """

    def __init__(self, device: wp.Device):
        self._device = device
        if device.is_cpu:
            self._mode = wp.zeros(1, dtype=wp.uint32, device=device)
            # Recorded, a launch costs a quarter of what it costs through Python's checks.
            self._begin, self._end = (
                wp.launch(kernel, dim=1, inputs=[self._mode], device=device, record_cmd=True)
                for kernel in (flush_subnormals, restore_subnormals)
            )

    @contextmanager
    def __call__(self) -> Iterator[None]:
        """For the launches inside, also when they are recorded; the mode is back however they end."""
        if not self._device.is_cpu:
            yield
            return
        self._begin.launch()
        try:
            yield
        finally:
            self._end.launch()
