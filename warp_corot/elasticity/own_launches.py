"""All that a body's forces go through on CUDA in one or two launches; see ``kernels.subtree_cuda`` and ``clusters``."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from ..clusters import clusters_of
from ..kernels.algebraic import corotated_stress
from ..kernels.clusters import CLUSTER, scatter_clusters
from ..kernels.elements import ForestElements
from ..kernels.subtree_cuda import BLOCK, FLAT, Stretch, scatter_stretches
from ..plan import FlatLeaves, ForcePlan, Plan
from ..subtrees import GROUPED_LEAVES, Batch


class OwnLaunches:
    """The launches of a plan whose leaves all have their own rotations.

    Where the mesh stays as it is, leaves in no subtree, and those of subtrees in no group beside them, go in clusters;
    where few are in groups, all leaves. Where the mesh changes, one launch is all.

    Args:
        elements: The leaves of all worlds, ``kernels.elements.ForestElements``.
        material: mu, lambda and their stride.
        tolerance: How near a subtree root's rotation must be to be used in place of own ones [rad]; None: never.
    """

    def __init__(self, plan: Plan, elements: Any, material: list, tolerance: float | None = None):
        self._device = elements.nodes.device
        self._elements, self._material, self._tolerance = elements, material, tolerance
        batches, self._flat = list(plan.batches), plan.flat
        self._clusters: Any = None
        if isinstance(plan, ForcePlan) and len(plan.flat):
            worth = 8 * sum(batch.count for batch in batches if batch.grouped) >= GROUPED_LEAVES
            single = [batch for batch in batches if not (batch.grouped and worth)]
            batches = [batch for batch in batches if batch.grouped and worth]
            first = np.concatenate([np.empty(0, np.int32), *(batch.subtrees.first.numpy() for batch in single)])
            leaves = np.concatenate([plan.flat.leaves.numpy(), (first[:, None] + np.arange(8)).ravel()])
            self._clusters, self._cluster_count = clusters_of(
                np.sort(leaves).astype(np.int32), elements.nodes.numpy(), self._device
            )
        #: How many subtrees and single leaves can be on the list of those left out.
        self.places = sum(batch.count for batch in batches)
        if self._clusters is None:
            self.places += len(plan.flat)
        # The structs hold addresses alone: what these stand for must live as long as they do.
        self._rows, self._blocks = _stretches(batches, None if self._clusters is not None else plan.flat)
        self._stretches = wp.array(self._rows, dtype=Stretch, device=self._device) if self._rows else None

    @staticmethod
    def suit(plan: Plan) -> bool:
        """Whether a plan of own rotations has more than one batch, or may come to have."""
        return not isinstance(plan, ForcePlan) or len(plan.batches) > 1 or len(plan.flat) > 0

    @staticmethod
    def load(uniform: bool, tolerance: float | None, device: wp.Device) -> None:
        """Compile now what launches over a mesh that changes will need."""
        wp.load_module(scatter_stretches(uniform, tolerance).module, device, block_dim=BLOCK)

    def scatter_forces(self, u: wp.array, f: wp.array, left_out: Any) -> None:
        """Add the forces of displacements u to f, both vec4, and put subtrees with leaves left out on a list."""
        mu, lam, stride = self._material
        if self._stretches is not None:
            wp.launch(
                scatter_stretches(stride == 0, self._tolerance),
                dim=self._blocks * BLOCK,
                inputs=[self._stretches, self._flat.elements, self._flat.leaves, mu, lam, u],
                outputs=[f, left_out],
                device=self._device,
                block_dim=BLOCK,
            )
        if self._clusters is not None:
            wp.launch(
                scatter_clusters(ForestElements, corotated_stress),
                dim=self._cluster_count * CLUSTER,
                inputs=[self._clusters, self._elements, mu, lam, stride, u],
                outputs=[f],
                device=self._device,
                block_dim=CLUSTER,
            )


def _stretches(batches: list[Batch], flat: FlatLeaves | None) -> tuple[list[Any], int]:
    """What neighbouring thread blocks go through, and how many blocks there are."""
    rows, begin = [], 0
    for batch in batches:
        stretch = Stretch()
        stretch.begin, stretch.count = begin, batch.count
        stretch.shape, stretch.grouped = batch.shape, int(batch.grouped)
        stretch.subtrees, stretch.flagged = batch.subtrees, batch.flagged
        rows.append(stretch)
        begin += -(-batch.count // BLOCK)
    if flat is not None and len(flat):
        stretch = Stretch()
        stretch.begin, stretch.count, stretch.shape = begin, len(flat), FLAT
        rows.append(stretch)
        begin += -(-len(flat) // BLOCK)
    return rows, begin
