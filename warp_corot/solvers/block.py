"""Small bodies on CUDA: all steps of a launch in one thread block for each world; see ``kernels.block``."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from ..elasticity.corotated import SubtreeField
from ..kernels import block
from ..mesh import TetForest
from ..plan import Batch, ForcePlan, Sharing

if TYPE_CHECKING:
    from ..body import SoftBody
    from ..elasticity import ForceField
    from .integrator import StepContext


class BlockSteps:
    """Symplectic Euler steps of a body that fits into a block.

    Made by ``of``, which knows whether it does.
    """

    def __init__(self, body: SoftBody, batch: Batch):
        self.body = body
        nodes = batch.subtrees.nodes.numpy()
        capacity = block.rounded(batch.count)
        degree = np.bincount(nodes.ravel(), minlength=body.world_node_count)
        order = np.argsort(-degree, kind="stable")
        place = np.empty_like(order)
        place[order] = np.arange(len(order))
        device = body.device

        def on_device(values: np.ndarray) -> wp.array:
            return wp.array(np.ascontiguousarray(values), dtype=wp.int32, device=device)

        of_block = block.BlockBody()
        of_block.subtrees = batch.subtrees
        of_block.subtrees.nodes = on_device(place[nodes])
        of_block.elements = body.elements
        of_block.roots = body.elements if batch.roots is None else batch.roots
        of_block.subtree_count = batch.count
        of_block.node_count = body.world_node_count
        of_block.element_count = len(body.mesh.tets)
        of_block.order = on_device(order)
        of_block.degree = on_device(degree[order])
        of_block.slots = on_device(_slots(place[nodes], degree[order], capacity))
        self._block = of_block
        self._threads = capacity
        self._kernel = block.step_block(
            batch.shape,
            batch.sharing is Sharing.ROOT,
            _is_uniform(body),
            block.rounded(body.world_node_count),
            capacity,
        )

    @classmethod
    def of(cls, body: SoftBody, field: ForceField) -> BlockSteps | None:
        """A body's steps in blocks, or None: not on CUDA, too large, or not made of subtrees of one type alone."""
        if not body.device.is_cuda or not isinstance(field, SubtreeField) or not isinstance(body.mesh, TetForest):
            return None
        if not block.fits(body.world_node_count, len(body.mesh.tets) // 8):
            return None
        plan = ForcePlan.of_forest(body.mesh, field.model.rotation_level, body.device, grouped=False)
        if len(plan.batches) != 1 or len(plan.flat) or plan.batches[0].sharing is Sharing.ABOVE:
            return None
        return cls(body, plan.batches[0])

    def launch(self, count: int, damping: float, context: StepContext) -> None:
        """Launch ``count`` steps, the first ones since the clock was last advanced."""
        body = self.body
        wp.launch(
            self._kernel,
            dim=body.worlds * self._threads,
            block_dim=self._threads,
            inputs=[
                self._block,
                count,
                context.dt,
                damping,
                context.gravity,
                body.mu,
                body.lam,
                body.material_stride,
                body.node_mass,
                body.node_inverse_mass,
                int(body.has_loads),
                body.node_loads,
                context.clock,
                body.node_displacements,
                body.node_velocities,
            ],
            outputs=[body.node_reactions, context.bad_step],
            device=body.device,
        )


def _is_uniform(body: SoftBody) -> bool:
    """Whether the elements of a world are all of one material."""
    shapes = [np.shape(value) for value in (body.material.young, body.material.poisson)]
    return all(not shape or shape[-1] == 1 for shape in shapes)


def _slots(places: np.ndarray, degree: np.ndarray, capacity: int) -> np.ndarray:
    """The slots that each place adds up, in order of subtrees.

    Args:
        places: Of the nodes of the subtrees, [10, S].
        degree: How many subtrees meet at each place [N].
        capacity: By how many the slots of one local node come after those of the one before.

    Returns:
        int32 [most, N], zero past a place's degree.
    """
    local, subtree = np.indices(places.shape)
    by_place = np.lexsort((local.ravel(), subtree.ravel(), places.ravel()))
    at = places.ravel()[by_place]
    rank = np.arange(len(at)) - (np.cumsum(degree) - degree)[at]
    table = np.zeros((degree.max(), len(degree)), np.int32)
    table[rank, at] = (subtree + local * capacity).ravel()[by_place]
    return table
