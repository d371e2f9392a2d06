"""Neighbouring nodes of each level, and the contributions to each entry of its matrix, also of shared dilatations.

An entry in the upper triangle, or on the diagonal, is a sum of contributions: of leaves on the finest level, of the
next finer level's entries on the others (Galerkin). Contributions are listed with their pair of ranks as a key, and
sorted.

A group of elements that share their dilatation adds r r^T with the rows r of ``elements.mean_dilatation_rows``, so each
pair of its nodes contributes to an entry. Rows belong to the present state, because lambda may be thousands of times
mu. Smoothing takes the diagonal with the weights of groups, and so keeps its bound. On coarser levels, where most
groups have four nodes and few have more, ``bound_diagonal`` keeps it.
"""

import functools

import warp as wp

from warp_corot.kernels.elements.dilatation import Dilatation
from warp_corot.kernels.elements.elements import ForestElements, nodal_forces, rest_volume
from warp_corot.kernels.elements.forces import in_local_frame, own_gradient
from warp_corot.kernels.elements.mean_dilatation_rows import GroupNodes, first_entry, kept_share  # noqa: F401
from warp_corot.kernels.elements.simd8 import law_kernel

from .cycle import LevelArrays

wp.set_module_options({"enable_backward": False})


@wp.struct
class EntrySums:
    """The contributions to the entries of a matrix; the host's ``Pattern`` explains the arrays."""

    upper: wp.array[wp.vec2i]
    starts: wp.array[wp.int32]
    codes: wp.array[wp.int32]
    places: wp.array[wp.vec2i]


@wp.func
def key_of(i: int, j: int, bits: int):
    return (wp.int64(i) << wp.int64(bits)) | wp.int64(j)


@wp.func
def pair_of(key: wp.int64, bits: int):
    return wp.vec2i(int(key >> wp.int64(bits)), int(key & ((wp.int64(1) << wp.int64(bits)) - wp.int64(1))))


@wp.func
def place_of(i: int, j: int, starts: wp.array[wp.int32], columns: wp.array[wp.int32]):
    """The place of an entry in its row, or -1."""
    p = wp.lower_bound(columns, starts[i], starts[i + 1] + 1, j)
    # Past the end nothing may be read.
    if p == starts[i + 1] or columns[wp.min(p, starts[i + 1] - 1)] != j:
        p = int(-1)
    return p


@wp.func
def parents(i: int, coarse: int, ends: wp.array[wp.vec2i]):
    """The node itself and -1 if it is among the first ``coarse`` ones; otherwise the ends of its edge."""
    if i < coarse:
        return wp.vec2i(i, -1)
    return ends[i]


@wp.kernel(enable_backward=False)
def flag_first(
    # In
    keys: wp.array[wp.int64],
    # Out
    flags: wp.array[wp.int32],
):
    """Flag the first of equal keys."""
    i = wp.tid()
    flags[i] = 1
    if i > 0 and keys[i - 1] == keys[i]:
        flags[i] = 0


@wp.kernel(enable_backward=False)
def gather_flagged(
    # In
    flags: wp.array[wp.int32],
    places: wp.array[wp.int32],
    # Out
    chosen: wp.array[wp.int32],
):
    """Indices of flagged entries, in order; ``places`` is the inclusive sum of the flags."""
    i = wp.tid()
    if flags[i] != 0:
        chosen[places[i] - 1] = i


@wp.kernel(enable_backward=False)
def find_ranks(
    # In
    nodes: wp.array[wp.int32],
    # Out
    rank: wp.array[wp.int32],
):
    i = wp.tid()
    rank[nodes[i]] = i


@wp.kernel(enable_backward=False)
def rank_ends(
    # In
    by_number: wp.array[wp.vec2i],
    rank: wp.array[wp.int32],
    # Out
    ends: wp.array[wp.vec2i],
):
    i = wp.tid()
    pair = by_number[i]
    if pair[0] < 0:
        ends[i] = pair
    else:
        ends[i] = wp.vec2i(rank[pair[0]], rank[pair[1]])


