"""Leaves that subtree kernels left out, in lists on CUDA, and their launches; see ``kernels.subtrees.repair``."""

from __future__ import annotations

from typing import ClassVar

import warp as wp

from warp_corot.discretization.elements import Elements
from warp_corot.discretization.plan import Plan
from warp_corot.discretization.subtrees import Batch, Sharing
from warp_corot.kernels.elements.constitutive import IsotropicMaterial
from warp_corot.kernels.subtrees.degenerate import COUNT_STRIDE, LIST_BLOCK, LISTS, DegenerateList
from warp_corot.kernels.subtrees.memory import BLOCK
from warp_corot.kernels.subtrees.repair import repair_listed_own, repair_listed_shared

#: Thread blocks for each multiprocessor: as many as fit at the same time, so that a launch over an empty list ends
#: soon.
BLOCKS = 6


class DegenerateLeaves:
    """Lists of all leaves with own rotations, and of each batch that shares its roots' rotations.

    Args:
        own: The numbers of subtrees and single leaves of each launch that finds own rotations.
        shared: The batches that share their roots' rotations.
    """

    #: The argument of kernels that write no list.
    NONE: ClassVar[DegenerateList] = DegenerateList()

    def __init__(self, own: list[int], shared: list[Batch], device: wp.Device):
        self.own = _empty_lists(own, device)
        self._has_own = sum(own) > 0
        self._shared = [(batch, _empty_lists([batch.count], device)) for batch in shared]
        self._threads = LIST_BLOCK * BLOCKS * max(device.sm_count, 1) if device.is_cuda else LIST_BLOCK
        self._device = device

    @classmethod
    def of(cls, plan: Plan, device: wp.Device) -> DegenerateLeaves:
        """The lists of a plan."""
        own = [batch.count for batch in plan.batches if batch.sharing is Sharing.OWN]
        return cls([*own, len(plan.flat)], [batch for batch in plan.batches if batch.sharing is Sharing.ROOT], device)

    #: The kernel for leaves with own rotations.
    kernel = (repair_listed_own, LIST_BLOCK)

    def list_of(self, batch: Batch) -> DegenerateList:
        """The list that a batch's kernel appends to."""
        if batch.sharing is Sharing.OWN:
            return self.own
        return next((listed for other, listed in self._shared if other is batch), self.NONE)

    def repair(self, elements: Elements, material: IsotropicMaterial, u: wp.array, f: wp.array) -> None:
        """Add the forces of the leaves on the lists to f, and empty them."""
        inputs = [elements, material, u]
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


def _empty_lists(launches: list[int], device: wp.Device) -> DegenerateList:
    """Empty lists with room for all subtrees of these launches, whose thread blocks take the lists in turn."""
    listed = DegenerateList()
    listed.counts = wp.zeros((LISTS + 1) * COUNT_STRIDE, dtype=wp.int32, device=device)
    listed.room = BLOCK * sum(-(-count // (BLOCK * LISTS)) for count in launches)
    listed.entries = wp.zeros(LISTS * listed.room, dtype=wp.vec2i, device=device)
    return listed
