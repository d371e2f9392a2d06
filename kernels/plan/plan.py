"""A force plan: its arrays, and what its kernels share; the leaves of a forest and the tetrahedra above them.

``batches`` writes the arrays that launches read, and ``slots`` numbers places for forces. A forest that stays as it is
gets arrays of exact sizes, for all worlds; one that changes (``changing``) gets arrays for its capacity.

A forest that changes is in pools, any other in a tree; both are read in place. If all leaves have one level, nothing
above them is stored: the elements of a level are then numbered in tree order, each level from zero.

Leaves are in tree order, so the leaves of a subtree are contiguous: eight leaves of one level are a subtree if the
first and the last have the same ancestor three levels up, unless a cut goes through it. Likewise 64 leaves under an
ancestor six levels up are a group (see ``tables.subtree``). Subtrees are divided into classes; one launch can compute a
class.

Each thread processes one stretch of the leaves, marks what each leaf begins and counts; sums over the threads give
the start of its lists, which are thus in tree order for any number of threads.

Units are the elements whose rotations are found if leaves share them: a unit is the highest tetrahedron above a leaf
that is not above the rotation level and whose corners are nodes. The leaves of a unit are contiguous."""

import warp as wp

from warp_corot.kernels.elements.elements import LEVEL_MASK
from warp_corot.kernels.tables.shapes import FRAME_SHIFT

wp.set_module_options({"enable_backward": False})

#: Number of places past the last node that padding names in turn, so that additions to them seldom collide.
SINKS = wp.constant(1024)
#: Bits of ``Tree.cut`` and ``Pools.cut``: n of a leaf for its face opposite to node n; this one of an element whose
#: leaves do not agree on the nodes that they share.
TORN = wp.constant(16)


@wp.struct
class Tree:
    """The leaves in tree order, and the tetrahedra above them."""

    leaf_count: wp.array[wp.int32]  # [1]
    node_count: wp.array[wp.int32]  # [1] nodes that leaves name: all lower numbers
    named: int  # 1: leaves name all nodes
    leaf_tets: wp.array[wp.vec4i]  # nodes of the leaves in Maubach order
    uniform: int  # 1: all leaves have one level; the arrays of elements are empty then, and roots is zero
    roots: int  # roots come first, then pairs of children
    leaves: wp.array[wp.int32]  # the leaves' places among the elements
    # Elements: parents, and nodes in Maubach order.
    parent: wp.array[wp.int32]
    tets: wp.array[wp.vec4i]
    cut: wp.array[wp.int32]  # as ``Pools.cut``; empty if nothing was ever cut
    # In a uniform tree, for the corners of a unit: the leaf counted from its first one, and the leaf's node.
    corner_leaves: wp.vec4i
    corner_nodes: wp.vec4i
    # Codes without level of the parent of an element, by the element's frame and type, and first or second child.
    parent_code: wp.array3d[wp.int32]
    # What padding has: a first node, and a code.
    sink: int
    padding_code: int


@wp.func
def sink(i: int, tree: Tree):
    """The node of the i-th padding entry."""
    return tree.sink + i % SINKS


@wp.func
def padding(i: int, tree: Tree):
    """The nodes of the i-th padding entry."""
    node = sink(i, tree)
    return wp.vec4i(node, node, node, node)


@wp.func
def element_of(i: int, tree: Tree):
    """The element that is leaf i."""
    if tree.uniform != 0:
        return i
    return tree.leaves[i]


@wp.func
def parent_of(e: int, tree: Tree):
    if tree.uniform != 0:
        return e >> 1
    return tree.parent[e]


@wp.func
def above(e: int, steps: int, tree: Tree):
    """The ancestor so many levels up."""
    if tree.uniform != 0:
        return e >> steps
    found = int(e)
    for _ in range(steps):
        found = tree.parent[found]
    return found


@wp.func
def is_torn(e: int, tree: Tree):
    """Whether the leaves below an element do not agree on the nodes that they share, because of a cut."""
    if tree.cut.shape[0] == 0:
        return False
    return tree.cut[e] >= TORN


@wp.func
def which_child(e: int, tree: Tree):
    """0 for the first child of a parent, 1 for the second."""
    return (e - tree.roots) & 1


@wp.func
def code_above(code: int, which: int, tree: Tree):
    """The code of the parent of an element with a code, its first or second child."""
    level = code & LEVEL_MASK
    return tree.parent_code[code >> FRAME_SHIFT, level % 3, which] | (level - 1)


places_t = wp.types.vector(length=16, dtype=wp.int32)


