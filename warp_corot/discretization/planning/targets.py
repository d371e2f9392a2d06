"""Slots for the forces of a plan's subtrees and single leaves; see ``kernels.plan.slots``."""

from __future__ import annotations

from collections.abc import Sequence

import warp as wp

from warp_corot.discretization.elements import Elements
from warp_corot.discretization.slots import Slots, check_slots
from warp_corot.kernels.plan import slots as kernels
from warp_corot.kernels.plan.plan import places_t
from warp_corot.kernels.tables.subtree import GROUP_NODES, group_nodes

from .arrays import PlanArrays
from .planner import threads_on
from .tree import places_on


class SubtreeTargets:
    """Slots for the forces of all subtrees, or groups of these, and single leaves.

    Args:
        made: The plan's arrays, filled.
        subtrees, flat: Numbers of a world's subtrees of each class, and of its leaves outside subtrees.
        elements: The leaves, in all worlds.

    Attributes:
        slots: The slots.
        of_subtrees: The places to which forces of subtrees are added, in the layout of ``made.batches.nodes``.
        of_leaves: The places to which forces of all leaves are added, vec4i [worlds * T].
        of_flat: The same for leaves outside subtrees.

    Raises:
        InputError: There are more slots than can be numbered.
    """

    def __init__(self, made: PlanArrays, subtrees: Sequence[int], flat: int, elements: Elements, worlds: int):
        device, plan = made.device, made.plan
        begin, unused = [0], 0
        for row, count in enumerate(subtrees):
            grouped = made.is_grouped(row)
            begin.append(begin[-1] + (5 if grouped else 10) * count)
            if grouped:
                shape = made.kinds[row // plan.members][1]
                unused += count // 8 * (GROUP_NODES - len(group_nodes(shape)))
        per_world = begin[-1] + 4 * flat
        check_slots(worlds * per_world)
        tables = places_on(device.alias)
        targets = kernels.Targets()
        targets.begin = places_t(*begin, *[0] * (16 - len(begin)))
        targets.per_world, targets.no_node = per_world, plan.world_nodes
        targets.leaf_places, targets.group_leaf_places = tables.leaves, tables.group_leaves
        # The second half is room for sorting.
        targets.nodes = wp.empty(2 * per_world, dtype=wp.int32, device=device)
        targets.of_subtrees = wp.empty_like(made.batches.nodes)
        targets.of_leaves = wp.empty_like(elements.nodes)
        targets.of_flat = wp.empty_like(made.leaves.nodes)
        threads = threads_on(device)
        if any(subtrees):
            inputs = [threads, plan, made.batches]
            wp.launch(kernels.target_subtrees, (plan.classes, threads), inputs, [targets], device=device)
        if flat:
            wp.launch(kernels.target_flat, (worlds, flat), [plan, made.tree], [targets], device=device)
        self.of_subtrees, self.of_leaves, self.of_flat = targets.of_subtrees, targets.of_leaves, targets.of_flat
        self.slots = Slots.of_nodes(targets.nodes, per_world, per_world - unused, plan.world_nodes, worlds)
