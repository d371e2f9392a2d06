"""Edges that must be bisected, "wanted" edges: a hash table, filled again in each pass, keyed by the edges' nodes.

An edge is bisected once it is the refinement edge of all leaves around it. If a leaf has a wanted edge that is
not its refinement edge, its refinement edge becomes wanted, too. So requests spread outwards to ever larger leaves,
bisection comes back inwards, and each bisection leaves the mesh conforming: it may stop at any time, for example when
the pools are full.
"""

import warp as wp

from warp_corot.kernels.meshing.bisection import refinement_end
from warp_corot.kernels.meshing.growth import EMPTY, LIVE, claim_slot, edge_key, find_slot
from warp_corot.kernels.tables.shapes import FIRST_NODE, SECOND_NODE

from .blocks import STRETCH, Blocks, heat_blocks, is_hot
from .pools import (
    BIRTHS,
    FIRST_NEW,
    FRESH,
    FRESH_NEW,
    FRESH_SEEN,
    FULL,
    LAST_BIRTHS,
    LEAVES,
    NODES_TAKEN,
    PAIRS_TAKEN,
    PASS_STAMP,
    REFINE,
    STAMP,
    WANTED,
    Pools,
)

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
    """Want an edge; returns whether it is new. Beyond the maximum it is left out: that loses a refinement, never
    conformity."""
    if pools.counts[WANTED] >= edges.most:
        wp.atomic_max(pools.counts, FULL, 1)
        return False
    slot = claim_slot(edge_key(a, b), edges.keys)
    if slot < 0:
        slot = -slot - 1
        edges.born[slot] = pools.counts[STAMP]
        pools.touched[a] = pools.counts[STAMP]
        pools.touched[b] = pools.counts[STAMP]
        edges.wanted[wp.atomic_add(pools.counts, WANTED, 1)] = slot
        wp.atomic_add(pools.counts, BIRTHS, 1)
        return True
    return False


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


@wp.kernel(enable_backward=False)
def heat_wanted(
    # In
    threads: int,
    pools: Pools,
    edges: WantedEdges,
    # In and out
    blocks: Blocks,
):
    """Mark blocks with the first wanted edges, once it is known which blocks name which nodes."""
    for i in range(wp.tid(), pools.counts[WANTED], threads):
        key = edges.keys[edges.wanted[i]]
        a = int(key >> wp.int64(32))
        b = int(key & LOW_HALF)
        heat_blocks(a, b, pools.counts[STAMP], pools.counts[FIRST_NEW], blocks)


@wp.kernel(enable_backward=False)
def begin_round(
    # In and out
    pools: Pools,
    demand: wp.array[wp.int64],
):
    counts = pools.counts
    counts[STAMP] = counts[STAMP] + 1
    counts[LAST_BIRTHS] = counts[BIRTHS]
    counts[BIRTHS] = 0
    counts[FRESH_SEEN] = counts[FRESH_NEW]
    counts[FRESH_NEW] = counts[FRESH]
    counts[NODES_TAKEN] = 0
    counts[PAIRS_TAKEN] = 0
    demand[0] = wp.int64(0)


@wp.func
def count_at_edges(e: int, tet: wp.vec4i, is_new: bool, pools: Pools, edges: WantedEdges, blocks: Blocks):
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
    if hangs == 1 and want_edge(tet[0], tet[end], pools, edges):
        heat_blocks(tet[0], tet[end], stamp, pools.counts[FIRST_NEW], blocks)


@wp.func
def visit_leaf(i: int, pools: Pools, edges: WantedEdges, blocks: Blocks):
    """Count a leaf at new wanted edges, if it has two recently touched nodes: often three nodes rule it out."""
    tet = pools.leaf_tets[i]
    since = pools.counts[STAMP] - 1
    near = int(0)
    for n in range(3):
        if pools.touched[tet[n]] >= since:
            near += 1
    if near == 1 and pools.touched[tet[3]] >= since:
        near = 2
    if near >= 2:
        e = pools.leaves[i]
        if pools.first_child[e] == LIVE:
            count_at_edges(e, tet, False, pools, edges, blocks)


@wp.kernel(enable_backward=False)
def visit_leaves(
    # In
    threads: int,
    # In and out
    pools: Pools,
    edges: WantedEdges,
    blocks: Blocks,
):
    """Visit the leaves from before the pass, if there is a new edge to count at."""
    count = (pools.counts[LEAVES] + STRETCH - 1) // STRETCH
    if pools.counts[LAST_BIRTHS] == 0:
        count = 0
    for stretch in range(wp.tid(), count, threads):
        first = stretch * STRETCH
        if is_hot(first, pools, blocks):
            for i in range(first, wp.min(first + STRETCH, pools.counts[LEAVES])):
                visit_leaf(i, pools, edges, blocks)


@wp.kernel(enable_backward=False)
def visit_fresh(
    # In
    threads: int,
    # In and out
    pools: Pools,
    edges: WantedEdges,
    blocks: Blocks,
):
    """Visit the leaves that this pass made."""
    for i in range(wp.tid(), 2 * pools.counts[FRESH_NEW], threads):
        e = pools.fresh[i // 2] + i % 2
        if pools.first_child[e] == LIVE:
            count_at_edges(e, pools.tets[e], i // 2 >= pools.counts[FRESH_SEEN], pools, edges, blocks)


@wp.kernel(enable_backward=False)
def clear_edges(
    # In
    threads: int,
    pools: Pools,
    # In and out
    edges: WantedEdges,
):
    for i in range(wp.tid(), pools.counts[WANTED], threads):
        slot = edges.wanted[i]
        edges.keys[slot] = EMPTY
        edges.born[slot] = NEVER
        edges.ring[slot] = 0
        edges.agreed[slot] = 0
        edges.head[slot] = -1
        edges.node[slot] = -1
