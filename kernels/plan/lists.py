"""The leaves in complete subtrees, and the others: the lists of a derived plan (``plan``).

Leaves are in tree order, so the leaves of a subtree are contiguous: eight leaves of one level are a subtree if the
first and the last have the same ancestor three levels up. Likewise 64 leaves under an ancestor six levels up
are a group (see ``tables.subtree``). Subtrees are divided into classes; one launch can compute a
class.

Each thread processes one stretch of the leaves, marks what each leaf begins and counts; sums over the threads give
the start of its lists, which are thus in tree order for any number of threads.
"""

import warp as wp

from warp_corot.kernels.remesh.pools import LEAVES, Pools

from .plan import Plan, above, flat_row, level_of
from .units import begins_unit, unit_of

#: Maximum number of classes: three shapes with own rotations, one with its root's, three with one from further up; on
#: CUDA each in groups, then one by one.
CLASSES = wp.constant(14)
# Lower bits of a leaf's mark, if they are not the class of the subtree that it begins.
FLAT = wp.constant(14)
COVERED = wp.constant(15)
MARK_BITS = wp.constant(15)
FIRST_OF_UNIT = wp.constant(16)

LEAVES_OF_SUBTREE = 8
LEAVES_OF_GROUP = 64

places_t = wp.types.vector(length=16, dtype=wp.int32)


@wp.func
def place_in_subtree(e: int, pools: Pools):
    """The index, in tree order, of a tetrahedron among the eight descendants three levels below its ancestor."""
    p = pools.parent[e]
    q = pools.parent[p]
    return (e - pools.roots) % 2 + 2 * ((p - pools.roots) % 2) + 4 * ((q - pools.roots) % 2)


@wp.func
def kind_of(level: int, plan: Plan):
    """Shape and sharing of subtrees with leaves of a level; -1 if leaves use rotations of different elements."""
    shape = level % 3
    if plan.rotation_level < 0 or level <= plan.rotation_level:
        return shape
    if level - 3 == plan.rotation_level:
        return 3
    if level - 3 > plan.rotation_level:
        return 4 + shape
    return -1


@wp.func
def complete(i: int, size: int, depth: int, pools: Pools, plan: Plan):
    """The tetrahedron ``depth`` levels up whose descendants at their level are leaf i and the next ones, ``size`` in
    all; -1 if they are not."""
    if i < 0 or i + size > pools.counts[LEAVES]:
        return -1
    level = level_of(i, plan)
    if level < depth or level_of(i + size - 1, plan) != level:
        return -1
    for n in range(1, size - 1):
        if level_of(i + n, plan) != level:
            return -1
    root = above(pools.leaves[i], depth, pools)
    if above(pools.leaves[i + size - 1], depth, pools) != root:
        return -1
    return root


@wp.func
def class_at(i: int, pools: Pools, plan: Plan):
    """The class of the subtree that begins at leaf i; -1 if none does."""
    e = pools.leaves[i]
    if plan.with_subtrees == 0 or e < pools.roots or (e - pools.roots) % 2 == 1:
        return -1
    level = level_of(i, plan)
    kind = kind_of(level, plan)
    if kind < 0:
        return -1
    root = complete(i, LEAVES_OF_SUBTREE, 3, pools, plan)
    if root < 0:
        return -1
    if plan.members == 1:
        return kind
    if level >= 6:
        start = i - LEAVES_OF_SUBTREE * place_in_subtree(root, pools)
        if complete(start, LEAVES_OF_GROUP, 6, pools, plan) >= 0:
            return 2 * kind
    return 2 * kind + 1


@wp.func
def covered_from(i: int, pools: Pools, plan: Plan):
    """Number of leaves from the i-th on that belong to a subtree that begins before it."""
    if level_of(i, plan) < 3:
        return 0
    place = place_in_subtree(pools.leaves[i], pools)
    if place == 0 or place > i:
        return 0
    if class_at(i - place, pools, plan) < 0:
        return 0
    return LEAVES_OF_SUBTREE - place


@wp.kernel(enable_backward=False)
def mark_leaves(
    # In
    threads: int,
    pools: Pools,
    # In and out
    plan: Plan,
    # Out
    sums: wp.array[wp.int32],
):
    """Mark what each leaf begins, and count everything in each thread's stretch, [classes + 2, threads]."""
    t = wp.tid()
    totals = places_t()
    if plan.goes[0] != 0:
        leaves = pools.counts[LEAVES]
        stretch = (leaves + threads - 1) / threads
        begin = t * stretch
        end = wp.min(begin + stretch, leaves)
        if begin < end:
            i = int(begin)
            inside = covered_from(begin, pools, plan)
            while i < end:
                at = int(FLAT)
                size = int(1)
                if i == begin and inside > 0:
                    at = int(COVERED)
                    size = inside
                else:
                    found = class_at(i, pools, plan)
                    if found >= 0:
                        at = found
                        size = LEAVES_OF_SUBTREE
                        totals[found] += 1
                    else:
                        totals[flat_row(plan)] += 1
                shared = size > 1 and level_of(i, plan) > plan.rotation_level
                for n in range(wp.min(size, end - i)):
                    mark = int(at)
                    if n > 0:
                        mark = int(COVERED)
                    # A subtree that shares its rotation belongs to one unit.
                    new = bool(False)
                    if not shared or (n == 0 and at != COVERED):
                        new = begins_unit(i + n, pools, plan)
                    if new:
                        mark += FIRST_OF_UNIT
                        totals[flat_row(plan) + 1] += 1
                    plan.marks[i + n] = wp.int8(mark)
                i += size
    for row in range(plan.classes + 2):
        sums[row * threads + t] = totals[row]


@wp.kernel(enable_backward=False)
def list_leaves(
    # In
    threads: int,
    pools: Pools,
    ends: wp.array[wp.int32],
    # In and out
    plan: Plan,
):
    """Write the lists and the counts; ``ends`` are inclusive sums."""
    t = wp.tid()
    if plan.goes[0] != 0:
        leaves = pools.counts[LEAVES]
        stretch = (leaves + threads - 1) / threads
        places = places_t()
        for row in range(plan.classes + 2):
            at = row * threads + t
            before = int(0)
            if at > 0:
                before = ends[at - 1]
            if row > 0:
                before -= ends[row * threads - 1]
            places[row] = before
        unit_row = flat_row(plan) + 1
        for i in range(t * stretch, wp.min((t + 1) * stretch, leaves)):
            mark = int(plan.marks[i])
            at = mark & MARK_BITS
            if at < CLASSES:
                plan.first[at, places[at]] = i
                places[at] += 1
            elif at == FLAT:
                plan.flat[places[flat_row(plan)]] = i
                places[flat_row(plan)] += 1
            if plan.rotation_level >= 0:
                if mark >= FIRST_OF_UNIT:
                    # Offset by one: the first place is padding.
                    places[unit_row] += 1
                    e = unit_of(pools.leaves[i], pools, plan)
                    plan.unit_nodes[places[unit_row]] = pools.tets[e]
                    plan.unit_code[places[unit_row]] = pools.code[e]
                plan.unit[i] = places[unit_row]
        if t == threads - 1:
            for row in range(plan.classes + 2):
                plan.counts[row] = places[row]
