"""The device's pools of a forest that changes during use, shared by all kernels of a pass.

Tetrahedra are in one pool: roots first, then pairs of children, so that the two children of one parent are adjacent;
nodes are in another. The pool of tetrahedra has a list of free places. After every pass the nodes of leaves
are 0, 1, 2, … without gaps; those of void tetrahedra only are at the end of the pool and stay there. The
leaves are a list in tree order. All counts are on the device: a kernel loops over the current number of items with
any number of threads, so that a recorded pass fits a mesh of any size and its work depends on the leaves,
not on the capacity.

Stepping may launch more nodes and leaves than exist. Beyond the counts is padding:
nodes without mass that stay at rest, and leaves whose four nodes are all one of some places past the last node.

Data of nodes and tetrahedra are passed on when the mesh changes. A new node takes from each end of its edge the mass
that this end loses, with the momentum of that mass. A removed node returns to each end the mass that it gains, at the
end's velocity plus the node's velocity relative to both together. So mass and linear momentum are conserved, and
bisection and removal undo each other. Children have their parent's density. Losses and gains of the ends are summed
leaf by leaf, so that densities around an edge, and of merged children, may differ by any factor.

Tetrahedra carry columns of numbers. Children have their parent's values; each column defines the parent's value."""

import warp as wp

from warp_corot.kernels.elements.elements import load_node, store_node
from warp_corot.kernels.meshing.bisection import lattice_place, single
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
COUNTS = 22

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
    counts[NODES_TAKEN] = 0
    counts[PAIRS_TAKEN] = 0
    if goes_on == 0:
        counts[ADDED] = 0
    counts[REMOVED] = 0


# Rows of keyframes for nodes that follow none, and for held nodes between nodes with different rows.
NO_ROW = wp.constant(-1)
MIXED_ROWS = wp.constant(-2)

# A parent's value in a column. Children have equal volumes, so means conserve quantities whose densities are stored.
MEAN = wp.constant(0)  # of both children
MEAN_OF_CONTENTS = wp.constant(1)  # weighted by the filled volume of each child
FIRST = wp.constant(2)  # the first child's
MEAN_IF_ALIKE = wp.constant(3)  # MEAN_OF_CONTENTS if all whole numbers of both are equal, else FIRST


@wp.struct
class Carried:
    """Nodes: displacement, velocity, mass and load. Tetrahedra: density and other values per full volume."""

    origin: wp.vec3d  # of the lattice [m]
    spacing: wp.float64  # of its points [m]
    volume: wp.array[wp.float64]  # rest volume by level [m^3]
    size: wp.array[wp.float64]  # its cube root [m]
    # Nodes; these arrays include padding.
    rest: wp.array[wp.vec4]  # rest position [m]
    u: wp.array[wp.vec4]
    v: wp.array[wp.vec4]
    load: wp.array[wp.vec4]
    reaction: wp.array[wp.vec4]  # force of the support on a held node [N]
    snap: wp.array[wp.vec4]  # from a node on a cut to the surface that cut there, at rest [m]
    mass: wp.array[wp.float64]
    held: wp.array[wp.uint8]
    row: wp.array[wp.int32]  # the row of keyframes that a held node follows, NO_ROW, or MIXED_ROWS
    mass32: wp.array[wp.float32]  # the mass for stepping
    inverse_mass: wp.array[wp.float32]
    # Tetrahedra, by their places in the pool.
    density: wp.array[wp.float64]  # mass per rest volume, averaged over the unfilled part, too
    label: wp.array[wp.int32]
    values: wp.array2d[wp.float32]
    merging: wp.array[wp.int32]  # MEAN, MEAN_OF_CONTENTS, … of each column of values
    fill_column: int  # column of the filled fraction, -1 if all elements are full
    mu_column: int  # columns of Lamé's parameters times the filled fraction, -1 if all elements have the same
    lam_column: int
    numbers: wp.array2d[wp.int32]  # whole numbers; a parent has its first child's
    # During removal of nodes.
    gained_mass: wp.array[wp.float64]
    gained_momentum: wp.array[wp.vec3d]  # beyond that of the gained mass at the end's velocity
    gain_count: wp.array[wp.int32]
    gainers: wp.array[wp.int32]
    cut_area: wp.array[wp.float64]  # [1] of all cuts, at rest [m^2]
    impulse: wp.array[wp.vec3d]  # [1] total impulse of supports in all passes [N s]


@wp.func
def doubled(a: wp.vec3):
    return wp.vec3d(wp.float64(a[0]), wp.float64(a[1]), wp.float64(a[2]))


