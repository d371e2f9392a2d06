"""Restores the tree order of the leaves after a pass.

Each thread processes one stretch of the former list: a bisected leaf is replaced by its descendants, a merged one by
its parent. A sum over the threads gives the start of each.
"""

import warp as wp

from .dense import Moves, rename_upwards
from .pools import ADDED, LEAVES, NEW_LEAVES, NODE_TOP, OLD_TOP, REMOVED, UNUSED, Pools, padding

wp.set_module_options({"enable_backward": False})


@wp.func
def next_leaf(e: int, top: int, pools: Pools):
    """The leaf below ``top`` that follows e in tree order, -1 after the last."""
    found = int(e)
    while found != top and (found - pools.roots) % 2 == 1:
        found = pools.parent[found]
    if found == top:
        return -1
    found += 1
    while pools.first_child[found] >= 0:
        found = pools.first_child[found]
    return found


@wp.func
def first_leaf(i: int, pools: Pools):
    """The first leaf in place of the i-th, -1 if there is none."""
    found = pools.leaves[i]
    if pools.level[found] == UNUSED:
        if (found - pools.roots) % 2 == 1:
            return -1
        return pools.parent[found]
    while pools.first_child[found] >= 0:
        found = pools.first_child[found]
    return found


@wp.kernel(enable_backward=False)
def count_leaves(
    # In
    threads: int,
    pools: Pools,
    # Out
    sums: wp.array[wp.int32],
):
    """The number of leaves from each thread's stretch; nothing if no leaf has changed."""
    t = wp.tid()
    total = int(0)
    if pools.counts[ADDED] + pools.counts[REMOVED] > 0:
        stretch = (pools.counts[LEAVES] + threads - 1) / threads
        for i in range(t * stretch, wp.min((t + 1) * stretch, pools.counts[LEAVES])):
            top = pools.leaves[i]
            leaf = first_leaf(i, pools)
            if leaf >= 0 and (leaf == top or pools.level[top] == UNUSED):
                total += 1
            else:
                while leaf >= 0:
                    total += 1
                    leaf = next_leaf(leaf, top, pools)
    sums[t] = total


@wp.kernel(enable_backward=False)
def list_leaves(
    # In
    threads: int,
    sums: wp.array[wp.int32],
    # In and out
    pools: Pools,
):
    """Write the new list; ``sums`` are inclusive."""
    t = wp.tid()
    if pools.counts[ADDED] + pools.counts[REMOVED] > 0:
        place = int(0)
        if t > 0:
            place = sums[t - 1]
        stretch = (pools.counts[LEAVES] + threads - 1) / threads
        for i in range(t * stretch, wp.min((t + 1) * stretch, pools.counts[LEAVES])):
            top = pools.leaves[i]
            leaf = first_leaf(i, pools)
            if leaf >= 0 and (leaf == top or pools.level[top] == UNUSED):
                pools.new_leaves[place] = leaf
                place += 1
            else:
                while leaf >= 0:
                    pools.new_leaves[place] = leaf
                    place += 1
                    leaf = next_leaf(leaf, top, pools)
        if t == threads - 1:
            pools.counts[NEW_LEAVES] = place


@wp.kernel(enable_backward=False)
def adopt_list(
    # In
    threads: int,
    moves: Moves,
    # In and out
    pools: Pools,
):
    """Replace the old list by the new one, with new numbers for nodes that have moved."""
    new = pools.counts[NEW_LEAVES]
    top = pools.counts[NODE_TOP]
    old_top = pools.counts[OLD_TOP]
    count = wp.max(new, pools.counts[LEAVES])
    if pools.counts[ADDED] + pools.counts[REMOVED] == 0:
        count = 0
    for i in range(wp.tid(), count, threads):
        if i < new:
            e = pools.new_leaves[i]
            pools.leaves[i] = e
            pools.leaf_tets[i] = rename_upwards(e, top, old_top, pools, moves)
        else:
            pools.leaf_tets[i] = padding(i, pools)


@wp.kernel(enable_backward=False)
def adopt_count(
    # In and out
    pools: Pools,
):
    if pools.counts[ADDED] + pools.counts[REMOVED] > 0:
        pools.counts[LEAVES] = pools.counts[NEW_LEAVES]
