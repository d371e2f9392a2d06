"""Growing a forest: bisection without neighbour pointers.

A hash table gives the midpoint of an edge from the edge's two nodes (linear probing, filled by compare-and-swap).
A midpoint is active once a tetrahedron has been bisected at it; an element with an active midpoint on any edge has a
hanging node and must be bisected too. Midpoints that are not active are places where the body was evaluated.
"""

import warp as wp

from warp_corot.kernels.tables.shapes import FIRST_NODE, SECOND_NODE

from .bisection import first_half, halfway, refinement_end, second_half

wp.set_module_options({"enable_backward": False})

EMPTY = wp.constant(wp.int64(-1))
LIVE = wp.constant(-1)
VOID = wp.constant(-2)

# Places in ``counts``.
NODES = wp.constant(0)
DEEPEST = wp.constant(1)  # the deepest level that had to be bisected


@wp.func
def edge_key(a: int, b: int):
    return (wp.int64(wp.min(a, b)) << wp.int64(32)) | wp.int64(wp.max(a, b))


@wp.func
def home_slot(key: wp.int64, mask: int):
    mixed = wp.uint64(key) * wp.uint64(11400714819323198485)
    return int(mixed >> wp.uint64(33)) & mask


@wp.func
def find_slot(a: int, b: int, keys: wp.array[wp.int64]):
    """The slot of an edge in a table, or -1."""
    key = edge_key(a, b)
    mask = keys.shape[0] - 1
    slot = home_slot(key, mask)
    while keys[slot] != key and keys[slot] != EMPTY:
        slot = (slot + 1) & mask
    if keys[slot] == key:
        return slot
    return -1


@wp.func
def find_midpoint(a: int, b: int, keys: wp.array[wp.int64], values: wp.array[wp.int32]):
    """The node at the middle of an edge, -1 if there is none."""
    slot = find_slot(a, b, keys)
    if slot >= 0:
        return values[slot]
    return -1


@wp.func
def claim_slot(key: wp.int64, keys: wp.array[wp.int64]):
    """The key's slot; if it was inserted now, its negative minus 1."""
    mask = keys.shape[0] - 1
    slot = home_slot(key, mask)
    while True:
        before = wp.atomic_cas(keys, slot, EMPTY, key)
        if before == EMPTY:
            return -slot - 1
        if before == key:
            return slot
        slot = (slot + 1) & mask
    return slot


@wp.kernel(enable_backward=False)
def fill_table(
    # In
    ends: wp.array[wp.vec2i],
    # Out
    keys: wp.array[wp.int64],
    values: wp.array[wp.int32],
):
    """Enter all existing midpoints into an empty table."""
    node = wp.tid()
    pair = ends[node]
    if pair[0] >= 0:
        slot = claim_slot(edge_key(pair[0], pair[1]), keys)
        values[-slot - 1] = node


@wp.kernel(enable_backward=False)
def insert_midpoints(
    # In
    pairs: wp.array[wp.vec2i],
    # In and out
    lattice: wp.array[wp.vec3i],
    ends: wp.array[wp.vec2i],
    keys: wp.array[wp.int64],
    values: wp.array[wp.int32],
    counts: wp.array[wp.int32],
    # Out
    slots: wp.array[wp.int32],
):
    """Insert the midpoints that do not exist yet; returns the slot of each."""
    i = wp.tid()
    a = pairs[i][0]
    b = pairs[i][1]
    slot = claim_slot(edge_key(a, b), keys)
    if slot < 0:
        slot = -slot - 1
        node = wp.atomic_add(counts, NODES, 1)
        values[slot] = node
        ends[node] = wp.vec2i(wp.min(a, b), wp.max(a, b))
        lattice[node] = halfway(lattice[a], lattice[b])
    slots[i] = slot


@wp.kernel(enable_backward=False)
def refinement_edges(
    # In
    elements: wp.array[wp.int32],
    tets: wp.array[wp.vec4i],
    level: wp.array[wp.int32],
    # In and out
    counts: wp.array[wp.int32],
    # Out
    pairs: wp.array[wp.vec2i],
):
    i = wp.tid()
    tet = tets[elements[i]]
    depth = level[elements[i]]
    wp.atomic_max(counts, DEEPEST, depth)
    pairs[i] = wp.vec2i(tet[0], tet[refinement_end(depth)])


