"""Lists of the leaves that subtree kernels left out, on CUDA, and the launches that do them; see ``kernels.repair``."""

from __future__ import annotations

from typing import Any, ClassVar

import warp as wp

from ..kernels.repair import LIST_BLOCK, LeftOut, repair_listed_own, repair_listed_shared
from ..plan import Plan
from ..subtrees import Batch, Sharing

#: Thread blocks a multiprocessor: enough to hide latency, few enough that a launch over an empty list ends at once.
BLOCKS = 4


class LeftOutLeaves:
    """One list for all leaves with own rotations, and one for each batch that shares its roots' rotations.

    Args:
        own_places: How many subtrees and single leaves with own rotations there can be on the list.
        shared: The batches that share their roots' rotations.
    """

    #: What a kernel gets that makes no list.
    NONE: ClassVar[Any] = LeftOut()

    def __init__(self, own_places: int, shared: list[Batch], device: wp.Device):
        self.own = _empty_list(own_places, device)
        self._has_own = own_places > 0
        self._shared = [(batch, _empty_list(batch.count, device)) for batch in shared]
        self._threads = LIST_BLOCK * BLOCKS * max(device.sm_count, 1) if device.is_cuda else LIST_BLOCK
        self._device = device

    @classmethod
    def of(cls, plan: Plan, device: wp.Device) -> LeftOutLeaves:
        own = [batch for batch in plan.batches if batch.sharing is Sharing.OWN]
        places = sum(batch.count for batch in own) + len(plan.flat)
        return cls(places, [batch for batch in plan.batches if batch.sharing is Sharing.ROOT], device)

    @staticmethod
    def load(device: wp.Device) -> None:
        """Compile now what launches will need."""
        wp.load_module(repair_listed_own.module, device, block_dim=LIST_BLOCK)

    def list_of(self, batch: Batch) -> Any:
        """The list that a batch's kernel appends to."""
        if batch.sharing is Sharing.OWN:
            return self.own
        return next((listed for other, listed in self._shared if other is batch), self.NONE)

    def repair(self, elements: Any, material: list, u: wp.array, f: wp.array) -> None:
        """Add the forces of the leaves on the lists to f, and empty them."""
        inputs = [elements, *material, u]
        if self._has_own:
            self._launch(repair_listed_own, [*inputs, self.own], f)
        for batch, listed in self._shared:
            self._launch(repair_listed_shared, [batch.subtrees.first, batch.roots, *inputs, listed], f)

    def _launch(self, kernel: wp.Kernel, inputs: list, f: wp.array) -> None:
        wp.launch(
            kernel,
            dim=self._threads if self._device.is_cuda else 1,
            inputs=[self._threads if self._device.is_cuda else 1, *inputs],
            outputs=[f],
            device=self._device,
            block_dim=LIST_BLOCK,
        )


def _empty_list(places: int, device: wp.Device) -> Any:
    listed = LeftOut()
    listed.counts = wp.zeros(2, dtype=wp.int32, device=device)
    listed.entries = wp.zeros(places, dtype=wp.vec2i, device=device)
    return listed
