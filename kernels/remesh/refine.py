"""Edges that must be bisected, "wanted" edges: a hash table, filled again in each pass, keyed by the edges' nodes.

An edge is bisected once it is the refinement edge of all leaves around it. If a leaf has a wanted edge that is
not its refinement edge, its refinement edge becomes wanted, too. So requests spread outwards to ever larger leaves,
bisection comes back inwards, and each bisection leaves the mesh conforming: it may stop at any time, for example when
the pools are full."""

import warp as wp

from warp_corot.kernels.meshing.bisection import first_half, halfway, refinement_end, second_half
from warp_corot.kernels.meshing.growth import EMPTY, LIVE, claim_slot, edge_key, find_slot
from warp_corot.kernels.remesh.pools import (
    ADDED,
    BIRTHS,
    FREE_PAIRS,
    FRESH,
    FRESH_NEW,
    FRESH_SEEN,
    FULL,
    LAST_BIRTHS,
    LEAVES,
    NEW_LEAVES,
    NODE_TOP,
    NODES_TAKEN,
    PAIRS_TAKEN,
    PASS_STAMP,
    REFINE,
    REMOVED,
    STAMP,
    WANTED,
    Carried,
    Pools,
    copy_to_children,
    make_node,
    mass_changes,
)
from warp_corot.kernels.tables.shapes import FIRST_NODE, FRAME_SHIFT, SECOND_NODE

wp.set_module_options({"enable_backward": False})

NEVER = wp.constant(0x7FFFFFFF)
LOW_HALF = wp.constant(wp.int64((1 << 32) - 1))


@wp.struct
class WantedEdges:
    """The table: for each edge the leaves around it, counted in rounds."""

    keys: wp.array[wp.int64]
    born: wp.array[wp.int32]  # the round in which the edge became wanted; NEVER
    ring: wp.array[wp.int32]  # number of leaves around it
    agreed: wp.array[wp.int32]  # number of these whose refinement edge it is
    head: wp.array[wp.int32]  # the first of the latter, or -1
    node: wp.array[wp.int32]  # its midpoint after bisection, or -1
    pairs: wp.array[wp.int32]  # start of its pairs among those taken in a round
    wanted: wp.array[wp.int32]  # slots of all wanted edges
    most: int  # maximum number of wanted edges in a pass


@wp.func
def want_edge(a: int, b: int, pools: Pools, edges: WantedEdges):
    """Want an edge. Beyond the maximum it is left out: that loses a refinement, never conformity."""
    if pools.counts[WANTED] >= edges.most:
        wp.atomic_max(pools.counts, FULL, 1)
        return
    slot = claim_slot(edge_key(a, b), edges.keys)
    if slot < 0:
        slot = -slot - 1
        edges.born[slot] = pools.counts[STAMP]
        pools.touched[a] = pools.counts[STAMP]
        pools.touched[b] = pools.counts[STAMP]
        edges.wanted[wp.atomic_add(pools.counts, WANTED, 1)] = slot
        wp.atomic_add(pools.counts, BIRTHS, 1)


@wp.kernel(enable_backward=False)
def want_marked(
    # In
    threads: int,
    max_level: int,
    # In and out
    pools: Pools,
    edges: WantedEdges,
):
    """Want the refinement edges of marked leaves."""
    for i in range(wp.tid(), pools.counts[LEAVES], threads):
        if pools.marks[i] == REFINE:
            level = pools.level[pools.leaves[i]]
            if level < max_level:
                tet = pools.leaf_tets[i]
                want_edge(tet[0], tet[refinement_end(level)], pools, edges)


@wp.func
def count_at_edges(e: int, tet: wp.vec4i, is_new: bool, pools: Pools, edges: WantedEdges):
    """Count a leaf at its wanted edges, each once: an old leaf at those of the last round, a new one at all."""
    stamp = pools.counts[STAMP]
    since = stamp - 1
    if is_new:
        since = pools.counts[PASS_STAMP]
    end = refinement_end(pools.level[e])
    hangs = int(0)
    for n in range(6):
        a = tet[FIRST_NODE[n]]
        b = tet[SECOND_NODE[n]]
        if pools.touched[a] >= since and pools.touched[b] >= since:
            slot = find_slot(a, b, edges.keys)
            if slot >= 0:
                born = edges.born[slot]
                if born >= since and born < stamp:
                    wp.atomic_add(edges.ring, slot, 1)
                    if FIRST_NODE[n] == 0 and SECOND_NODE[n] == end:
                        pools.next[e] = wp.atomic_exch(edges.head, slot, e)
                        wp.atomic_add(edges.agreed, slot, 1)
                    else:
                        hangs = 1
    if hangs == 1:
        want_edge(tet[0], tet[end], pools, edges)


