"""Forces of all elements one by one under a law; on the CPU a thread takes eight of them where the law is in C++."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import warp as wp

from warp_corot.kernels.elements.forces import repair_forces, scatter_forces
from warp_corot.kernels.elements.general_cpu import scatter_elements
from warp_corot.kernels.elements.lanes import LANES
from warp_corot.kernels.elements.law_lanes import NativeLaw

if TYPE_CHECKING:
    from warp_corot.discretization.discretization import Discretization


class ByElements:
    """Launches that add the forces of a law.

    Args:
        discretization: The mesh.
        Material: The struct that the law reads.
        stress: The law, as ``kernels.elements.forces`` takes it.
        lanes: The same law in C++, if it is there.
    """

    def __init__(
        self, discretization: Discretization, Material: type, stress: wp.Function, lanes: NativeLaw | None = None
    ):
        kind, self._device = discretization.element_kind, discretization.device
        self._lanes = lanes if self._device.is_cpu else None
        if self._lanes is None:
            self.kernel = scatter_forces(kind, Material, stress)
            return
        self.kernel = scatter_elements(kind, Material, self._lanes)
        self._repair = repair_forces(kind, Material, stress)
        #: How many are left out, then which.
        self._left_out = wp.zeros(1, dtype=wp.int32, device=self._device)

    def __call__(self, elements: Any, count: int, material: Any, u: wp.array, f: wp.array) -> None:
        """Add the forces [N] of the first ``count`` elements to f; ``material`` is the struct that the law reads."""
        if self._lanes is None:
            wp.launch(self.kernel, count, [elements, material, u], [f], device=self._device)
            return
        if self._lanes.leaves_out and len(self._left_out) <= count:
            self._left_out = wp.zeros(count + 1, dtype=wp.int32, device=self._device)
        inputs = [elements, count, material, u]
        wp.launch(self.kernel, -(-count // LANES), inputs, [f, self._left_out], device=self._device)
        if self._lanes.leaves_out:
            wp.launch(self._repair, 1, [elements, material, u], [self._left_out, f], device=self._device)
