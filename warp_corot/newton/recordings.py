"""A warning if steps in a graph end in another state than that from which a replay begins."""

from __future__ import annotations

import warnings

import numpy as np
import warp as wp

from warp_corot.errors import depth_of_user

from .library import newton


class Recordings:
    """The states between which recordings lead.

    A graph keeps the addresses of the states. If a frame swaps two states an odd number of times, its replay reads the
    same old state again and again, unless the result is copied back.

    Args:
        device: The model's device.
    """

    def __init__(self, device: wp.Device):
        self._device = device
        self._ways: list[tuple[wp.array, wp.array]] = []
        self._recording = self._told = False

    def follow(self, state_in: newton.State, state_out: newton.State) -> None:
        """Follow a step, if it is recorded; the steps of a recording come one after the other."""
        goes_on, self._recording = self._recording, self._device.is_capturing
        if self._recording and not self._told:
            begin = self._ways.pop()[0] if goes_on else state_in.particle_q
            self._ways = [way for way in self._ways if way[0] is not begin] + [(begin, state_out.particle_q)]

    def check(self) -> None:
        """Warn, once, of a recording whose result no recording reads; waits for the device."""
        begins = {begin.ptr for begin, _ in self._ways}
        lost = (way for way in self._ways if way[1].ptr not in begins)
        if self._told or self._device.is_capturing or all(np.array_equal(a.numpy(), b.numpy()) for a, b in lost):
            return
        self._told = True
        warnings.warn(
            "recorded steps end in another state than that from which they begin, and nothing copies it back: each "
            "replay begins where the first one did; record an even number of swaps, or end the recording with "
            "state_in.assign(state_out)",
            UserWarning,
            stacklevel=depth_of_user(),
        )
