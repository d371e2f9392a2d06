"""Forces of all elements under a law: one by one, or eight at a time on the CPU if the law is in C++."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import warp as wp

from warp_corot.discretization.plan import Plan
from warp_corot.inputs.loading import LoadedKernel
from warp_corot.kernels.elements.forces import repair_forces, scatter_forces
from warp_corot.kernels.elements.general_cpu import scatter_listed_elements
from warp_corot.kernels.elements.native_laws import NativeLaw
from warp_corot.kernels.elements.simd8 import LANES
from warp_corot.kernels.subtrees.cpu import scatter_subtrees

if TYPE_CHECKING:
    from warp_corot.discretization.discretization import Discretization


class ByElements:
    """Launches that add the forces of a law.

    In C++ a thread takes eight complete subtrees of a mesh that never changes, and eight of all other elements.

    Args:
        discretization: The mesh.
        plan: The units of work.
        Material: The struct that the law reads.
        stress: The law, as ``kernels.elements.forces`` takes it.
        lanes: The same law in C++, if it is there.
        slotted: Whether each element's forces go to slots of their own first, so that sums are reproducible.
    """

    def __init__(
        self,
        discretization: Discretization,
        plan: Plan,
        Material: type,
        stress: wp.Function,
        lanes: NativeLaw | None = None,
        *,
        slotted: bool = False,
    ):
        kind, self._device = discretization.element_kind, discretization.device
        own = discretization.plan(subtrees=False, deterministic=True) if slotted else plan
        self._elements, self._slots = own.elements, own.slots if slotted else None
        self._lanes = lanes if self._device.is_cpu else None
        self.kernels: list[LoadedKernel]
        if self._lanes is None:
            self.kernels = [scatter_forces(kind, Material, stress)]
            return
        self._batches = tuple(plan.batches) if plan.counts is None else ()
        subtrees = [scatter_subtrees(batch.shape, Material, self._lanes, wp.int32) for batch in self._batches]
        #: The elements outside subtrees, if any are in subtrees.
        self._listed = plan.flat.leaves if self._batches else wp.empty(0, dtype=wp.int32, device=self._device)
        self.kernels = [*subtrees, scatter_listed_elements(kind, Material, self._lanes)]
        self.kernels += [repair_forces(kind, Material, stress)] if self._lanes.leaves_out else []
        #: How many are left out, then which.
        self._degenerate = wp.zeros(1, dtype=wp.int32, device=self._device)

    def __call__(self, count: int, material: Any, u: wp.array, f: wp.array) -> None:
        """Add the forces [N] of the first ``count`` elements to f; ``material`` is the struct that the law reads."""
        if self._slots is None:
            self._scatter(count, material, u, f)
            return
        self._slots.values.zero_()
        self._scatter(count, material, u, self._slots.values)
        self._slots.gather(f)

    def _scatter(self, count: int, material: Any, u: wp.array, f: wp.array) -> None:
        kernels: list[Any] = list(self.kernels)
        if self._lanes is None:
            wp.launch(kernels[0], count, [self._elements, material, u], [f], device=self._device)
            return
        if self._lanes.leaves_out and len(self._degenerate) <= count:
            self._degenerate = wp.zeros(count + 1, dtype=wp.int32, device=self._device)
        outputs = [f, self._degenerate]
        for batch in self._batches:
            inputs = [batch.subtrees, batch.count, material, u]
            wp.launch(kernels.pop(0), -(-batch.count // LANES), inputs, outputs, device=self._device)
        single = len(self._listed) if self._batches else count
        eights = kernels.pop(0)
        if single:
            inputs = [self._elements, single, self._listed, material, u]
            wp.launch(eights, -(-single // LANES), inputs, outputs, device=self._device)
        for repair in kernels:
            wp.launch(repair, 1, [self._elements, material, u], [self._degenerate, f], device=self._device)
