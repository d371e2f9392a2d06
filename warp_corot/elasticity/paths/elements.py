"""Kernels of all elements one by one: on the CPU a thread takes eight of them where there is a kernel that does."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import warp as wp

from warp_corot.kernels.elements.lanes import LANES

if TYPE_CHECKING:
    from warp_corot.discretization.discretization import Discretization

#: Makes a kernel for a kind of elements.
Factory = Callable[[type], wp.Kernel]


class ByElements:
    """Launches a kernel of all elements.

    Args:
        discretization: The mesh.
        each: Makes the kernel of one element in a thread, (elements, …).
        eights: Makes that of eight elements in a thread for the CPU, (elements, their number, …); None if there is
            none.
    """

    def __init__(self, discretization: Discretization, each: Factory, eights: Factory | None = None):
        self._device = discretization.device
        self._in_eights = eights is not None and self._device.is_cpu
        made = eights if eights is not None and self._in_eights else each
        self.kernel = made(discretization.element_kind)

    def __call__(self, elements: Any, count: int, inputs: list, outputs: list) -> None:
        """Launch it for the first ``count`` elements."""
        dim = -(-count // LANES) if self._in_eights else count
        own = [elements, count] if self._in_eights else [elements]
        wp.launch(self.kernel, dim, [*own, *inputs], outputs, device=self._device)
