"""Renumbers nodes without gaps after a removal, and restores the tree order of the leaves after a pass.

With N' nodes left, the holes are the places of removed nodes below N', and the movers are the nodes from N' on; their
numbers are equal. Each mover moves into a hole. Its number is changed in tetrahedra of all levels, and in the ends of
other nodes.

Each thread processes one stretch of the former list of leaves: a bisected leaf is replaced by its descendants, a merged
one by its parent. A sum over the threads gives the start of each."""

import warp as wp

from warp_corot.kernels.remesh.pools import (
    ADDED,
    LEAVES,
    NEW_LEAVES,
    NODE_TOP,
    OLD_TOP,
    REMOVED,
    UNUSED,
    Carried,
    Pools,
    move_node,
    padding,
)

wp.set_module_options({"enable_backward": False})


@wp.struct
class Moves:
    """The moves in the current pass."""

    counts: wp.array[wp.int32]  # [2] of holes and of movers, which are equal
    holes: wp.array[wp.int32]
    movers: wp.array[wp.int32]
    forward: wp.array[wp.int32]  # new numbers of movers by their old ones


@wp.kernel(enable_backward=False)
def list_moves(
    # In
    threads: int,
    pools: Pools,
    # In and out
    moves: Moves,
):
    top = pools.counts[NODE_TOP] - pools.counts[REMOVED]
    count = wp.where(pools.counts[REMOVED] > 0, pools.counts[NODE_TOP], 0)
    for i in range(wp.tid(), count, threads):
        if i < top and pools.valence[i] == 0:
            moves.holes[wp.atomic_add(moves.counts, 0, 1)] = i
        elif i >= top and pools.valence[i] > 0:
            moves.movers[wp.atomic_add(moves.counts, 1, 1)] = i


@wp.kernel(enable_backward=False)
def move_nodes(
    # In
    threads: int,
    # In and out
    pools: Pools,
    carried: Carried,
    moves: Moves,
):
    """Move nodes into the holes, and lower the number of nodes."""
    for k in range(wp.tid(), moves.counts[0], threads):
        mover = moves.movers[k]
        hole = moves.holes[k]
        moves.forward[mover] = hole
        pools.lattice[hole] = pools.lattice[mover]
        pools.ends[hole] = pools.ends[mover]
        pools.valence[hole] = pools.valence[mover]
        pools.valence[mover] = 0
        move_node(mover, hole, carried)
    if wp.tid() == 0:
        pools.counts[OLD_TOP] = pools.counts[NODE_TOP]
        pools.counts[NODE_TOP] = pools.counts[NODE_TOP] - pools.counts[REMOVED]


@wp.func
def present_name(node: int, top: int, old_top: int, moves: Moves):
    """A node's current number; movers had numbers from ``top`` up to ``old_top``."""
    if node >= top and node < old_top:
        return moves.forward[node]
    return node


@wp.kernel(enable_backward=False)
def rename_nodes(
    # In
    threads: int,
    moves: Moves,
    # In and out
    pools: Pools,
):
    """Write the numbers of moved nodes into tetrahedra of all levels, and into ends; nodes that only void tetrahedra
    name may have ends that moved."""
    top = pools.counts[NODE_TOP]
    old_top = pools.counts[OLD_TOP]
    others = pools.sink - pools.node_limit
    if moves.counts[0] == 0:
        return
    for e in range(wp.tid(), pools.level.shape[0], threads):
        if pools.level[e] != UNUSED:
            tet = pools.tets[e]
            for n in range(4):
                tet[n] = present_name(tet[n], top, old_top, moves)
            pools.tets[e] = tet
    for i in range(wp.tid(), top + others, threads):
        node = wp.where(i < top, i, pools.node_limit + i - top)
        a = present_name(pools.ends[node][0], top, old_top, moves)
        b = present_name(pools.ends[node][1], top, old_top, moves)
        pools.ends[node] = wp.vec2i(wp.min(a, b), wp.max(a, b))


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


@wp.func
def walk_leaves(t: int, threads: int, first: int, writes: bool, pools: Pools):
    """The place after the leaves from a thread's stretch, which begin at this one; lists them if asked. Nothing if no
    leaf has changed."""
    place = int(first)
    if pools.counts[ADDED] + pools.counts[REMOVED] > 0:
        stretch = (pools.counts[LEAVES] + threads - 1) / threads
        for i in range(t * stretch, wp.min((t + 1) * stretch, pools.counts[LEAVES])):
            leaf = first_leaf(i, pools)
            top = wp.where(pools.level[pools.leaves[i]] == UNUSED, leaf, pools.leaves[i])
            while leaf >= 0:
                if writes:
                    pools.new_leaves[place] = leaf
                place += 1
                leaf = next_leaf(leaf, top, pools)
    return place


@wp.kernel(enable_backward=False)
def count_leaves(
    # In
    threads: int,
    pools: Pools,
    # Out
    sums: wp.array[wp.int32],
):
    sums[wp.tid()] = walk_leaves(wp.tid(), threads, 0, False, pools)


@wp.kernel(enable_backward=False)
def list_leaves(
    # In
    threads: int,
    sums: wp.array[wp.int32],
    ends: wp.array[wp.int32],
    # In and out
    pools: Pools,
):
    """Write the new list; ``ends`` are inclusive sums."""
    t = wp.tid()
    place = walk_leaves(t, threads, ends[t] - sums[t], True, pools)
    if t == threads - 1:
        pools.counts[NEW_LEAVES] = place


@wp.kernel(enable_backward=False)
def adopt_list(
    # In
    threads: int,
    # In and out
    pools: Pools,
):
    """Replace the old list by the new one."""
    new = pools.counts[NEW_LEAVES]
    count = wp.max(new, pools.counts[LEAVES])
    if pools.counts[ADDED] + pools.counts[REMOVED] == 0:
        count = 0
    for i in range(wp.tid(), count, threads):
        if i < new:
            pools.leaves[i] = pools.new_leaves[i]
            pools.leaf_tets[i] = pools.tets[pools.new_leaves[i]]
        else:
            pools.leaf_tets[i] = padding(i, pools)
