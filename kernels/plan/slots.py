"""Numbers for slots: a place of its own for every force that a unit of work adds; see ``elements.elements``.

Slots of a world stand class after class, subtree after subtree or group after group, then those of the leaves in no
subtree. A group has all its 40 places, those that it does not use included.
"""

import warp as wp

from .batches import (
    GROUP_NODES,
    Batches,
    is_grouped,
    kind_of_class,
    node_count,
    node_place,
    shape_of_kind,
)
from .plan import LEAVES_OF_SUBTREE, Plan, Tree, extent, places_t

wp.set_module_options({"enable_backward": False})


@wp.struct
class Targets:
    """Which slots forces are added to."""

    begin: places_t  # of each class, then of the leaves in none
    per_world: int
    # Nodes of each leaf of a subtree or group as places of that, by shape.
    leaf_places: wp.array2d[wp.vec4i]  # [3, 8]
    group_leaf_places: wp.array2d[wp.vec4i]  # [3, 64]
    nodes: wp.array[wp.int32]  # the node of each slot of one world, and ``no_node`` for slots that are not used
    no_node: int
    of_subtrees: wp.array[wp.int32]  # as ``Batches.nodes``
    of_leaves: wp.array[wp.vec4i]  # of all leaves, in a subtree or not


@wp.kernel(enable_backward=False)
def target_subtrees(
    # In
    threads: int,
    plan: Plan,
    batches: Batches,
    # Out
    targets: Targets,
):
    """Number the slots of one class, and of its leaves, with each row of threads."""
    c, t = wp.tid()
    shape = shape_of_kind(kind_of_class(c, plan), plan)
    grouped = is_grouped(c, plan)
    count = extent(c, plan)
    for k in range(t, plan.worlds * count, threads):
        world = k / count
        in_world = k - world * count
        start = world * targets.per_world + targets.begin[c]
        behind = int(0)
        if grouped:
            start += GROUP_NODES * (in_world / 8)
            behind = 5 * (k % 8)
        else:
            start += node_count(c, plan) * in_world
        for n in range(node_count(c, plan)):
            slot = start + behind + n
            place = node_place(c, k, n, plan, batches)
            node = batches.nodes[place]
            if world == 0:
                targets.nodes[slot] = wp.where(node < 0, targets.no_node, node)
            targets.of_subtrees[place] = wp.where(node < 0, -1, slot)
        first = plan.first[plan.begin[c] + k]
        for leaf in range(LEAVES_OF_SUBTREE):
            own = wp.vec4i(0)
            if grouped:
                own = targets.group_leaf_places[shape, LEAVES_OF_SUBTREE * (k % 8) + leaf]
            else:
                own = targets.leaf_places[shape, leaf]
            targets.of_leaves[first + leaf] = own + wp.vec4i(start, start, start, start)


@wp.kernel(enable_backward=False)
def target_flat(
    # In
    plan: Plan,
    tree: Tree,
    # Out
    targets: Targets,
):
    """Number the slots of the leaves in no subtree."""
    world, k = wp.tid()
    start = targets.begin[plan.classes] + 4 * k
    i = plan.flat[k]
    if world == 0:
        for n in range(4):
            targets.nodes[start + n] = tree.leaf_tets[i][n]
    start += world * targets.per_world
    targets.of_leaves[world * plan.world_leaves + i] = wp.vec4i(start, start + 1, start + 2, start + 3)


@wp.kernel(enable_backward=False)
def find_starts(
    # In
    count: int,
    world_nodes: int,
    there: int,
    nodes: wp.array[wp.int32],
    # Out
    starts: wp.array[wp.int32],
):
    """Where each node's slots begin among ``count`` slots sorted by node, ``there`` of which are used."""
    world, node = wp.tid()
    # The end of one world is the start of the next.
    starts[world * world_nodes + node] = world * there + wp.lower_bound(nodes, 0, count + 1, node)


@wp.kernel(enable_backward=False)
def order_slots(
    # In
    per_world: int,
    there: int,
    sorted_slots: wp.array[wp.int32],
    # Out
    order: wp.array[wp.int32],
):
    """The slots by node, of all worlds."""
    world, i = wp.tid()
    order[world * there + i] = sorted_slots[i] + world * per_world
