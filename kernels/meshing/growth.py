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


@wp.struct
class Forest:
    """A forest that grows; its arrays have spare room."""

    # Tetrahedra.
    tets: wp.array[wp.vec4i]
    level: wp.array[wp.int32]
    parent: wp.array[wp.int32]
    first_child: wp.array[wp.int32]  # LIVE or VOID if there is none
    wished: wp.array[wp.uint8]  # whether it must be bisected
    bound: wp.array[wp.uint8]  # void, but conforming with its neighbours
    need: wp.array[wp.float32]  # its error if it is not bisected [m]
    # Lattice points.
    lattice: wp.array[wp.vec3i]
    ends: wp.array[wp.vec2i]  # of the edge whose midpoint it is, -1 for corners of cubes
    active: wp.array[wp.uint8]
    touched: wp.array[wp.uint8]  # whether an edge here got an active midpoint
    phi: wp.array[wp.float32]  # the body's signed function [m]
    counts: wp.array[wp.int32]
    # The table from edges to their midpoints.
    keys: wp.array[wp.int64]
    values: wp.array[wp.int32]
    # The body, and what is allowed by level.
    origin: wp.vec3d  # of the lattice [m]
    spacing: wp.float64  # of its points [m]
    lipschitz: float
    circumradius: wp.array[wp.float32]  # [m]
    edges: wp.array2d[wp.float32]  # lengths of edges [m]
    tolerances: wp.array[wp.float32]  # the largest error [m]
    closest: wp.array[wp.float32]  # the value to which it may be lowered later [m]


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
    # In and out
    forest: Forest,
):
    """Enter all existing midpoints into an empty table."""
    node = wp.tid()
    pair = forest.ends[node]
    if pair[0] >= 0:
        slot = claim_slot(edge_key(pair[0], pair[1]), forest.keys)
        forest.values[-slot - 1] = node


@wp.kernel(enable_backward=False)
def insert_midpoints(
    # In
    pairs: wp.array[wp.vec2i],
    # In and out
    forest: Forest,
    # Out
    slots: wp.array[wp.int32],
):
    """Insert the midpoints that do not exist yet; returns the slot of each."""
    i = wp.tid()
    a = pairs[i][0]
    b = pairs[i][1]
    slot = claim_slot(edge_key(a, b), forest.keys)
    if slot < 0:
        slot = -slot - 1
        node = wp.atomic_add(forest.counts, NODES, 1)
        forest.values[slot] = node
        forest.ends[node] = wp.vec2i(wp.min(a, b), wp.max(a, b))
        forest.lattice[node] = halfway(forest.lattice[a], forest.lattice[b])
    slots[i] = slot


@wp.kernel(enable_backward=False)
def refinement_edges(
    # In
    elements: wp.array[wp.int32],
    # In and out
    forest: Forest,
    # Out
    pairs: wp.array[wp.vec2i],
):
    i = wp.tid()
    tet = forest.tets[elements[i]]
    depth = forest.level[elements[i]]
    wp.atomic_max(forest.counts, DEEPEST, depth)
    pairs[i] = wp.vec2i(tet[0], tet[refinement_end(depth)])


@wp.kernel(enable_backward=False)
def all_edges(
    # In
    elements: wp.array[wp.int32],
    forest: Forest,
    # Out
    pairs: wp.array[wp.vec2i],
):
    """The six edges of each element, in the order of ``tables.shapes.EDGES``."""
    i = wp.tid()
    tet = forest.tets[elements[i]]
    for e in range(6):
        pairs[6 * i + e] = wp.vec2i(tet[FIRST_NODE[e]], tet[SECOND_NODE[e]])


@wp.kernel(enable_backward=False)
def activate(
    # In
    slots: wp.array[wp.int32],
    # In and out
    forest: Forest,
):
    """Make midpoints active, and mark both ends of their edges as touched."""
    node = forest.values[slots[wp.tid()]]
    forest.active[node] = wp.uint8(1)
    forest.touched[forest.ends[node][0]] = wp.uint8(1)
    forest.touched[forest.ends[node][1]] = wp.uint8(1)


@wp.kernel(enable_backward=False)
def bisect(
    # In
    elements: wp.array[wp.int32],
    slots: wp.array[wp.int32],
    base: int,
    # In and out
    forest: Forest,
):
    """Bisect elements. Children are stored consecutively from ``base`` on and are live or void like their parent."""
    i = wp.tid()
    element = elements[i]
    tet = forest.tets[element]
    depth = forest.level[element]
    z = forest.values[slots[i]]
    child = base + 2 * i
    forest.tets[child] = first_half(tet, z, depth)
    forest.tets[child + 1] = second_half(tet, z, depth)
    for n in range(2):
        forest.level[child + n] = depth + 1
        forest.parent[child + n] = element
        forest.first_child[child + n] = forest.first_child[element]
        forest.bound[child + n] = forest.bound[element]
    forest.first_child[element] = child


@wp.kernel(enable_backward=False)
def flag_hanging(
    # In
    first: int,
    first_new: int,
    forest: Forest,
    # Out
    flags: wp.array[wp.int32],
):
    """Flag leaves that must be bisected or have an active midpoint on an edge; void ones only if conformity requires.

    Only elements from ``first_new`` on, and those with a recently bisected edge, both ends of which are touched, need a
    closer check. ``first`` is the number of the first thread's element.
    """
    i = first + wp.tid()
    flag = int(0)
    if forest.first_child[i] == LIVE or (forest.first_child[i] == VOID and forest.bound[i] != wp.uint8(0)):
        if forest.wished[i] != wp.uint8(0):
            flag = 1
        else:
            tet = forest.tets[i]
            ends = int(0)
            for n in range(4):
                ends += int(forest.touched[tet[n]])
            if i >= first_new or ends > 1:
                for e in range(6):
                    a = tet[FIRST_NODE[e]]
                    b = tet[SECOND_NODE[e]]
                    if flag == 0 and (i >= first_new or int(forest.touched[a]) * int(forest.touched[b]) == 1):
                        slot = find_slot(a, b, forest.keys)
                        if slot >= 0:
                            flag = int(forest.active[forest.values[slot]])
    flags[i] = flag