@wp.struct
class Plan:
    """The derived arrays; those for the capacity have padding beyond the current size."""

    rotation_level: int  # -1: rotations are not shared
    with_subtrees: int  # 0: all leaves are computed one by one
    with_units: int  # 0: units are counted, but not listed
    members: int  # 2: groups and single subtrees; 1: there are no groups
    classes: int
    # Copies of the body, and the numbers of nodes, leaves and units in each.
    worlds: int
    world_nodes: int
    world_leaves: int
    world_units: int
    # Numbers for each class, for leaves in none, for units and for leaves; and the former numbers.
    counts: wp.array[wp.int32]
    before: wp.array[wp.int32]
    stale: wp.array[wp.int32]  # [1] nonzero: derive it even if the last pass changed nothing
    goes: wp.array[wp.int32]  # [1] whether it is derived at all
    # Leaves.
    code: wp.array[wp.int32]
    values: wp.array2d[wp.float32]  # [names, leaves]
    marks: wp.array[wp.int8]
    unit: wp.array[wp.int32]
    # First leaves of the subtrees, class after class, and the leaves in none.
    begin: places_t  # of each class
    first: wp.array[wp.int32]
    flat: wp.array[wp.int32]
    # Units. Where leaves may be padding the first place is padding for them, and units are counted from 1.
    first_unit: int
    unit_nodes: wp.array[wp.vec4i]
    unit_code: wp.array[wp.int32]


@wp.func
def flat_row(plan: Plan):
    """The row that counts leaves in no subtree; the next one counts units, then all leaves."""
    return plan.classes


@wp.func
def leaf_row(plan: Plan):
    """The row that counts all leaves."""
    return plan.classes + 2


@wp.func
def extent(row: int, plan: Plan):
    """Number of written places in a row, padding included; of one world."""
    if plan.goes[0] == 0:
        return 0
    return wp.max(plan.counts[row], plan.before[row])


@wp.func
def level_of(i: int, plan: Plan):
    return plan.code[i] & LEVEL_MASK


@wp.func
def on_nodes(e: int, tree: Tree):
    """Whether all corners are nodes of leaves, the same of all: not on the rim of a domain's mesh, nor at a cut."""
    if is_torn(e, tree):
        return False
    if tree.named != 0:
        return True
    tet = tree.tets[e]
    return wp.max(wp.max(tet[0], tet[1]), wp.max(tet[2], tet[3])) < tree.node_count[0]


@wp.func
def begins_unit(i: int, tree: Tree, plan: Plan):
    """Whether leaf i has a different unit from the one before it.

    They share one if a common ancestor that is not above the level stands on nodes.
    """
    limit = plan.rotation_level
    if plan.rotation_level < 0:
        return False
    if i == 0 or wp.min(level_of(i, plan), level_of(i - 1, plan)) <= limit:
        return True
    a = element_of(i - 1, tree)
    b = element_of(i, tree)
    level_a = level_of(i - 1, plan)
    level_b = level_of(i, plan)
    # Elements of different levels may have the same number in a uniform tree.
    while (a != b or level_a != level_b) and (level_a > limit or level_b > limit):
        if level_a >= level_b:
            a = parent_of(a, tree)
            level_a -= 1
        else:
            b = parent_of(b, tree)
            level_b -= 1
    if a != b:
        return True
    while not on_nodes(a, tree) and level_a > limit:
        a = parent_of(a, tree)
        level_a -= 1
    return not on_nodes(a, tree)


@wp.func
def list_unit(k: int, i: int, tree: Tree, plan: Plan):
    """Write the unit of leaf i, the first of its leaves, to place k.

    It is the highest tetrahedron above the leaf, or the leaf, that is not above the rotation level and stands on nodes.
    """
    code = plan.code[i]
    e = element_of(i, tree)
    unit = int(e)
    climbed_code = int(code)
    while (climbed_code & LEVEL_MASK) > plan.rotation_level:
        climbed_code = code_above(climbed_code, which_child(e, tree), tree)
        e = parent_of(e, tree)
        if on_nodes(e, tree):
            unit = e
            code = climbed_code
    plan.unit_code[k] = code
    if tree.uniform == 0:
        plan.unit_nodes[k] = tree.tets[unit]
    else:
        nodes = wp.vec4i(0)
        for n in range(4):
            nodes[n] = tree.leaf_tets[i + tree.corner_leaves[n]][tree.corner_nodes[n]]
        plan.unit_nodes[k] = nodes


@wp.kernel(enable_backward=False)
def pad_units(
    # In
    threads: int,
    tree: Tree,
    # In and out
    plan: Plan,
):
    """Write padding to the first place, and after the units."""
    row = flat_row(plan) + 1
    count = plan.counts[row]
    for k in range(count + wp.tid(), extent(row, plan) + 1, threads):
        place = wp.where(k == count, 0, k)
        plan.unit_nodes[place] = padding(place, tree)
        plan.unit_code[place] = tree.padding_code


@wp.kernel(enable_backward=False)
def repeat_units(
    # In and out
    plan: Plan,
):
    """Units of the first world for the others too."""
    world, i = wp.tid()
    if i < plan.world_leaves:
        plan.unit[(world + 1) * plan.world_leaves + i] = plan.unit[i] + (world + 1) * plan.world_units
    if i < plan.world_units:
        k = (world + 1) * plan.world_units + i
        shift = (world + 1) * plan.world_nodes
        plan.unit_nodes[k] = plan.unit_nodes[i] + wp.vec4i(shift, shift, shift, shift)
        plan.unit_code[k] = plan.unit_code[i]


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