@wp.kernel(enable_backward=False)
def list_leaf_pairs(
    # In
    bits: int,
    tets: wp.array[wp.vec4i],
    rank: wp.array[wp.int32],
    # Out
    keys: wp.array[wp.int64],
    codes: wp.array[wp.int32],
):
    """List the six pairs of nodes of each leaf; a code is 16 times the leaf, plus 4 times the place in it of the node
    with the lower rank, plus the other node's place.
    """
    t = wp.tid()
    at = int(6 * t)
    for m in range(3):
        for n in range(m + 1, 4):
            i = rank[tets[t][m]]
            j = rank[tets[t][n]]
            if i < j:
                keys[at] = key_of(i, j, bits)
                codes[at] = 16 * t + 4 * m + n
            else:
                keys[at] = key_of(j, i, bits)
                codes[at] = 16 * t + 4 * n + m
            at += 1


@wp.kernel(enable_backward=False)
def list_diagonal(
    # In
    first: int,
    bits: int,
    # Out
    keys: wp.array[wp.int64],
    codes: wp.array[wp.int32],
):
    """List a diagonal entry for each node, also for nodes of no leaf, after ``first`` other entries."""
    i = wp.tid()
    keys[first + i] = key_of(i, i, bits)
    codes[first + i] = -1


@wp.kernel(enable_backward=False)
def count_products(
    # In
    coarse: int,
    pairs: wp.array[wp.vec2i],
    ends: wp.array[wp.vec2i],
    # Out
    counts: wp.array[wp.int32],
):
    """Count the entries of the coarser level's upper triangle to which each entry contributes."""
    p = wp.tid()
    first = parents(pairs[p][0], coarse, ends)
    second = parents(pairs[p][1], coarse, ends)
    count = int(0)
    for a in range(2):
        for b in range(2):
            if first[a] >= 0 and second[b] >= first[a]:
                count += 1
    counts[p] = count


@wp.kernel(enable_backward=False)
def list_products(
    # In
    coarse: int,
    bits: int,
    pairs: wp.array[wp.vec2i],
    ends: wp.array[wp.vec2i],
    sums: wp.array[wp.int32],
    # Out
    keys: wp.array[wp.int64],
    codes: wp.array[wp.int32],
):
    """List each contribution's key and code: 4 times the entry plus the number of times it is halved. ``sums`` are the
    inclusive sums of the counts.
    """
    p = wp.tid()
    first = parents(pairs[p][0], coarse, ends)
    second = parents(pairs[p][1], coarse, ends)
    halvings = wp.where(first[1] >= 0, 1, 0) + wp.where(second[1] >= 0, 1, 0)
    at = int(0)
    if p > 0:
        at = sums[p - 1]
    for a in range(2):
        for b in range(2):
            if first[a] >= 0 and second[b] >= first[a]:
                keys[at] = key_of(first[a], second[b], bits)
                codes[at] = 4 * p + halvings
                at += 1


@wp.kernel(enable_backward=False)
def name_upper(
    # In
    count: int,
    bits: int,
    keys: wp.array[wp.int64],
    starts: wp.array[wp.int32],
    # Out
    upper: wp.array[wp.vec2i],
    full_keys: wp.array[wp.int64],
    sources: wp.array[wp.int32],
):
    """Write each upper entry's pair, and the keys of the entry and its mirror image. A diagonal entry has none; its
    second key gets row ``count``, past all rows.
    """
    u = wp.tid()
    pair = pair_of(keys[starts[u]], bits)
    upper[u] = pair
    full_keys[2 * u] = key_of(pair[0], pair[1], bits)
    sources[2 * u] = 2 * u
    sources[2 * u + 1] = 2 * u + 1
    full_keys[2 * u + 1] = key_of(pair[1], pair[0], bits)
    if pair[0] == pair[1]:
        full_keys[2 * u + 1] = key_of(count, count, bits)


@wp.kernel(enable_backward=False)
def name_entries(
    # In
    bits: int,
    keys: wp.array[wp.int64],
    sources: wp.array[wp.int32],
    # Out
    pairs: wp.array[wp.vec2i],
    columns: wp.array[wp.int32],
    diagonal: wp.array[wp.int32],
    places: wp.array[wp.int32],
):
    """Write the sorted entries; ``places`` are the positions of each upper entry and its mirror image among them."""
    p = wp.tid()
    pair = pair_of(keys[p], bits)
    pairs[p] = pair
    columns[p] = pair[1]
    places[sources[p]] = p
    if pair[0] == pair[1]:
        diagonal[pair[0]] = p
        places[sources[p] + 1] = p


@wp.kernel(enable_backward=False)
def find_row_starts(
    # In
    count: int,
    bits: int,
    keys: wp.array[wp.int64],
    # Out
    starts: wp.array[wp.int32],
):
    """Find the position among ``count`` sorted keys at which each row begins, and at which the last one ends."""
    row = wp.tid()
    # Warp's function gives no place past the last one that it is given, and does not read that one.
    starts[row] = wp.lower_bound(keys, 0, count + 1, key_of(row, 0, bits))