@wp.kernel(enable_backward=False)
def all_edges(
    # In
    elements: wp.array[wp.int32],
    tets: wp.array[wp.vec4i],
    # Out
    pairs: wp.array[wp.vec2i],
):
    """The six edges of each element, in the order of ``tables.shapes.EDGES``."""
    i = wp.tid()
    tet = tets[elements[i]]
    for e in range(6):
        pairs[6 * i + e] = wp.vec2i(tet[FIRST_NODE[e]], tet[SECOND_NODE[e]])


@wp.kernel(enable_backward=False)
def activate(
    # In
    slots: wp.array[wp.int32],
    values: wp.array[wp.int32],
    ends: wp.array[wp.vec2i],
    # Out
    active: wp.array[wp.uint8],
    touched: wp.array[wp.uint8],
):
    """Make midpoints active, and mark both ends of their edges as touched."""
    node = values[slots[wp.tid()]]
    active[node] = wp.uint8(1)
    touched[ends[node][0]] = wp.uint8(1)
    touched[ends[node][1]] = wp.uint8(1)


@wp.kernel(enable_backward=False)
def bisect(
    # In
    elements: wp.array[wp.int32],
    slots: wp.array[wp.int32],
    values: wp.array[wp.int32],
    base: int,
    # In and out
    tets: wp.array[wp.vec4i],
    level: wp.array[wp.int32],
    parent: wp.array[wp.int32],
    first_child: wp.array[wp.int32],
    bound: wp.array[wp.uint8],
):
    """Bisect elements. Children are stored consecutively from ``base`` on and are live or void like their parent."""
    i = wp.tid()
    element = elements[i]
    tet = tets[element]
    z = values[slots[i]]
    child = base + 2 * i
    tets[child] = first_half(tet, z, level[element])
    tets[child + 1] = second_half(tet, z, level[element])
    for n in range(2):
        level[child + n] = level[element] + 1
        parent[child + n] = element
        first_child[child + n] = first_child[element]
        bound[child + n] = bound[element]
    first_child[element] = child


@wp.kernel(enable_backward=False)
def flag_hanging(
    # In
    tets: wp.array[wp.vec4i],
    first_child: wp.array[wp.int32],
    wished: wp.array[wp.uint8],
    bound: wp.array[wp.uint8],
    keys: wp.array[wp.int64],
    values: wp.array[wp.int32],
    active: wp.array[wp.uint8],
    touched: wp.array[wp.uint8],
    first_new: int,
    # Out
    flags: wp.array[wp.int32],
):
    """Flag leaves that must be bisected or have an active midpoint on an edge; void ones only if conformity requires.

    Only elements from ``first_new`` on, and those with a recently bisected edge, both ends of which are
    touched, need a closer check.
    """
    i = wp.tid()
    flag = int(0)
    if first_child[i] == LIVE or (first_child[i] == VOID and bound[i] != wp.uint8(0)):
        if wished[i] != wp.uint8(0):
            flag = 1
        else:
            tet = tets[i]
            ends = int(touched[tet[0]]) + int(touched[tet[1]]) + int(touched[tet[2]]) + int(touched[tet[3]])
            if i >= first_new or ends > 1:
                for e in range(6):
                    a = tet[FIRST_NODE[e]]
                    b = tet[SECOND_NODE[e]]
                    if flag == 0 and (i >= first_new or int(touched[a]) * int(touched[b]) == 1):
                        node = find_midpoint(a, b, keys, values)
                        if node >= 0:
                            flag = int(active[node])
    flags[i] = flag


@wp.kernel(enable_backward=False)
def gather_flagged(
    # In
    flags: wp.array[wp.int32],
    places: wp.array[wp.int32],
    first: int,
    # Out
    chosen: wp.array[wp.int32],
):
    """Indices, from ``first`` on, of flagged entries, in order; ``places`` is the inclusive sum of the flags."""
    i = wp.tid()
    if flags[i] != 0:
        chosen[places[i] - 1] = first + i
