"""Removal of nodes, the reverse of bisection.

A node can be removed if all leaves that name it, live or void, are children that were made with it, and all are
marked: then their parents become leaves. Two children stay if only one is live, if their labels differ, or if their
parent would heal a cut.

Then nodes are numbered without gaps, and the tree order of the leaves is restored.

With N' nodes left, the holes are the places of removed nodes below N', and the movers are the nodes from N' on; their
numbers are equal. Each mover moves into a hole. Its number is changed in tetrahedra of all levels, and in the ends of
other nodes.

Each thread processes one stretch of the former list of leaves: a bisected leaf is replaced by its descendants, a merged
one by its parent. A sum over the threads gives the start of each.
"""

import warp as wp

from warp_corot.kernels.meshing.bisection import refinement_end
from warp_corot.kernels.meshing.growth import LIVE
from warp_corot.kernels.plan.plan import TORN

from .pools import (
    ADDED,
    CANDIDATES,
    FREE_PAIRS,
    LEAVES,
    NEW_LEAVES,
    NODE_TOP,
    NODES_GIVEN,
    OLD_TOP,
    PAIRS_GIVEN,
    REMOVED,
    SIMPLIFY,
    UNUSED,
    Carried,
    Pools,
    average_children,
    mass_changes,
    move_node,
    padding,
    unmake_node,
)

wp.set_module_options({"enable_backward": False})


@wp.struct
class Removal:
    """Nodes that some leaves could give up."""

    willing: wp.array[wp.int32]  # number of these leaves
    head: wp.array[wp.int32]  # their first parent, or -1
    candidates: wp.array[wp.int32]


@wp.func
def whole_cuts(first: int, second: int, end: int):
    """Which faces of a parent are cut, from its halves; -1 if the face between them is, or half of another one."""
    if first % 2 == 1:
        return -1
    whole = wp.lshift((first >> end) % 2, end) + (second >> end) % 2
    for n in range(1, 4):
        if n != end:
            half = (first >> n) % 2
            if half != (second >> wp.where(n < end, n - 1, n)) % 2:
                return -1
            whole += wp.lshift(half, n)
    return whole


@wp.func
def offer_node(i: int, min_level: int, kept: int, pools: Pools, carried: Carried, removal: Removal):
    """If this and the next leaf are a pair that may be merged, count them at the node that would be removed."""
    e = pools.leaves[i]
    if e < kept or (e - pools.roots) % 2 == 1 or pools.leaves[i + 1] != e + 1:
        return
    level = pools.level[e] - 1
    if level < min_level or pools.first_child[e] != LIVE or pools.first_child[e + 1] != LIVE:
        return
    if carried.label[e] != carried.label[e + 1]:
        return
    parent = pools.parent[e]
    end = refinement_end(level)
    if whole_cuts(pools.cut[e], pools.cut[e + 1], end) < 0 or (pools.cut[parent] & TORN) != 0:
        return
    z = pools.tets[e][end]
    before = wp.atomic_exch(removal.head, z, parent)
    pools.next[parent] = before
    wp.atomic_add(removal.willing, z, 2)
    if before < 0:
        removal.candidates[wp.atomic_add(pools.counts, CANDIDATES, 1)] = z


@wp.kernel(enable_backward=False)
def offer_nodes(
    # In
    threads: int,
    min_level: int,
    kept: int,  # tetrahedra with lower numbers stay
    carried: Carried,
    # In and out
    pools: Pools,
    removal: Removal,
):
    for i in range(wp.tid(), pools.counts[LEAVES] - 1, threads):
        if pools.marks[i] == SIMPLIFY and pools.marks[i + 1] == SIMPLIFY:
            offer_node(i, min_level, kept, pools, carried, removal)


@wp.func
def remove_node(z: int, pools: Pools, carried: Carried, removal: Removal):
    """Merge the pairs around a node, and pass on what they and the node carry."""
    ends = pools.ends[z]
    gain_a = wp.float64(0.0)
    gain_b = wp.float64(0.0)
    place = pools.counts[FREE_PAIRS] + wp.atomic_add(pools.counts, PAIRS_GIVEN, pools.valence[z] / 2)
    e = int(removal.head[z])
    while e >= 0:
        child = pools.first_child[e]
        level = pools.level[e]
        tet = pools.tets[e]
        end = refinement_end(level)
        average_children(e, child, carried)
        at_first, at_second = mass_changes(e, child, level, carried)
        if tet[0] == ends[0]:
            gain_a += at_first
            gain_b += at_second
        else:
            gain_a += at_second
            gain_b += at_first
        for n in range(1, 4):
            if n != end:
                wp.atomic_add(pools.valence, tet[n], -1)
        pools.cut[e] = whole_cuts(pools.cut[child], pools.cut[child + 1], end)
        pools.first_child[e] = LIVE
        # The parent's number stays, for the kernels that order the leaves.
        pools.level[child] = UNUSED
        pools.level[child + 1] = UNUSED
        pools.free_pairs[place] = child
        place += 1
        e = pools.next[e]
    pools.valence[z] = 0
    wp.atomic_add(pools.counts, NODES_GIVEN, 1)
    unmake_node(z, ends[0], ends[1], gain_a, gain_b, pools, carried)


@wp.kernel(enable_backward=False)
def remove_nodes(
    # In
    threads: int,
    # In and out
    pools: Pools,
    carried: Carried,
    removal: Removal,
):
    for i in range(wp.tid(), pools.counts[CANDIDATES], threads):
        z = removal.candidates[i]
        if removal.willing[z] == pools.valence[z]:
            remove_node(z, pools, carried, removal)
        removal.willing[z] = 0
        removal.head[z] = -1


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
