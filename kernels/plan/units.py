"""The elements whose rotations are found if leaves share them: the units of a derived plan (``plan``), in tree order.

A unit is the highest tetrahedron above a leaf that is not above the rotation level and whose corners are nodes. The
leaves of a unit are contiguous.
"""

import warp as wp

from warp_corot.kernels.remesh.pools import NODE_TOP, Pools, padding

from .plan import Plan, extent, flat_row, level_of, padding_code


@wp.func
def on_nodes(e: int, pools: Pools):
    """Whether all corners are nodes of leaves; on the rim of a domain's mesh they may not be."""
    if pools.node_limit == pools.sink:
        return True
    tet = pools.tets[e]
    return wp.max(wp.max(tet[0], tet[1]), wp.max(tet[2], tet[3])) < pools.counts[NODE_TOP]


@wp.func
def unit_of(e: int, pools: Pools, plan: Plan):
    """The highest tetrahedron above a leaf, or the leaf, that is not above the rotation level and stands on nodes."""
    found = int(e)
    climbed = int(e)
    while pools.level[climbed] > plan.rotation_level:
        climbed = pools.parent[climbed]
        if on_nodes(climbed, pools):
            found = climbed
    return found


@wp.func
def begins_unit(i: int, pools: Pools, plan: Plan):
    """Whether leaf i has a different unit from the one before it.

    They share one if a common ancestor that is not above the level stands on nodes.
    """
    limit = plan.rotation_level
    if plan.rotation_level < 0:
        return False
    if i == 0 or wp.min(level_of(i, plan), level_of(i - 1, plan)) <= limit:
        return True
    a = int(pools.leaves[i - 1])
    b = int(pools.leaves[i])
    level_a = level_of(i - 1, plan)
    level_b = level_of(i, plan)
    while a != b and (level_a > limit or level_b > limit):
        if level_a >= level_b:
            a = pools.parent[a]
            level_a -= 1
        else:
            b = pools.parent[b]
            level_b -= 1
    if a != b:
        return True
    while not on_nodes(a, pools) and level_a > limit:
        a = pools.parent[a]
        level_a -= 1
    return not on_nodes(a, pools)


@wp.kernel(enable_backward=False)
def pad_units(
    # In
    threads: int,
    pools: Pools,
    # In and out
    plan: Plan,
):
    """Number units after the first place, which is padding."""
    row = flat_row(plan) + 1
    for k in range(plan.counts[row] + 1 + wp.tid(), extent(row, plan) + 1, threads):
        plan.unit_nodes[k] = padding(k, pools)
        plan.unit_code[k] = padding_code(pools)