@wp.func
def quarter_mass(e: int, level: int, carried: Carried):
    return wp.float64(0.25) * carried.density[e] * carried.volume[level]


@wp.func
def mass_changes(e: int, child: int, level: int, carried: Carried):
    """What a tetrahedron gives to each end of its refinement edge more than its two children do, the first end's first
    [kg]."""
    whole = quarter_mass(e, level, carried)
    return whole - quarter_mass(child, level + 1, carried), whole - quarter_mass(child + 1, level + 1, carried)


@wp.func
def modulus_of(e: int, common: float, carried: Carried):
    """2 mu + lambda of a leaf, times its filled fraction [Pa]; what is common to all leaves that carry none."""
    if carried.mu_column < 0:
        return common
    return 2.0 * carried.values[e, carried.mu_column] + carried.values[e, carried.lam_column]


@wp.func
def copy_to_children(e: int, child: int, carried: Carried):
    for n in range(2):
        carried.density[child + n] = carried.density[e]
        carried.label[child + n] = carried.label[e]
        for c in range(carried.values.shape[1]):
            carried.values[child + n, c] = carried.values[e, c]
        for c in range(carried.numbers.shape[1]):
            carried.numbers[child + n, c] = carried.numbers[e, c]


@wp.func
def share_of_first(child: int, carried: Carried):
    """The first child's fraction of what both children hold."""
    share = float(0.5)
    if carried.fill_column >= 0:
        first = carried.values[child, carried.fill_column]
        both = first + carried.values[child + 1, carried.fill_column]
        if both > 0.0:
            share = first / both
    return share


@wp.func
def average_children(e: int, child: int, carried: Carried):
    carried.density[e] = wp.float64(0.5) * (carried.density[child] + carried.density[child + 1])
    carried.label[e] = carried.label[child]
    alike = bool(True)
    for c in range(carried.numbers.shape[1]):
        alike = alike and carried.numbers[child, c] == carried.numbers[child + 1, c]
        carried.numbers[e, c] = carried.numbers[child, c]
    share = share_of_first(child, carried)
    for c in range(carried.values.shape[1]):
        a = carried.values[child, c]
        b = carried.values[child + 1, c]
        merging = carried.merging[c]
        value = 0.5 * (a + b)
        if merging == FIRST or (merging == MEAN_IF_ALIKE and not alike):
            value = a
        elif merging != MEAN:
            value = b + share * (a - b)
        carried.values[e, c] = value


@wp.func
def row_between(a: int, b: int):
    """The row of a node between two held nodes with rows a and b."""
    row = wp.where(a == b, a, NO_ROW)
    if a != b and (a != NO_ROW or b != NO_ROW):
        row = MIXED_ROWS
    return row


@wp.func
def make_node(
    z: int,
    a: int,
    b: int,
    point: wp.vec3i,
    loss_a: wp.float64,
    loss_b: wp.float64,
    carried: Carried,
):
    """Make the midpoint of the deformed edge a-b from what both ends lose."""
    store_node(carried.rest, z, single(lattice_place(point, carried.origin, carried.spacing)))
    store_node(carried.reaction, z, wp.vec3())
    store_node(carried.u, z, 0.5 * (load_node(carried.u, a) + load_node(carried.u, b)))
    store_node(carried.load, z, wp.vec3())
    store_node(carried.snap, z, 0.5 * (load_node(carried.snap, a) + load_node(carried.snap, b)))
    va = load_node(carried.v, a)
    vb = load_node(carried.v, b)
    velocity = 0.5 * (va + vb)
    mass = loss_a + loss_b
    both_held = carried.held[a] != wp.uint8(0) and carried.held[b] != wp.uint8(0)
    carried.held[z] = wp.where(both_held, wp.uint8(1), wp.uint8(0))
    carried.row[z] = wp.where(both_held, row_between(carried.row[a], carried.row[b]), NO_ROW)
    momentum = loss_a * doubled(va) + loss_b * doubled(vb)
    if both_held:
        wp.atomic_add(carried.impulse, 0, mass * doubled(velocity) - momentum)
    elif mass > wp.float64(0.0):
        velocity = single(momentum / mass)
    store_node(carried.v, z, velocity)
    carried.mass[z] = mass
    wp.atomic_add(carried.mass, a, -loss_a)
    wp.atomic_add(carried.mass, b, -loss_b)


@wp.func
def give_to_end(
    end: int,
    mass: wp.float64,
    deviation: wp.vec3d,
    load: wp.vec3,
    pools: Pools,
    carried: Carried,
):
    if wp.atomic_add(carried.gain_count, end, 1) == 0:
        carried.gainers[wp.atomic_add(pools.counts, GAINERS, 1)] = end
    wp.atomic_add(carried.gained_mass, end, mass)
    wp.atomic_add(carried.gained_momentum, end, mass * deviation)
    if wp.length_sq(load) > 0.0:
        wp.atomic_add(carried.load, end, wp.vec4(load[0], load[1], load[2], 0.0))


