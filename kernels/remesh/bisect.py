"""Bisection of the edges that are the refinement edges of all leaves around them, as far as the pools allow."""

import warp as wp

from warp_corot.kernels.meshing.bisection import first_half, halfway, refinement_end, second_half
from warp_corot.kernels.meshing.growth import LIVE, find_slot
from warp_corot.kernels.tables.shapes import FIRST_NODE, FRAME_SHIFT, SECOND_NODE

from .edges import LOW_HALF, WantedEdges
from .pools import (
    ADDED,
    BIRTHS,
    FREE_PAIRS,
    FRESH,
    FULL,
    NODE_TOP,
    NODES_TAKEN,
    PAIRS_TAKEN,
    PASS_STAMP,
    STAMP,
    WANTED,
    Pools,
)
from .state import Carried, copy_to_children, make_node, quarter_mass

wp.set_module_options({"enable_backward": False})

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
        whole = quarter_mass(e, level, carried)
        at_first = whole - quarter_mass(child, level + 1, carried)
        at_second = whole - quarter_mass(child + 1, level + 1, carried)
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
def end_round(
    # In and out
    pools: Pools,
    # Out
    goes_on: wp.array[wp.int32],
):
    counts = pools.counts
    counts[NODE_TOP] = counts[NODE_TOP] + counts[NODES_TAKEN]
    counts[FREE_PAIRS] = counts[FREE_PAIRS] - counts[PAIRS_TAKEN]
    counts[ADDED] = counts[ADDED] + counts[NODES_TAKEN]
    goes_on[0] = wp.where(counts[BIRTHS] + counts[NODES_TAKEN] > 0, 1, 0)


@wp.kernel(enable_backward=False)
def begin_rounds(
    # In
    pools: Pools,
    # Out
    goes_on: wp.array[wp.int32],
):
    goes_on[0] = wp.where(pools.counts[BIRTHS] > 0, 1, 0)
