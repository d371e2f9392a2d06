"""The force plan of a forest that changes: its arrays, and the data of leaves by their places in them.

``lists`` finds the leaves in complete subtrees and the others; ``units`` the elements whose rotations are
found; ``batches`` writes the arrays that launches read.
"""

import warp as wp

from warp_corot.kernels.elements.elements import LEVEL_MASK
from warp_corot.kernels.remesh.pools import ADDED, LEAVES, REMOVED, Pools


@wp.struct
class Plan:
    """The derived arrays, sized for the capacity, with padding beyond the current size."""

    rotation_level: int  # -1: rotations are not shared
    with_subtrees: int  # 0: all leaves are computed one by one
    members: int  # 2: groups and single subtrees; 1: there are no groups
    classes: int
    # Numbers for each class, for leaves in none, for units and for leaves; and the former numbers.
    counts: wp.array[wp.int32]
    before: wp.array[wp.int32]
    stale: wp.array[wp.int32]  # [1] nonzero: derive it even if the last pass changed nothing
    goes: wp.array[wp.int32]  # [1] whether it is derived at all
    # Leaves.
    code: wp.array[wp.int32]
    values: wp.array2d[wp.float32]  # [names, leaves]
    marks: wp.array[wp.int8]
    unit: wp.array[wp.int32]
    # Subtrees by class, and the leaves in none.
    first: wp.array2d[wp.int32]  # [classes, subtrees]
    flat: wp.array[wp.int32]
    # Units; the first place is always padding, for leaves that are padding.
    unit_nodes: wp.array[wp.vec4i]
    unit_code: wp.array[wp.int32]


@wp.func
def flat_row(plan: Plan):
    """The row that counts leaves in no subtree; the next one counts units, then all leaves."""
    return plan.classes


@wp.func
def leaf_row(plan: Plan):
    """The row that counts all leaves."""
    return plan.classes + 2


@wp.func
def extent(row: int, plan: Plan):
    """Number of written places in a row, padding included."""
    if plan.goes[0] == 0:
        return 0
    return wp.max(plan.counts[row], plan.before[row])


@wp.func
def padding_code(pools: Pools):
    """The code of a root, whose frame is along the axes: deformation gradients of padding are exact, energies zero."""
    return pools.code[0]


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
            plan.code[i] = padding_code(pools)
            if plan.rotation_level >= 0:
                plan.unit[i] = 0
            for c in range(plan.values.shape[0]):
                plan.values[c, i] = 0.0


@wp.func
def above(e: int, steps: int, pools: Pools):
    found = int(e)
    for _ in range(steps):
        found = pools.parent[found]
    return found


@wp.func
def level_of(i: int, plan: Plan):
    return plan.code[i] & LEVEL_MASK
