"""Renumbers nodes without gaps after a removal, and restores the tree order of the leaves after a pass.

With N' nodes left, the holes are the places of removed nodes below N', and the movers are the nodes from N' on; their
numbers are equal. The k-th mover moves into the k-th hole, independently of the threads. Its number is changed in
leaves and, upwards from these, in their ancestors, and in the ends of other nodes.

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

    sums: wp.array[wp.int32]  # [2 * threads] holes in each thread's stretch of the nodes, then movers
    ends: wp.array[wp.int32]  # inclusive sums of these
    holes: wp.array[wp.int32]
    movers: wp.array[wp.int32]
    forward: wp.array[wp.int32]  # new numbers of movers by their old ones


@wp.func
def walk_nodes(t: int, threads: int, first_hole: int, first_mover: int, writes: bool, pools: Pools, moves: Moves):
    """The places after the holes and movers in a thread's stretch, which begin at these; lists them if asked."""
    hole = int(first_hole)
    mover = int(first_mover)
    if pools.counts[REMOVED] > 0:
        top = pools.counts[NODE_TOP] - pools.counts[REMOVED]
        stretch = (pools.counts[NODE_TOP] + threads - 1) / threads
        for i in range(t * stretch, wp.min((t + 1) * stretch, pools.counts[NODE_TOP])):
            if i < top and pools.valence[i] == 0:
                if writes:
                    moves.holes[hole] = i
                hole += 1
            elif i >= top and pools.valence[i] > 0:
                if writes:
                    moves.movers[mover] = i
                mover += 1
    return hole, mover


@wp.kernel(enable_backward=False)
def count_moves(
    # In
    threads: int,
    pools: Pools,
    # Out
    moves: Moves,
):
    t = wp.tid()
    holes, movers = walk_nodes(t, threads, 0, 0, False, pools, moves)
    moves.sums[t] = holes
    moves.sums[threads + t] = movers


@wp.kernel(enable_backward=False)
def list_moves(
    # In
    threads: int,
    pools: Pools,
    # In and out
    moves: Moves,
):
    t = wp.tid()
    hole = moves.ends[t] - moves.sums[t]
    mover = moves.ends[threads + t] - moves.sums[threads + t] - moves.ends[threads - 1]
    walk_nodes(t, threads, hole, mover, True, pools, moves)


@wp.kernel(enable_backward=False)
def lower_top(
    # In and out
    pools: Pools,
):
    counts = pools.counts
    counts[OLD_TOP] = counts[NODE_TOP]
    counts[NODE_TOP] = counts[NODE_TOP] - counts[REMOVED]


@wp.kernel(enable_backward=False)
def move_nodes(
    # In
    threads: int,
    # In and out
    pools: Pools,
    carried: Carried,
    moves: Moves,
):
    for k in range(wp.tid(), moves.ends[threads - 1], threads):
        mover = moves.movers[k]
        hole = moves.holes[k]
        moves.forward[mover] = hole
        pools.lattice[hole] = pools.lattice[mover]
        pools.ends[hole] = pools.ends[mover]
        pools.valence[hole] = pools.valence[mover]
        pools.valence[mover] = 0
        move_node(mover, hole, carried)


@wp.func
def present_name(node: int, top: int, old_top: int, moves: Moves):
    """A node's current number; movers had numbers from ``top`` up to ``old_top``."""
    if node >= top and node < old_top:
        return moves.forward[node]
    return node


@wp.func
def with_present_names(tet: wp.vec4i, top: int, old_top: int, moves: Moves):
    return wp.vec4i(
        present_name(tet[0], top, old_top, moves),
        present_name(tet[1], top, old_top, moves),
        present_name(tet[2], top, old_top, moves),
        present_name(tet[3], top, old_top, moves),
    )


@wp.kernel(enable_backward=False)
def rename_ends(
    # In
    threads: int,
    moves: Moves,
    # In and out
    pools: Pools,
):
    """Rename ends if a node has moved; nodes that only void tetrahedra name may have ends that moved."""
    top = pools.counts[NODE_TOP]
    old_top = pools.counts[OLD_TOP]
    count = top + pools.sink - pools.node_limit
    if moves.ends[threads - 1] == 0:
        count = 0
    for i in range(wp.tid(), count, threads):
        node = wp.where(i < top, i, pools.node_limit + i - top)
        ends = pools.ends[node]
        a = present_name(ends[0], top, old_top, moves)
        b = present_name(ends[1], top, old_top, moves)
        if a != ends[0] or b != ends[1]:
            pools.ends[node] = wp.vec2i(wp.min(a, b), wp.max(a, b))


@wp.func
def rename_upwards(e: int, top: int, old_top: int, pools: Pools, moves: Moves):
    """Write current numbers into a leaf, and into its ancestors as far as they share a mover with it.

    Threads that meet in an ancestor write the same value, and each continues for its own movers.
    """
    before = pools.tets[e]
    tet = with_present_names(before, top, old_top, moves)
    moved = int(0)
    for n in range(4):
        if tet[n] != before[n]:
            moved = 1
    if moved == 1:
        pools.tets[e] = tet
        above = pools.parent[e]
        while above >= 0:
            whole = with_present_names(pools.tets[above], top, old_top, moves)
            names = int(0)
            for n in range(4):
                for m in range(4):
                    if tet[n] != before[n] and whole[m] == tet[n]:
                        names = 1
            if names == 1:
                pools.tets[above] = whole
                above = pools.parent[above]
            else:
                above = -1
    return tet


@wp.kernel(enable_backward=False)
def rename_void(
    # In
    threads: int,
    moves: Moves,
    # In and out
    pools: Pools,
):
    top = pools.counts[NODE_TOP]
    old_top = pools.counts[OLD_TOP]
    count = pools.void_count
    if moves.ends[threads - 1] == 0:
        count = 0
    for i in range(wp.tid(), count, threads):
        rename_upwards(pools.void_leaves[i], top, old_top, pools, moves)


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