@wp.kernel(enable_backward=False)
def list_midpoints(
    # In
    coarse: int,
    bits: int,
    ends: wp.array[wp.vec2i],
    # Out
    keys: wp.array[wp.int64],
    midpoints: wp.array[wp.int32],
):
    """List the nodes past the first ``coarse`` ones, once with each end of their edge."""
    i = wp.tid()
    node = coarse + i
    for n in range(2):
        keys[2 * i + n] = key_of(ends[node][n], node, bits)
        midpoints[2 * i + n] = node


@wp.kernel(enable_backward=False)
def count_pairs(groups: GroupNodes, counts: wp.array[wp.int32]):
    """Count the pairs of a group's nodes, including each node with itself."""
    g = wp.tid()
    nodes = groups.ends[g] - first_entry(groups.ends, g)
    counts[g] = nodes * (nodes + 1) / 2


@wp.kernel(enable_backward=False)
def list_pairs(
    # In
    first: int,
    bits: int,
    groups: GroupNodes,
    rank: wp.array[wp.int32],
    sums: wp.array[wp.int32],
    # Out
    pairs: wp.array[wp.vec2i],
    keys: wp.array[wp.int64],
    codes: wp.array[wp.int32],
):
    """List each pair's places in the rows, that of the lower rank first; its key; and its code, -2 minus its number.
    ``first`` keys come before.
    """
    g = wp.tid()
    at = first_entry(sums, g)
    for k in range(first_entry(groups.ends, g), groups.ends[g]):
        for m in range(k, groups.ends[g]):
            i = rank[groups.nodes[k]]
            j = rank[groups.nodes[m]]
            if i <= j:
                pairs[at] = wp.vec2i(k, m)
                keys[first + at] = key_of(i, j, bits)
            else:
                pairs[at] = wp.vec2i(m, k)
                keys[first + at] = key_of(j, i, bits)
            codes[first + at] = -2 - at
            at += 1


@functools.cache
def add_held_blocks(of: Dilatation) -> wp.Kernel:
    """Add the stiffness of elements that are held from turning over, off the diagonal; see ``elements.dilatation``."""
    measure, holding = of.measure, of.holding

    @law_kernel()
    def add_held_blocks(
        # In
        world_elements: int,
        count: int,
        entries: int,
        elements: ForestElements,
        u: wp.array[wp.vec4],
        lam: wp.array[float],
        stride: int,
        scales: wp.array[float],
        rank: wp.array[wp.int32],
        starts: wp.array[wp.int32],
        columns: wp.array[wp.int32],
        # In and out
        blocks: wp.array[wp.mat33],
    ):
        t = wp.tid()
        theta, slope = measure(own_gradient(elements, t, u))
        curvature = holding(theta)[2]
        if curvature == 0.0:
            return
        world = t / world_elements
        f0, f1, f2, f3 = nodal_forces(elements, t, in_local_frame(elements, t, slope))
        f = wp.matrix_from_rows(f0, f1, f2, f3)
        factor = scales[2] * curvature * lam[t * stride] / rest_volume(elements, t)
        nodes = elements.nodes[t]
        for m in range(4):
            i = rank[nodes[m] - world * count]
            for n in range(4):
                if n != m:
                    j = rank[nodes[n] - world * count]
                    k = place_of(i, j, starts, columns)
                    if k >= 0:
                        wp.atomic_add(blocks, world * entries + k, factor * wp.outer(f[n], f[m]))

    return add_held_blocks


@wp.kernel(enable_backward=False)
def bound_diagonal(level: LevelArrays, given: wp.array[wp.mat33]):
    """Find the inverses of diagonal blocks, and divide each by a quarter of its row's sum of |D^-1/2 A D^-1/2| if that
    is more than one. Then A is at most 4 D, because 4 D - A is diagonally dominant.
    """
    world, i = wp.tid()
    first = world * level.count
    own = given[first + i]
    sum = float(0.0)
    for p in range(level.rows.starts[i], level.rows.starts[i + 1]):
        block = wp.transpose(level.rows.blocks[world * level.entries + p])
        sum += wp.sqrt(wp.max(wp.ddot(own * block, block * given[first + level.rows.columns[p]]), 0.0))
    level.inverses[first + i] = own / wp.max(0.25 * sum, 1.0)
