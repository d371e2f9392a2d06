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

    def __init__(self, body: SoftBody, batch: Batch, layout: block.Layout):
        self.body = body
        nodes = batch.subtrees.nodes.numpy()
        slots = _slots_by_node(layout, nodes, body.world_node_count)
        chunks = np.array([-(-len(of_node) // block.CHUNK) for of_node in slots])
        order = np.argsort(-chunks, kind="stable")
        place = np.empty_like(order)
        place[order] = np.arange(len(order))
        table = np.full((max(chunks.max(), 1), len(order), block.CHUNK), layout.slot_count, np.uint16)
        for node, of_node in enumerate(slots):
            for k, number in enumerate(of_node):
                table[k // block.CHUNK, place[node], k % block.CHUNK] = number
        device = body.device

        def on_device(values: np.ndarray, dtype: type = wp.int32) -> wp.array:
            return wp.array(np.ascontiguousarray(values), dtype=dtype, device=device)

        of_block = block.BlockBody()
        of_block.subtrees = batch.subtrees
        of_block.subtrees.nodes = on_device(place[nodes])
        of_block.elements = body.elements
        of_block.roots = body.elements if batch.roots is None else batch.roots
        of_block.subtree_count = batch.count
        of_block.node_count = body.world_node_count
        of_block.element_count = len(body.mesh.tets)
        of_block.order = on_device(order)
        of_block.chunks = on_device(chunks[order])
        of_block.slots = on_device(table.view("<u8")[..., 0], wp.uint64)
        self._block = of_block
        self._layout = layout
        self._kernel = block.step_block(layout)

    @classmethod
    def of(cls, body: SoftBody, field: ForceField) -> BlockSteps | None:
        """A body's steps in blocks, or None: not on CUDA, too large, or not made of subtrees of one type alone."""
        if not body.device.is_cuda or not isinstance(field, SubtreeField) or not isinstance(body.mesh, TetForest):
            return None
        if not any(layout.fits for layout in _layouts(body, 0, False, len(body.mesh.tets) // 8)):
            return None
        plan = ForcePlan.of_forest(body.mesh, field.model.rotation_level, body.device, grouped=False)
        if len(plan.batches) != 1 or len(plan.flat) or plan.batches[0].sharing is Sharing.ABOVE:
            return None
        batch = plan.batches[0]
        layouts = _layouts(body, batch.shape, batch.sharing is Sharing.ROOT, batch.count)
        return cls(body, batch, next(layout for layout in layouts if layout.fits))

    def launch(self, count: int, damping: float, context: StepContext) -> None:
        """Launch ``count`` steps, the first ones since the clock was last advanced."""
        body = self.body
        wp.launch(
            self._kernel,
            dim=body.worlds * self._layout.threads,
            block_dim=self._layout.threads,
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


def _layouts(body: SoftBody, shape: int, shared: bool, subtrees: int) -> list[block.Layout]:
    """The ways to deal a body out, the fastest first.

    A world is soonest done with the leaves of a subtree dealt to several threads; where there are more worlds than
    multiprocessors, whole subtrees take less work.
    """
    parts = (4, 2, 1) if body.worlds <= body.device.sm_count else (1,)
    capacity = -(-subtrees // block.WARP) * block.WARP
    uniform = _is_uniform(body)
    return [block.Layout(shape, shared, uniform, count, capacity, body.world_node_count) for count in parts]


def _slots_by_node(layout: block.Layout, nodes: np.ndarray, count: int) -> list[list[int]]:
    """The slots that each node adds up, in order of subtrees and parts.

    Args:
        nodes: Of the subtrees, [10, S].
        count: Number of nodes.
    """
    slots: list[list[int]] = [[] for _ in range(count)]
    for subtree, ten in enumerate(nodes.T):
        for places in layout.places:
            for node, place in zip(ten, places, strict=True):
                if place >= 0:
                    slots[node].append(subtree + place * layout.subtrees)
    return slots
