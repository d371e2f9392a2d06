"""All subtrees and other leaves of a body in one launch on CUDA; see ``kernels.subtree_cuda.scatter_stretches``."""

from __future__ import annotations

from typing import Any

import warp as wp

from ..kernels.repair import repair_listed_own
from ..kernels.subtree_cuda import BLOCK, FLAT, Stretch, scatter_stretches
from ..plan import Plan
from ..subtrees import Sharing


class Stretches:
    """The launch of a plan whose leaves all have their own rotations."""

    def __init__(self, plan: Plan, uniform: bool, device: wp.Device):
        rows, begin = [], 0
        for batch in plan.batches:
            stretch = Stretch()
            stretch.begin, stretch.count = begin, batch.count
            stretch.shape, stretch.grouped = batch.shape, int(batch.grouped)
            stretch.subtrees, stretch.flagged = batch.subtrees, batch.flagged
            rows.append(stretch)
            begin += -(-batch.count // BLOCK)
        if len(plan.flat):
            stretch = Stretch()
            stretch.begin, stretch.count, stretch.shape = begin, len(plan.flat), FLAT
            rows.append(stretch)
            begin += -(-len(plan.flat) // BLOCK)
        # The structs hold addresses alone: what they stand for must live as long as they do.
        self._rows = rows
        self._stretches = wp.array(rows, dtype=Stretch, device=device)
        self._flat = plan.flat
        self._blocks = begin
        self._kernel = scatter_stretches(uniform)
        self._device = device

    @staticmethod
    def suit(plan: Plan) -> bool:
        """Whether a plan is for one launch: all rotations are own ones, and there is more than one batch."""
        own = all(batch.sharing is Sharing.OWN for batch in plan.batches) and plan.units is None
        return own and len(plan.batches) + (len(plan.flat) > 0) > 1

    @staticmethod
    def load(uniform: bool, device: wp.Device) -> None:
        """Compile now what launches will need."""
        wp.load_module(scatter_stretches(uniform).module, device, block_dim=BLOCK)
        wp.load_module(repair_listed_own.module, device, block_dim=128)

    def scatter_forces(self, mu: wp.array, lam: wp.array, u: wp.array, f: wp.array, left_out: Any) -> None:
        """Add the forces of displacements u to f, both vec4, and put what is left out on a list."""
        wp.launch(
            self._kernel,
            dim=self._blocks * BLOCK,
            inputs=[self._stretches, self._flat.elements, self._flat.leaves, mu, lam, u],
            outputs=[f, left_out],
            device=self._device,
            block_dim=BLOCK,
        )
