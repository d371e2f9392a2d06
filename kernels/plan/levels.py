"""Nodes of a forest by tree level, found only from their lattice points.

A node is the midpoint of the refinement edge of a tetrahedron one level up, or a corner of a root. Let t be the
smallest number of trailing zero bits of the nonzero coordinates of its lattice point. Three levels halve the edges, and
within three the first midpoints are those of a cube's diagonals, then of its faces' diagonals, then of its edges:
on one, two or all three axes the point is odd in units of 2^t. So t and the number of these axes give the level.

Nodes of no leaf, corners of ancestors whose descendants there are void, have other places in the mesh's
numbering; the nodes of leaves are 0 ... N - 1."""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.func
def level_of_point(p: wp.vec3i, bits: int):
    """Level of the node at a lattice point; 0 for a root's corner, ``bits``: log2 of the intervals in a cube's edge."""
    together = p[0] | p[1] | p[2]
    lowest = together & -together
    if lowest == 0 or lowest >= (1 << bits):
        return 0
    odd = int(0)
    for axis in range(3):
        if (p[axis] & lowest) != 0:
            odd += 1
    level = 3 * bits + 1 - odd
    while lowest > 1:
        lowest = lowest >> 1
        level -= 3
    return level


@wp.func
def number_of(place: int, others: int, mesh_nodes: int, sums: wp.array[wp.int32]):
    """The number of a node at a place in the mesh's numbering, where the other nodes begin at ``others``;
    ``sums`` are inclusive sums of the flags of those that have a number."""
    if place < others:
        return place
    return mesh_nodes + sums[place - others] - 1


@wp.kernel(enable_backward=False)
def flag_ends(
    # In
    first: int,
    level: int,
    bits: int,
    others: int,
    lattice: wp.array[wp.vec3i],
    ends: wp.array[wp.vec2i],
    # In and out
    flags: wp.array[wp.int32],
):
    """Flag the other nodes that are ends of nodes from place ``first`` on: of flagged ones of a level, or of all, if
    the level is negative."""
    place = first + wp.tid()
    takes_part = level < 0
    if level >= 0:
        takes_part = flags[place - others] != 0 and level_of_point(lattice[place], bits) == level
    if takes_part:
        pair = ends[place]
        for n in range(2):
            if pair[n] >= others:
                flags[pair[n] - others] = 1


@wp.kernel(enable_backward=False)
def find_levels(
    # In
    mesh_nodes: int,
    bits: int,
    lattice: wp.array[wp.vec3i],
    places: wp.array[wp.int32],
    # Out
    level: wp.array[wp.int32],
    nodes: wp.array[wp.int32],
):
    """Level of each node, and its number, for sorting; ``places`` are those of the nodes from N on."""
    i = wp.tid()
    place = int(i)
    if i >= mesh_nodes:
        place = places[i - mesh_nodes]
    level[i] = level_of_point(lattice[place], bits)
    nodes[i] = i


@wp.kernel(enable_backward=False)
def find_starts(
    # In
    count: int,
    level: wp.array[wp.int32],
    # Out
    starts: wp.array[wp.int32],
):
    """The start of each level among ``count`` nodes sorted by level."""
    wanted = wp.tid()
    starts[wanted] = wp.lower_bound(level, 0, count + 1, wanted)


@wp.kernel(enable_backward=False)
def list_ends(
    # In
    mesh_nodes: int,
    roots: int,
    others: int,
    mesh_ends: wp.array[wp.vec2i],
    sums: wp.array[wp.int32],
    places: wp.array[wp.int32],
    nodes: wp.array[wp.int32],
    # Out
    ends: wp.array[wp.vec2i],
):
    """Both ends of each node in the order of levels, the first ``roots`` nodes without any."""
    i = wp.tid()
    node = nodes[i]
    if i < roots:
        ends[i] = wp.vec2i(-1, -1)
        return
    place = int(node)
    if node >= mesh_nodes:
        place = places[node - mesh_nodes]
    pair = mesh_ends[place]
    a = number_of(pair[0], others, mesh_nodes, sums)
    b = number_of(pair[1], others, mesh_nodes, sums)
    ends[i] = wp.vec2i(a, b)


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
