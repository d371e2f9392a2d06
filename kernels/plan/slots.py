"""Slots: a place of its own for every force that a unit of work adds; see ``elements.elements``.

The slot of a node of a subtree, or of its group, is its place in ``Batches.nodes``; those of the leaves in no subtree
follow, four each.
"""

import warp as wp

from .batches import Batches, is_grouped, kind_of_class, node_count, node_place, shape_of_kind
from .plan import LEAVES_OF_SUBTREE, Plan, Tree, extent

wp.set_module_options({"enable_backward": False})


@wp.struct
class Targets:
    """Which slots forces are added to."""

    # Nodes of each leaf of a subtree or group as places of that, by shape.
    leaf_places: wp.array2d[wp.vec4i]  # [3, 8]
    group_leaf_places: wp.array2d[wp.vec4i]  # [3, 64]
    nodes: wp.array[wp.int32]  # the node of each slot, a number past the last node if it is not used
    of_subtrees: wp.array[wp.int32]  # as ``Batches.nodes``; -1 where there is no node
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
    """Name the slots of one class, and of its leaves, with each row of threads."""
    c, t = wp.tid()
    shape = shape_of_kind(kind_of_class(c, plan), plan)
    for k in range(t, plan.worlds * extent(c, plan), threads):
        for n in range(node_count(c, plan)):
            place = node_place(c, k, n, plan, batches)
            if batches.nodes[place] >= 0:
                targets.nodes[place] = batches.nodes[place]
                targets.of_subtrees[place] = place
        first = plan.first[plan.begin[c] + k]
        for leaf in range(LEAVES_OF_SUBTREE):
            own = targets.leaf_places[shape, leaf]
            unit = int(k)
            if is_grouped(c, plan):
                own = targets.group_leaf_places[shape, LEAVES_OF_SUBTREE * (k % 8) + leaf]
                unit -= k % 8
            for n in range(4):
                own[n] = node_place(c, unit, own[n], plan, batches)
            targets.of_leaves[first + leaf] = own


@wp.kernel(enable_backward=False)
def target_flat(
    # In
    begin: int,
    plan: Plan,
    tree: Tree,
    # Out
    targets: Targets,
):
    """Name the slots of the leaves in no subtree, which begin at a number."""
    k = wp.tid()
    i = plan.flat[k]
    start = begin + 4 * k
    for n in range(4):
        targets.nodes[start + n] = tree.leaf_tets[i][n]
    targets.of_leaves[i] = wp.vec4i(start, start + 1, start + 2, start + 3)


@wp.kernel(enable_backward=False)
def find_starts(
    # In
    count: int,
    nodes: wp.array[wp.int32],
    # Out
    starts: wp.array[wp.int32],
):
    """Where each node's slots begin among ``count`` slots sorted by node; there is room for one more."""
    starts[wp.tid()] = wp.lower_bound(nodes, 0, count + 1, wp.tid())
