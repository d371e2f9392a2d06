"""Small bodies on CUDA: all steps of a launch in one thread block for each world; see ``kernels.stepping.block``."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warp_corot.discretization.plan import Batch
from warp_corot.discretization.planner import ForcePlan
from warp_corot.elasticity.corotated.fields import SubtreeField
from warp_corot.elasticity.dilatation import law_of
from warp_corot.kernels.stepping.block import BlockBody, step_block
from warp_corot.kernels.tables.block_layout import (
    FIRST_SHIFT,
    FOLLOWING_SHIFT,
    MOST_SLOTS,
    NO_NODE,
    NUMBERS,
    TASK_SLOTS,
    VECTOR_BYTES,
    WARP,
    Layout,
)
from warp_corot.mesh import TetForest

if TYPE_CHECKING:
    from warp_corot.body.soft_body import SoftBody
    from warp_corot.elasticity import ForceField
    from warp_corot.solvers.system import System


class BlockSteps:
    """Symplectic Euler steps of a body that fits into a block.

    ``of`` makes it if the body fits.
    """

    def __init__(self, body: SoftBody, field: ForceField, batch: Batch, layout: Layout, slots: list[list[int]]):
        self.body = body
        self._field = field
        tasks, numbers = _tasks(layout, slots)
        layout = dataclasses.replace(layout, tasks=len(tasks))
        device = body.device
        of_block = BlockBody()
        of_block.subtrees = batch.subtrees
        of_block.subtree_count = batch.count
        of_block.node_count = body.world_node_count
        of_block.element_count = len(body.mesh.tets)
        of_block.tasks = wp.array(tasks, dtype=wp.int32, device=device)
        of_block.nodes = wp.array(_packed(batch.subtrees.nodes.numpy().T), dtype=wp.uint64, device=device)
        of_block.slots = wp.array(numbers, dtype=wp.uint64, device=device)
        self._block = of_block
        self._layout = layout

    @classmethod
    def of(cls, body: SoftBody, field: ForceField) -> BlockSteps | None:
        """A body's steps in blocks; None if it is not on CUDA, too large, or has more than subtrees of one type."""
        if body.changing is not None or not body.device.is_cuda:
            return None
        law, sharing = law_of(field)
        if not isinstance(law, SubtreeField) or not isinstance(body.mesh, TetForest) or law.rotation_level is not None:
            return None
        if not any(layout.fits for layout in _layouts(body, 0, len(body.mesh.tets) // 8)):
            return None
        plan = ForcePlan.of_forest(body.mesh, None, body.device, elements=body.discretization.elements, grouped=False)
        if len(plan.batches) != 1 or len(plan.flat):
            return None
        batch = plan.batches[0]
        layouts = _layouts(body, batch.shape, batch.count, dilating=sharing is not None)
        layout = next((layout for layout in layouts if layout.fits), None)
        if layout is None:
            return None
        slots = _slots_by_node(layout, batch.subtrees.nodes.numpy(), body.world_node_count)
        if max(map(len, slots)) > MOST_SLOTS:
            return None
        return cls(body, field, batch, layout, slots)

    #: Whether the device has all that a launch reads of the body's controls.
    is_prepared = True

    def launch(self, count: int, damping: float, system: System) -> None:
        """Launch ``count`` steps, the first ones since the clock was last advanced."""
        body = self.body
        wp.launch(
            step_block(self._layout),
            dim=body.worlds * self._layout.threads,
            block_dim=self._layout.threads,
            inputs=[
                self._block,
                count,
                system.dynamics(body, damping),
                self._field.isotropic,
                body.conditions.mass,
                system.pace.arrays,
            ],
            outputs=[body.state.reactions, system.support_work, system.bad_step],
            device=body.device,
        )


def _layouts(body: SoftBody, shape: int, subtrees: int, *, dilating: bool = False) -> list[Layout]:
    """The layouts of a body in a block, the fastest first.

    A single world is fastest with the leaves of a subtree split between two threads. With more worlds than
    multiprocessors, a thread for a whole subtree takes less work.
    """
    parts = (2, 1) if body.worlds <= body.device.sm_count else (1,)
    capacity = -(-subtrees // WARP) * WARP
    uniform = body.discretization.is_uniform
    nodes = body.world_node_count
    return [Layout(shape, uniform, count, capacity, nodes, dilating=dilating) for count in parts]


def _tasks(layout: Layout, slots: list[list[int]]) -> tuple[np.ndarray, np.ndarray]:
    """The sums of threads: up to eight slots of one node each. The threads of a node are neighbours in one warp.

    Returns:
        The tasks, int32 [n], and the places of their slots, uint64 [2, n]; n is a multiple of a warp's threads.
    """
    tasks: list[int] = []
    numbers: list[list[int]] = []

    def leave_out(count: int) -> None:
        tasks.extend([NO_NODE] * count)
        numbers.extend([[]] * count)

    # Nodes with many slots first, so that the threads of a warp have equal work and few places stay unused.
    for node in sorted(range(len(slots)), key=lambda n: -len(slots[n])):
        of_node = [slots[node][at : at + TASK_SLOTS] for at in range(0, len(slots[node]), TASK_SLOTS)]
        of_node = of_node or [[]]
        left = -len(tasks) % WARP
        if left < len(of_node):
            leave_out(left)
        for k, own in enumerate(of_node):
            following = len(of_node) - 1 - k
            tasks.append(node | following << FOLLOWING_SHIFT | int(k == 0) << FIRST_SHIFT)
            numbers.append(own)
    leave_out(-len(tasks) % WARP)
    table = np.full((len(tasks), TASK_SLOTS), layout.slot_count)
    for row, own in zip(table, numbers, strict=True):
        row[: len(own)] = own
    return np.array(tasks, np.int32), _packed(table)


def _packed(places: np.ndarray) -> np.ndarray:
    """Places of vectors, [n, m], in bytes and four to a word: uint64 [m / 4, n]."""
    width = -(-places.shape[1] // NUMBERS) * NUMBERS
    table = np.zeros((len(places), width), "<u2")
    table[:, : places.shape[1]] = places * VECTOR_BYTES
    return np.ascontiguousarray(table.view("<u8").T)


def _slots_by_node(layout: Layout, nodes: np.ndarray, count: int) -> list[list[int]]:
    """The slots that each node adds up, in order of subtrees and parts.

    Args:
        nodes: Nodes of the subtrees, [10, S].
        count: Number of nodes.
    """
    slots: list[list[int]] = [[] for _ in range(count)]
    places_by_part = layout.places
    for subtree, ten in enumerate(nodes.T):
        for places in places_by_part:
            for node, place in zip(ten, places, strict=True):
                if place >= 0:
                    slots[node].append(subtree + place * layout.subtrees)
    return slots