@wp.func
def place_in_subtree(e: int, tree: Tree):
    """The index, in tree order, of a tetrahedron among the eight descendants three levels below its ancestor."""
    p = parent_of(e, tree)
    q = parent_of(p, tree)
    return which_child(e, tree) + 2 * which_child(p, tree) + 4 * which_child(q, tree)


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
def complete(i: int, size: int, depth: int, tree: Tree, plan: Plan):
    """The tetrahedron ``depth`` levels up whose descendants at their level are leaf i and the next ones, ``size`` in
    all; -1 if they are not."""
    if i < 0 or i + size > tree.leaf_count[0]:
        return -1
    level = level_of(i, plan)
    if level < depth or level_of(i + size - 1, plan) != level:
        return -1
    for n in range(1, size - 1):
        if level_of(i + n, plan) != level:
            return -1
    root = above(element_of(i, tree), depth, tree)
    if is_torn(root, tree):
        return -1
    if above(element_of(i + size - 1, tree), depth, tree) != root:
        return -1
    return root


@wp.func
def class_at(i: int, tree: Tree, plan: Plan):
    """The class of the subtree that begins at leaf i; -1 if none does."""
    level = level_of(i, plan)
    if plan.with_subtrees == 0 or level < 3 or which_child(element_of(i, tree), tree) == 1:
        return -1
    kind = kind_of(level, plan)
    if kind < 0:
        return -1
    root = complete(i, LEAVES_OF_SUBTREE, 3, tree, plan)
    if root < 0:
        return -1
    if plan.members == 1:
        return kind
    if level >= 6:
        start = i - LEAVES_OF_SUBTREE * place_in_subtree(root, tree)
        if complete(start, LEAVES_OF_GROUP, 6, tree, plan) >= 0:
            return 2 * kind
    return 2 * kind + 1


@wp.func
def covered_from(i: int, tree: Tree, plan: Plan):
    """Number of leaves from the i-th on that belong to a subtree that begins before it."""
    if level_of(i, plan) < 3:
        return 0
    place = place_in_subtree(element_of(i, tree), tree)
    if place == 0 or place > i:
        return 0
    if class_at(i - place, tree, plan) < 0:
        return 0
    return LEAVES_OF_SUBTREE - place


@wp.kernel(enable_backward=False)
def mark_leaves(
    # In
    threads: int,
    tree: Tree,
    # In and out
    plan: Plan,
    # Out
    sums: wp.array[wp.int32],
):
    """Mark what each leaf begins, and count everything in each thread's stretch, [classes + 2, threads]."""
    t = wp.tid()
    totals = places_t()
    if plan.goes[0] != 0:
        leaves = tree.leaf_count[0]
        stretch = (leaves + threads - 1) / threads
        begin = t * stretch
        end = wp.min(begin + stretch, leaves)
        if begin < end:
            i = int(begin)
            inside = covered_from(begin, tree, plan)
            while i < end:
                at = int(FLAT)
                size = int(1)
                if i == begin and inside > 0:
                    at = int(COVERED)
                    size = inside
                else:
                    found = class_at(i, tree, plan)
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
                        new = begins_unit(i + n, tree, plan)
                    if new:
                        mark += FIRST_OF_UNIT
                        totals[flat_row(plan) + 1] += 1
                    plan.marks[i + n] = wp.int8(mark)
                i += size
    for row in range(plan.classes + 2):
        sums[row * threads + t] = totals[row]


@wp.kernel(enable_backward=False)
def count_rows(
    # In
    threads: int,
    ends: wp.array[wp.int32],
    # In and out
    plan: Plan,
):
    """Write the counts of classes, of leaves in none and of units; ``ends`` are inclusive sums."""
    row = wp.tid()
    if plan.goes[0] != 0:
        count = ends[(row + 1) * threads - 1]
        if row > 0:
            count -= ends[row * threads - 1]
        plan.counts[row] = count


@wp.kernel(enable_backward=False)
def list_leaves(
    # In
    threads: int,
    tree: Tree,
    ends: wp.array[wp.int32],
    # In and out
    plan: Plan,
):
    """Write the lists; ``ends`` are inclusive sums."""
    t = wp.tid()
    if plan.goes[0] != 0:
        leaves = tree.leaf_count[0]
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
        places[unit_row] += plan.first_unit - 1
        for i in range(t * stretch, wp.min((t + 1) * stretch, leaves)):
            mark = int(plan.marks[i])
            at = mark & MARK_BITS
            if at < CLASSES:
                plan.first[plan.begin[at] + places[at]] = i
                places[at] += 1
            elif at == FLAT:
                plan.flat[places[flat_row(plan)]] = i
                places[flat_row(plan)] += 1
            if plan.with_units != 0:
                if mark >= FIRST_OF_UNIT:
                    places[unit_row] += 1
                    list_unit(places[unit_row], i, tree, plan)
                plan.unit[i] = places[unit_row]