@wp.func
def copy_node(z: int, to: int, carried: Carried):
    """Copy the data of a node but its mass."""
    carried.held[to] = carried.held[z]
    carried.row[to] = carried.row[z]
    store_node(carried.rest, to, load_node(carried.rest, z))
    store_node(carried.u, to, load_node(carried.u, z))
    store_node(carried.v, to, load_node(carried.v, z))
    store_node(carried.load, to, load_node(carried.load, z))
    store_node(carried.reaction, to, load_node(carried.reaction, z))
    store_node(carried.snap, to, load_node(carried.snap, z))


@wp.func
def wipe_node(z: int, carried: Carried):
    """Clear the data of a removed node."""
    carried.mass[z] = wp.float64(0.0)
    carried.mass32[z] = 0.0
    carried.inverse_mass[z] = 0.0
    carried.held[z] = wp.uint8(0)
    carried.row[z] = NO_ROW
    store_node(carried.rest, z, wp.vec3())
    store_node(carried.u, z, wp.vec3())
    store_node(carried.v, z, wp.vec3())
    store_node(carried.load, z, wp.vec3())
    store_node(carried.reaction, z, wp.vec3())
    store_node(carried.snap, z, wp.vec3())


@wp.func
def move_node(z: int, place: int, carried: Carried):
    """Move the data of a node to a free place."""
    carried.mass[place] = carried.mass[z]
    carried.mass32[place] = carried.mass32[z]
    carried.inverse_mass[place] = carried.inverse_mass[z]
    copy_node(z, place, carried)
    wipe_node(z, carried)


@wp.func
def unmake_node(z: int, a: int, b: int, gain_a: wp.float64, gain_b: wp.float64, pools: Pools, carried: Carried):
    """Return mass and momentum to both ends; ``settle_ends`` applies them."""
    mass = gain_a + gain_b
    deviation = wp.vec3d()
    if mass > wp.float64(0.0):
        mean = (gain_a * doubled(load_node(carried.v, a)) + gain_b * doubled(load_node(carried.v, b))) / mass
        deviation = doubled(load_node(carried.v, z)) - mean
    load = 0.5 * load_node(carried.load, z)
    give_to_end(a, gain_a, deviation, load, pools, carried)
    give_to_end(b, gain_b, deviation, load, pools, carried)
    wipe_node(z, carried)


@wp.kernel(enable_backward=False)
def settle_ends(
    # In
    threads: int,
    pools: Pools,
    # In and out
    carried: Carried,
):
    """Update velocities of nodes that gained mass; for held nodes, the supports take the impulse. Add what was removed
    to what is free."""
    if wp.tid() == 0:
        pools.counts[FREE_PAIRS] = pools.counts[FREE_PAIRS] + pools.counts[PAIRS_GIVEN]
        pools.counts[REMOVED] = pools.counts[NODES_GIVEN]
    for i in range(wp.tid(), pools.counts[GAINERS], threads):
        end = carried.gainers[i]
        momentum = carried.gained_momentum[end]
        mass = carried.mass[end] + carried.gained_mass[end]
        if carried.held[end] != wp.uint8(0):
            wp.atomic_add(carried.impulse, 0, -momentum)
        elif mass > wp.float64(0.0):
            store_node(carried.v, end, single(doubled(load_node(carried.v, end)) + momentum / mass))
        carried.mass[end] = mass
        carried.gained_mass[end] = wp.float64(0.0)
        carried.gained_momentum[end] = wp.vec3d()
        carried.gain_count[end] = 0


@wp.func
def refresh_mass(i: int, carried: Carried):
    """Update the mass of a node for stepping."""
    mass = carried.mass[i]
    carried.mass32[i] = float(mass)
    inverse = float(0.0)
    if carried.held[i] == wp.uint8(0) and mass > wp.float64(0.0):
        inverse = float(wp.float64(1.0) / mass)
    carried.inverse_mass[i] = inverse


@wp.kernel(enable_backward=False)
def refresh_masses(
    # In
    threads: int,
    pools: Pools,
    # In and out
    carried: Carried,
):
    """Update the masses for stepping, if anything has changed."""
    count = pools.counts[NODE_TOP]
    if pools.counts[ADDED] + pools.counts[REMOVED] == 0:
        count = 0
    for i in range(wp.tid(), count, threads):
        refresh_mass(i, carried)
