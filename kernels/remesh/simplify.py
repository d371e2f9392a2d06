"""Removal of nodes, the reverse of bisection.

A node can be removed if all leaves that name it, live or void, are children that were made with it, and all are
marked: then their parents become leaves. Two children stay if only one is live, if their labels differ, or if their
parent would heal a cut.
"""

import warp as wp

from warp_corot.kernels.meshing.bisection import refinement_end
from warp_corot.kernels.meshing.growth import LIVE
from warp_corot.kernels.plan.plan import TORN

from .pools import (
    CANDIDATES,
    FREE_PAIRS,
    LEAVES,
    NODES_GIVEN,
    PAIRS_GIVEN,
    SIMPLIFY,
    UNUSED,
    Carried,
    Pools,
    average_children,
    mass_changes,
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
