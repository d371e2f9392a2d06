"""The stiffness R K R^T over complete subtrees, for large uniform bodies on CUDA."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, cast

import numpy as np
import warp as wp

from warp_corot.discretization.subtrees import Batch, Sharing
from warp_corot.elasticity.tangent import Tangent
from warp_corot.kernels.corotated import turned_subtrees as kernels
from warp_corot.kernels.elements.elements import ForestElements, Subtrees
from warp_corot.kernels.subtrees.memory import BLOCK

from .tangents import RotatedTangent

if TYPE_CHECKING:
    from warp_corot.discretization.plan import Plan

    from .elements import CorotatedField

#: The number of elements from which on products go over subtrees. On an H200, a product of 1,179,648 elements takes
#: 22 us in place of 73; smaller bodies were not measured.
FEWEST = 1 << 16


class SubtreeTangent(Tangent):
    """R K R^T of a mesh all of whose leaves are in subtrees, with a quaternion for each leaf.

    The diagonal is found with a rotation for each element, because solvers with multigrid never need it.

    Args:
        field: The field; each element has its own rotation.
        batches: The subtrees, from ``subtrees_of``.
    """

    field: CorotatedField

    def __init__(self, field: CorotatedField, batches: Sequence[Batch]):
        super().__init__(field)
        self._rotated, self._batches = RotatedTangent(field), tuple(batches)
        self._places = [self._with_own_targets(batch) for batch in batches]
        self._turns = [wp.zeros(8 * batch.count, dtype=wp.vec4, device=field.device) for batch in batches]
        self._keep = kernels.keep_turns(kernels.turned_by(field.model.own_rotation))
        uniform = field.isotropic.stride == 0
        self._products = [kernels.add_subtree_products(b.shape, b.grouped, uniform, False) for b in batches]
        self._block = BLOCK if field.device.is_cuda else 256
        for kernel in self._products:
            wp.load_module(kernel.module, field.device, block_dim=self._block)
        self._no_rows = wp.zeros(1, dtype=wp.vec4, device=field.device)

    def prepare(self, u: wp.array) -> None:
        super().prepare(u)
        self._rotated.prepare(u)

    def take(self, u: wp.array) -> None:
        super().take(u)
        elements = cast("ForestElements", self.field.elements)
        for batch, turns in zip(self._batches, self._turns, strict=True):
            inputs = [batch.count, batch.subtrees.first, elements, u]
            wp.launch(self._keep, (8, batch.count), inputs, [turns], device=self.field.device)

    def add_product(self, p: wp.array, y: wp.array) -> None:
        isotropic = self.field.isotropic
        material = kernels.LeafMaterial()
        material.mu, material.lam, material.most_lambda = isotropic.mu, isotropic.lam, 1e30
        for kernel, batch, places, turns in zip(self._products, self._batches, self._places, self._turns, strict=True):
            inputs = [places, material, turns, self._no_rows, p]
            wp.launch(kernel, batch.count, inputs, [y], device=self.field.device, block_dim=self._block)

    def add_diagonal(self, blocks: wp.array) -> None:
        self._rotated.take(self.displacements)
        self._rotated.add_diagonal(blocks)

    def _with_own_targets(self, batch: Batch) -> Subtrees:
        """The subtrees with their nodes as targets, for kernels with one thread a subtree."""
        given, found = batch.subtrees, Subtrees()
        found.code, found.first, found.frames, found.size = given.code, given.first, given.frames, given.size
        found.nodes = given.nodes
        if self.field.device.is_cpu:
            places = np.ascontiguousarray(given.nodes.numpy()[: batch.count].T)
            found.nodes = wp.array(places, dtype=wp.int32, device=self.field.device)
        found.targets = found.nodes
        return found


def subtrees_of(plan: Plan) -> tuple[Batch, ...] | None:
    """The subtrees of a mesh that does not change, if they have all leaves, each with its own rotation; else None."""
    if plan.counts is not None or len(plan.flat) or not plan.batches:
        return None
    if any(batch.sharing is not Sharing.OWN or batch.live is not None for batch in plan.batches):
        return None
    return tuple(plan.batches)