@wp.kernel(enable_backward=False)
def visit_leaves(
    # In
    threads: int,
    # In and out
    pools: Pools,
    edges: WantedEdges,
):
    """Count the leaves from before the pass at new wanted edges, if there are any: those with two recently touched
    nodes, which often three nodes rule out."""
    count = wp.where(pools.counts[LAST_BIRTHS] > 0, pools.counts[LEAVES], 0)
    since = pools.counts[STAMP] - 1
    for i in range(wp.tid(), count, threads):
        tet = pools.leaf_tets[i]
        near = int(0)
        for n in range(3):
            if pools.touched[tet[n]] >= since:
                near += 1
        if near == 1 and pools.touched[tet[3]] >= since:
            near = 2
        if near >= 2:
            e = pools.leaves[i]
            if pools.first_child[e] == LIVE:
                count_at_edges(e, tet, False, pools, edges)


@wp.kernel(enable_backward=False)
def visit_fresh(
    # In
    threads: int,
    # In and out
    pools: Pools,
    edges: WantedEdges,
):
    """Visit the leaves that this pass made."""
    for i in range(wp.tid(), 2 * pools.counts[FRESH_NEW], threads):
        e = pools.fresh[i // 2] + i % 2
        if pools.first_child[e] == LIVE:
            count_at_edges(e, pools.tets[e], i // 2 >= pools.counts[FRESH_SEEN], pools, edges)


# The upper half of ``demand`` counts nodes, the lower half pairs.
ONE_NODE = wp.constant(wp.int64(1 << 32))


@wp.kernel(enable_backward=False)
def admit_edges(
    # In
    threads: int,
    # In and out
    pools: Pools,
    edges: WantedEdges,
    demand: wp.array[wp.int64],
):
    """Reserve a node and pairs for each edge that can be bisected.

    One atomic sum of nodes and pairs gives every edge its places; edges whose places do not exist are refused, and
    since the sum only grows, so are all later ones.
    """
    for i in range(wp.tid(), pools.counts[WANTED], threads):
        slot = edges.wanted[i]
        ring = edges.ring[slot]
        if edges.node[slot] < 0 and edges.born[slot] < pools.counts[STAMP] and ring > 0 and ring == edges.agreed[slot]:
            before = wp.atomic_add(demand, 0, ONE_NODE + wp.int64(ring))
            nodes = int(before >> wp.int64(32))
            pairs = int(before & LOW_HALF)
            if pools.counts[NODE_TOP] + nodes < pools.node_limit and pairs + ring <= pools.counts[FREE_PAIRS]:
                edges.node[slot] = pools.counts[NODE_TOP] + nodes
                edges.pairs[slot] = pools.counts[FREE_PAIRS] - 1 - pairs
                wp.atomic_max(pools.counts, NODES_TAKEN, nodes + 1)
                wp.atomic_max(pools.counts, PAIRS_TAKEN, pairs + ring)
            else:
                wp.atomic_max(pools.counts, FULL, 1)


@wp.func
def leave_edges(tet: wp.vec4i, end: int, pools: Pools, edges: WantedEdges):
    """Remove a bisected leaf from the counts of its other wanted edges."""
    since = pools.counts[PASS_STAMP]
    for n in range(6):
        a = tet[FIRST_NODE[n]]
        b = tet[SECOND_NODE[n]]
        if (FIRST_NODE[n] != 0 or SECOND_NODE[n] != end) and pools.touched[a] >= since and pools.touched[b] >= since:
            slot = find_slot(a, b, edges.keys)
            if slot >= 0 and edges.born[slot] < pools.counts[STAMP]:
                wp.atomic_add(edges.ring, slot, -1)


@wp.func
def halved_cuts(cut: int, end: int):
    """Which faces of the two halves of a leaf are cut; the face between them is not."""
    first = int(0)
    second = int(0)
    for n in range(1, 4):
        if n != end and (cut >> n) % 2 == 1:
            first += wp.lshift(1, n)
            second += wp.lshift(1, wp.where(n < end, n - 1, n))
    first += wp.lshift((cut >> end) % 2, end)
    second += wp.lshift(cut % 2, end)
    return first, second


@wp.func
def bisect_leaf(e: int, child: int, z: int, pools: Pools, edges: WantedEdges):
    tet = pools.tets[e]
    level = pools.level[e]
    end = refinement_end(level)
    leave_edges(tet, end, pools, edges)
    pools.tets[child] = first_half(tet, z, level)
    pools.tets[child + 1] = second_half(tet, z, level)
    frame = pools.code[e] >> FRAME_SHIFT
    for n in range(2):
        pools.code[child + n] = pools.child_code[frame, level % 3, n] | (level + 1)
        pools.level[child + n] = level + 1
        pools.parent[child + n] = e
        pools.first_child[child + n] = LIVE
    first_cut, second_cut = halved_cuts(pools.cut[e], end)
    pools.cut[child] = first_cut
    pools.cut[child + 1] = second_cut
    pools.first_child[e] = child
    for n in range(1, 4):
        if n != end:
            wp.atomic_add(pools.valence, tet[n], 1)


@wp.func
def bisect_edge(slot: int, pools: Pools, edges: WantedEdges, carried: Carried):
    """Bisect the leaves around an edge and pass on what they and its ends carry."""
    z = edges.node[slot]
    first = edges.head[slot]
    ring = edges.ring[slot]
    tet = pools.tets[first]
    a = tet[0]
    b = tet[refinement_end(pools.level[first])]
    loss_a = wp.float64(0.0)
    loss_b = wp.float64(0.0)
    place = wp.atomic_add(pools.counts, FRESH, ring)
    e = int(first)
    for i in range(ring):
        following = pools.next[e]
        child = pools.free_pairs[edges.pairs[slot] - i]
        level = pools.level[e]
        bisect_leaf(e, child, z, pools, edges)
        copy_to_children(e, child, carried)
        at_first, at_second = mass_changes(e, child, level, carried)
        if pools.tets[e][0] == a:
            loss_a += at_first
            loss_b += at_second
        else:
            loss_a += at_second
            loss_b += at_first
        pools.fresh[place + i] = child
        e = following
    pools.ends[z] = wp.vec2i(wp.min(a, b), wp.max(a, b))
    pools.lattice[z] = halfway(pools.lattice[a], pools.lattice[b])
    pools.valence[z] = 2 * ring
    make_node(z, a, b, pools.lattice[z], loss_a, loss_b, carried)
    # Its ring is bisected: no leaf counts at it any more.
    edges.ring[slot] = 0
    edges.agreed[slot] = 0


@wp.kernel(enable_backward=False)
def bisect_edges(
    # In
    threads: int,
    # In and out
    pools: Pools,
    edges: WantedEdges,
    carried: Carried,
):
    for i in range(wp.tid(), pools.counts[WANTED], threads):
        slot = edges.wanted[i]
        if edges.node[slot] >= 0 and edges.agreed[slot] > 0:
            bisect_edge(slot, pools, edges, carried)


@wp.kernel(enable_backward=False)
def next_round(
    # In and out
    pools: Pools,
    demand: wp.array[wp.int64],
    # Out
    goes_on: wp.array[wp.int32],
):
    """End a round, if there was one, and begin the next."""
    counts = pools.counts
    counts[NODE_TOP] = counts[NODE_TOP] + counts[NODES_TAKEN]
    counts[FREE_PAIRS] = counts[FREE_PAIRS] - counts[PAIRS_TAKEN]
    counts[ADDED] = counts[ADDED] + counts[NODES_TAKEN]
    goes_on[0] = wp.where(counts[BIRTHS] + counts[NODES_TAKEN] > 0, 1, 0)
    counts[STAMP] = counts[STAMP] + 1
    counts[LAST_BIRTHS] = counts[BIRTHS]
    counts[BIRTHS] = 0
    counts[FRESH_SEEN] = counts[FRESH_NEW]
    counts[FRESH_NEW] = counts[FRESH]
    counts[NODES_TAKEN] = 0
    counts[PAIRS_TAKEN] = 0
    demand[0] = wp.int64(0)


@wp.kernel(enable_backward=False)
def end_pass(
    # In
    threads: int,
    # In and out
    pools: Pools,
    edges: WantedEdges,
    moved: wp.array[wp.int32],
):
    """Clear the table of edges and the counts of moved nodes, and adopt the number of leaves."""
    for i in range(wp.tid(), pools.counts[WANTED], threads):
        slot = edges.wanted[i]
        edges.keys[slot] = EMPTY
        edges.born[slot] = NEVER
        edges.ring[slot] = 0
        edges.agreed[slot] = 0
        edges.head[slot] = -1
        edges.node[slot] = -1
    if wp.tid() == 0:
        moved[0] = 0
        moved[1] = 0
        if pools.counts[ADDED] + pools.counts[REMOVED] > 0:
            pools.counts[LEAVES] = pools.counts[NEW_LEAVES]
