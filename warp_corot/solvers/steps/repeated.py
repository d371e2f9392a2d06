"""Launches that are recorded once and replayed, so that Python does not make them one by one."""

from __future__ import annotations

from collections.abc import Callable, Hashable

import warp as wp

from warp_corot.inputs.simulation_lock import SIMULATION_LOCK
from warp_corot.solvers.halo import Halo

#: The most recordings that are kept.
MOST = 8


class Replays:
    """Recordings of the same launches, by what may change in them.

    While a user records, launches are made as they are. The first time, too: loading kernels within a recording would
    end it on some drivers.

    Args:
        device: The device.
        loops: Whether launches have conditions, which not all drivers record.
    """

    def __init__(self, device: wp.Device, *, loops: bool = False):
        self._device = device
        self._records = device.is_cpu or not loops or wp.is_conditional_graph_supported()
        self._graphs: dict[Hashable, wp.Graph | None] = {}

    def launch(self, key: Hashable, launches: Callable[[], None]) -> None:
        """Make launches that use the same arrays and values whenever the key is the same."""
        if self._device.is_capturing or not self._records:
            launches()
            return
        if key not in self._graphs:
            if len(self._graphs) == MOST:
                self._graphs.clear()
            self._graphs[key] = None
            launches()
            return
        if self._graphs[key] is None:
            with SIMULATION_LOCK, wp.ScopedCapture(device=self._device) as capture:
                launches()
            self._graphs[key] = capture.graph
        wp.capture_launch(self._graphs[key])

    def forget(self) -> None:
        """Forget all recordings, because arrays have changed."""
        self._graphs.clear()


def repeat(launch: Callable[[], None], times: int, device: wp.Device, ranks: Halo) -> None:
    """Launch the same work so many times, with the same arguments each time.

    On the CPU Python takes longer to launch a small body's work than the work takes: the first launch compiles, and the
    others are replays of a recording. CUDA works while Python launches. Exchanges between ranks are not recorded.
    """
    replays = Replays(device)
    as_it_is = times < 3 or device.is_cuda or not ranks.is_alone
    for _ in range(times):
        if as_it_is:
            launch()
        else:
            replays.launch(None, launch)
