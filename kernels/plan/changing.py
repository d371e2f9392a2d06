"""What a plan of a forest that changes needs besides: whether it is derived again, and the data of its leaves."""

import warp as wp

from warp_corot.kernels.remesh.pools import ADDED, LEAVES, REMOVED, Pools

from .plan import Plan, extent, leaf_row
from .tree import Tree

wp.set_module_options({"enable_backward": False})


@wp.kernel(enable_backward=False)
def begin_plan(
    # In
    pools: Pools,
    # In and out
    plan: Plan,
):
    plan.goes[0] = 0
    if pools.counts[ADDED] + pools.counts[REMOVED] > 0 or plan.stale[0] != 0:
        plan.goes[0] = 1
        for row in range(plan.classes + 3):
            plan.before[row] = plan.counts[row]
        plan.counts[leaf_row(plan)] = pools.counts[LEAVES]
    plan.stale[0] = 0


@wp.kernel(enable_backward=False)
def begin_counts(
    # In
    goes: wp.array[wp.int32],
    # Out
    found: wp.array[wp.int32],
):
    """Reset the counts if they will be counted again."""
    if goes[0] != 0:
        found[wp.tid()] = 0


@wp.kernel(enable_backward=False)
def gather_leaves(
    # In
    threads: int,
    pools: Pools,
    tree: Tree,
    carried_values: wp.array2d[wp.float32],
    # In and out
    plan: Plan,
):
    """Data of leaves by their places in the list; values of padding are zero."""
    for i in range(wp.tid(), extent(leaf_row(plan), plan), threads):
        if i < pools.counts[LEAVES]:
            e = pools.leaves[i]
            plan.code[i] = pools.code[e]
            for c in range(plan.values.shape[0]):
                plan.values[c, i] = carried_values[e, c]
        else:
            plan.code[i] = tree.padding_code
            if plan.rotation_level >= 0:
                plan.unit[i] = 0
            for c in range(plan.values.shape[0]):
                plan.values[c, i] = 0.0
