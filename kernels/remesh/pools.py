"""The device's pools of a forest that changes while it is used, and what every kernel of a pass shares.

Tetrahedra stand in a pool: roots first, then pairs of children, so that the two children of one parent are neighbours;
nodes stand in another. The pool of tetrahedra has a list of what is free. After every pass the nodes that leaves name
are 0, 1, 2, … without gaps; those that only void tetrahedra name stand at the end of the pool and stay there. The
leaves are a list in tree order. All counts are on the device: a kernel goes through as many things as there are with as
many threads as it was launched with, so that a recorded pass fits a mesh of any size and its work follows the leaves,
not the capacity.

Those who step the mesh may launch for more nodes and leaves than there are. What lies beyond the counts is padding:
nodes without mass that stay at rest, and leaves of which all four nodes are one of some places past the last node.
"""

import warp as wp

# Places in ``Pools.counts``.
LEAVES = wp.constant(0)
NODE_TOP = wp.constant(1)  # nodes that leaves name: all lower numbers
FREE_PAIRS = wp.constant(2)
STAMP = wp.constant(3)  # rounds so far, over all passes
PASS_STAMP = wp.constant(4)  # the round in which the present pass began
WANTED = wp.constant(5)  # edges wanted in this pass
BIRTHS = wp.constant(6)  # of them those of this round ...
LAST_BIRTHS = wp.constant(7)  # ... and of the one before
FRESH = wp.constant(8)  # pairs made in this pass
FRESH_SEEN = wp.constant(9)  # of them those that an earlier round has looked at
FRESH_NEW = wp.constant(10)  # where this round's begin
NODES_TAKEN = wp.constant(11)
PAIRS_TAKEN = wp.constant(12)
CANDIDATES = wp.constant(13)  # nodes that some leaf would give up
NODES_GIVEN = wp.constant(14)
PAIRS_GIVEN = wp.constant(15)
GAINERS = wp.constant(16)  # ends to which mass came back
ADDED = wp.constant(17)  # nodes made in this pass
REMOVED = wp.constant(18)  # nodes removed in this pass
FULL = wp.constant(19)  # some refinement had to be left out for want of room
OLD_TOP = wp.constant(20)  # NODE_TOP before nodes moved into the places of those that were removed
NEW_LEAVES = wp.constant(21)
FIRST_NEW = wp.constant(22)  # nodes made in this pass have this number or a higher one until some are removed
COUNTS = 23

#: Places past the last node that padding names in turn, so that what is added to them seldom meets.
SINKS = wp.constant(1024)
#: Places past the last leaf there may ever be, for launches that are larger than need be.
LEAF_PADDING = 1024

# Level of a tetrahedron that is not in use.
UNUSED = wp.constant(-1)

# Marks of leaves.
SIMPLIFY = wp.constant(wp.int8(-1))
REFINE = wp.constant(wp.int8(1))


@wp.struct
class Pools:
    """Tetrahedra, nodes and leaves, each with as many places as there may ever be."""

    counts: wp.array[wp.int32]
    roots: int
    node_limit: int  # NODE_TOP may grow to this: here those begin that only void tetrahedra name
    sink: int  # the first of the places that padding names
    # Tetrahedra.
    tets: wp.array[wp.vec4i]  # nodes in Maubach order
    level: wp.array[wp.int32]  # UNUSED where there is none
    parent: wp.array[wp.int32]
    first_child: wp.array[wp.int32]  # LIVE or VOID where there is none
    code: wp.array[
        wp.int32
    ]  # level, mirrored or not, and which of ``frames``, as in ``elements.elements.ForestElements``
    next: wp.array[wp.int32]  # the next tetrahedron around the same edge, while it is bisected or merged
    free_pairs: wp.array[wp.int32]  # first children
    fresh: wp.array[wp.int32]  # first children made in this pass
    void_leaves: wp.array[wp.int32]  # void tetrahedra with a node that leaves name
    void_count: int
    # All frames that tetrahedra can have, and what is in the code besides the level of the two children of a
    # tetrahedron by its own frame and type.
    frames: wp.array[wp.mat33]
    child_code: wp.array3d[wp.int32]  # [frames, 3, 2]
    # Nodes.
    lattice: wp.array[wp.vec3i]
    ends: wp.array[wp.vec2i]  # of the edge whose midpoint a node is
    valence: wp.array[wp.int32]  # leaves, live or void, that name a node; 0: there is none
    touched: wp.array[wp.int32]  # the last round in which an edge of this node came to be wanted
    # Leaves, in tree order.
    leaves: wp.array[wp.int32]
    leaf_tets: wp.array[wp.vec4i]  # beyond the count padding
    new_leaves: wp.array[wp.int32]
    marks: wp.array[wp.int8]


@wp.func
def padding(i: int, pools: Pools):
    """The i-th place in the list of leaves where there is no leaf."""
    sink = pools.sink + i % SINKS
    return wp.vec4i(sink, sink, sink, sink)


@wp.kernel(enable_backward=False)
def begin_pass(
    # In and out
    pools: Pools,
):
    counts = pools.counts
    counts[STAMP] = counts[STAMP] + 1
    counts[PASS_STAMP] = counts[STAMP]
    counts[WANTED] = 0
    counts[BIRTHS] = 0
    counts[FRESH] = 0
    counts[FRESH_SEEN] = 0
    counts[FRESH_NEW] = 0
    counts[CANDIDATES] = 0
    counts[NODES_GIVEN] = 0
    counts[PAIRS_GIVEN] = 0
    counts[GAINERS] = 0
    counts[ADDED] = 0
    counts[REMOVED] = 0
    counts[FIRST_NEW] = counts[NODE_TOP]


@wp.kernel(enable_backward=False)
def give_back(
    # In and out
    pools: Pools,
):
    """Count what was removed to what is free."""
    counts = pools.counts
    counts[FREE_PAIRS] = counts[FREE_PAIRS] + counts[PAIRS_GIVEN]
    counts[REMOVED] = counts[NODES_GIVEN]
