"""The device's pools of a forest that changes during use, shared by all kernels of a pass.

Tetrahedra are in one pool: roots first, then pairs of children, so that the two children of one parent are adjacent;
nodes are in another. The pool of tetrahedra has a list of free places. After every pass the nodes of leaves
are 0, 1, 2, … without gaps; those of void tetrahedra only are at the end of the pool and stay there. The
leaves are a list in tree order. All counts are on the device: a kernel loops over the current number of items with
any number of threads, so that a recorded pass fits a mesh of any size and its work depends on the leaves,
not on the capacity.

Stepping may launch more nodes and leaves than exist. Beyond the counts is padding:
nodes without mass that stay at rest, and leaves whose four nodes are all one of some places past the last node.
"""

import warp as wp

from warp_corot.kernels.plan.plan import SINKS

wp.set_module_options({"enable_backward": False})

# Places in ``Pools.counts``.
LEAVES = wp.constant(0)
NODE_TOP = wp.constant(1)  # nodes that leaves name: all lower numbers
FREE_PAIRS = wp.constant(2)
STAMP = wp.constant(3)  # number of rounds over all passes
PASS_STAMP = wp.constant(4)  # the round in which the current pass began
WANTED = wp.constant(5)  # edges wanted in this pass
BIRTHS = wp.constant(6)  # number of these that became wanted in this round ...
LAST_BIRTHS = wp.constant(7)  # ... and in the one before
FRESH = wp.constant(8)  # pairs made in this pass
FRESH_SEEN = wp.constant(9)  # number of these that an earlier round has visited
FRESH_NEW = wp.constant(10)  # start of this round's
NODES_TAKEN = wp.constant(11)
PAIRS_TAKEN = wp.constant(12)
CANDIDATES = wp.constant(13)  # nodes that some leaf could give up
NODES_GIVEN = wp.constant(14)
PAIRS_GIVEN = wp.constant(15)
GAINERS = wp.constant(16)  # ends that gained mass
ADDED = wp.constant(17)  # nodes made in this pass
REMOVED = wp.constant(18)  # nodes removed in this pass
FULL = wp.constant(19)  # nonzero if a refinement was left out because the pools were full
OLD_TOP = wp.constant(20)  # NODE_TOP before nodes moved into the places of removed ones
NEW_LEAVES = wp.constant(21)
FIRST_NEW = wp.constant(22)  # nodes made in this pass have this number or a higher one, until nodes are removed
COUNTS = 23

#: Places past the last possible leaf, for launches that are larger than needed.
LEAF_PADDING = 1024

# Level of a tetrahedron that is not in use.
UNUSED = wp.constant(-1)

# Marks of leaves.
SIMPLIFY = wp.constant(wp.int8(-1))
REFINE = wp.constant(wp.int8(1))


@wp.struct
class Pools:
    """Tetrahedra, nodes and leaves, each with places for the capacity."""

    counts: wp.array[wp.int32]
    roots: int
    node_limit: int  # upper bound of NODE_TOP: the nodes of void tetrahedra only begin here
    sink: int  # the first place that padding names
    # Tetrahedra.
    tets: wp.array[wp.vec4i]  # nodes in Maubach order
    level: wp.array[wp.int32]  # UNUSED for free places
    parent: wp.array[wp.int32]
    first_child: wp.array[wp.int32]  # LIVE or VOID if there is none
    code: wp.array[
        wp.int32
    ]  # level, mirrored or not, and which of ``frames``, as in ``elements.elements.ForestElements``
    cut: wp.array[wp.int32]  # which faces of a leaf are cut, and TORN: see ``plan.plan``
    next: wp.array[wp.int32]  # the next tetrahedron around the same edge, during bisection or merging
    free_pairs: wp.array[wp.int32]  # first children
    fresh: wp.array[wp.int32]  # first children made in this pass
    void_leaves: wp.array[wp.int32]  # void tetrahedra with a node that leaves name
    void_count: int
    # All possible frames of tetrahedra, and the codes without level of the two children of a
    # tetrahedron by its own frame and type.
    frames: wp.array[wp.mat33]
    child_code: wp.array3d[wp.int32]  # [frames, 3, 2]
    # Nodes.
    lattice: wp.array[wp.vec3i]
    ends: wp.array[wp.vec2i]  # of the edge whose midpoint the node is
    valence: wp.array[wp.int32]  # number of leaves, live or void, that name a node; 0: no node
    touched: wp.array[wp.int32]  # the last round in which an edge of this node became wanted
    # Leaves, in tree order.
    leaves: wp.array[wp.int32]
    leaf_tets: wp.array[wp.vec4i]  # padding beyond the count
    new_leaves: wp.array[wp.int32]
    marks: wp.array[wp.int8]


@wp.func
def padding(i: int, pools: Pools):
    """The i-th padding entry of the list of leaves."""
    sink = pools.sink + i % SINKS
    return wp.vec4i(sink, sink, sink, sink)


@wp.kernel(enable_backward=False)
def begin_pass(
    # In
    goes_on: int,  # whether this pass and the last one count as one
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
    if goes_on == 0:
        counts[ADDED] = 0
    counts[REMOVED] = 0
    counts[FIRST_NEW] = counts[NODE_TOP]


@wp.kernel(enable_backward=False)
def give_back(
    # In and out
    pools: Pools,
):
    """Add removed items to the free ones."""
    counts = pools.counts
    counts[FREE_PAIRS] = counts[FREE_PAIRS] + counts[PAIRS_GIVEN]
    counts[REMOVED] = counts[NODES_GIVEN]
