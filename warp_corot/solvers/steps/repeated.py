"""The same launches many times in a row, while a simulation is being made."""

from __future__ import annotations

from collections.abc import Callable

import warp as wp

from warp_corot.inputs.simulation_lock import SIMULATION_LOCK
from warp_corot.solvers.halo import Halo


def repeat(launch: Callable[[], None], times: int, device: wp.Device, ranks: Halo) -> None:
    """Launch the same work so many times, with the same arguments each time.

    On the CPU Python takes longer to launch a small body's work than the work takes: the first launch compiles, and the
    others are replays of a recording. CUDA works while Python launches. Exchanges between ranks are not recorded.
    """
    if times < 3 or device.is_cuda or device.is_capturing or not ranks.is_alone:
        for _ in range(times):
            launch()
        return
    launch()
    with SIMULATION_LOCK:
        with wp.ScopedCapture(device=device) as capture:
            launch()
        for _ in range(times - 1):
            wp.capture_launch(capture.graph)
