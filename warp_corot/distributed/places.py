"""Copies of entries between the arrays of a whole body and those of its part, which may be on another device."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.kernels.distributed import exchange as kernels

Ints = npt.NDArray[np.int32]


class Places:
    """The places of some values in arrays of the whole body, and in those of its part.

    Args:
        whole, part: The places, int32 [n] both.
        whole_device, part_device: The devices of the arrays.
        direct: Whether values go from one array to the other in one launch; None: if both are on one device.
    """

    def __init__(
        self, whole: Ints, part: Ints, whole_device: wp.Device, part_device: wp.Device, *, direct: bool | None = None
    ):
        self.whole, self.part = whole, part
        self._direct = whole_device == part_device if direct is None else direct
        self._in_whole = wp.array(whole, dtype=wp.int32, device=whole_device)
        self._in_part = wp.array(part, dtype=wp.int32, device=part_device)

    def to_part(self, whole: wp.array, part: wp.array) -> None:
        """Copy the values of an array of the whole body to one of the part."""
        self._copy(whole, self._in_whole, self.whole, part, self._in_part)

    def to_whole(self, part: wp.array, whole: wp.array) -> None:
        """Copy the values of an array of the part to one of the whole body."""
        self._copy(part, self._in_part, self.part, whole, self._in_whole)

    def _copy(self, source: wp.array, sources: wp.array, numbers: Ints, found: wp.array, targets: wp.array) -> None:
        if self._direct:
            inputs = [sources, targets, source]
            wp.launch(kernels.move_values, len(numbers), inputs, [found], device=found.device)
            return
        values = wp.array(source.numpy()[numbers], dtype=source.dtype, device=found.device)
        wp.launch(kernels.scatter_values, len(numbers), [targets, values], [found], device=found.device)
