"""What is derived from a changed mesh: points bound to it, nodes that follow keyframes, materials of its leaves, and
limits of the time step.

The limits are those of the stiffest elements for their size and mass, and their number: an element among elements of
its size vibrates faster than one among larger ones, so the finest level alone is not enough."""

import warp as wp

from warp_corot.kernels.corotated.anisotropic import vec9
from warp_corot.kernels.math.rotation import identity3
from warp_corot.kernels.meshing.bisection import in_child, refinement_end
from warp_corot.kernels.plan.plan import Plan, extent, leaf_row
from warp_corot.kernels.remesh.pools import LEAVES, MIXED_ROWS, NO_ROW, NODE_TOP, Carried, Pools, modulus_of

wp.set_module_options({"enable_backward": False})


@wp.kernel(enable_backward=False)
def bind_points(
    # In
    roots: wp.array[wp.int32],
    inside: wp.array[wp.vec4d],
    points: wp.array[wp.vec4d],
    pools: Pools,
    # Out
    nodes: wp.array[wp.vec4i],
    weights: wp.array[wp.vec4],
):
    """The leaf below each root that contains the point ``inside``, and the coordinates of ``points`` in it.

    Both are barycentric in the root. A point outside the mesh follows the nearest leaf.
    """
    i = wp.tid()
    element = roots[i]
    way = inside[i]
    w = points[i]
    while pools.first_child[element] >= 0:
        k = refinement_end(pools.level[element])
        second = way[0] < way[k]
        element = pools.first_child[element] + wp.where(second, 1, 0)
        way = in_child(way, k, second)
        w = in_child(w, k, second)
    nodes[i] = pools.tets[element]
    weights[i] = wp.vec4(float(w[0]), float(w[1]), float(w[2]), float(w[3]))


@wp.kernel(enable_backward=False)
def find_node_levels(pools: Pools, levels: wp.array[wp.int32]):
    """The largest level of the leaves around each node; ``levels`` is zero before."""
    i = wp.tid()
    if i >= pools.counts[LEAVES]:
        return
    leaf = pools.leaves[i]
    for k in range(4):
        wp.atomic_max(levels, pools.tets[leaf][k], pools.level[leaf])


@wp.kernel(enable_backward=False)
def find_point_levels(
    nodes: wp.array[wp.vec4i], weights: wp.array[wp.vec4], of_nodes: wp.array[wp.int32], levels: wp.array[wp.int32]
):
    """The level of the node with the largest weight at each point."""
    i = wp.tid()
    largest = int(0)
    for k in range(4):
        if weights[i][k] > weights[i][largest]:
            largest = k
    levels[i] = of_nodes[nodes[i][largest]]


#: Counts: nodes that follow keyframes, and those among them whose row is not known yet.
FOLLOWERS = wp.constant(0)
MIXED = wp.constant(1)
FOLLOWER_PLACES = 2


@wp.kernel(enable_backward=False)
def list_followers(
    # In
    threads: int,
    goes: wp.array[wp.int32],
    pools: Pools,
    carried: Carried,
    # Out
    nodes: wp.array[wp.int32],
    rows: wp.array[wp.int32],
    found: wp.array[wp.int32],
):
    """List nodes with their rows, in any order, if ``goes`` [1] is not zero."""
    count = pools.counts[NODE_TOP]
    if goes[0] == 0:
        count = 0
    for i in range(wp.tid(), count, threads):
        row = carried.row[i]
        if row != NO_ROW:
            place = wp.atomic_add(found, FOLLOWERS, 1)
            nodes[place] = i
            rows[place] = row
            if row == MIXED_ROWS:
                wp.atomic_add(found, MIXED, 1)


@wp.kernel(enable_backward=False)
def assemble_materials(
    # In
    threads: int,
    pools: Pools,
    plan: Plan,
    axes_row: int,
    stiffness_row: int,
    # Out
    axes: wp.array[wp.mat33],
    stiffness: wp.array[vec9],
):
    """Axes and stiffness of each leaf, each from nine rows of values from a first row on; a negative row: none.

    Padding has the identity and zero.
    """
    for i in range(wp.tid(), extent(leaf_row(plan), plan), threads):
        is_leaf = i < pools.counts[LEAVES]
        if axes_row >= 0:
            m = identity3()
            for n in range(9):
                if is_leaf:
                    m[n / 3, n % 3] = plan.values[axes_row + n, i]
            axes[i] = m
        if stiffness_row >= 0:
            c = vec9()
            for n in range(9):
                c[n] = plan.values[stiffness_row + n, i]
            stiffness[i] = c


#: The result: the stiffest element, then for each level some sums whose total is, for the finest level, the number of
#: its leaves; of other levels threads with finer leaves count none.
STIFFEST = wp.constant(0)
PARTIAL_SUMS = wp.constant(16)


@wp.kernel(enable_backward=False)
def survey_leaves(
    # In
    threads: int,
    goes: wp.array[wp.int32],
    modulus: float,
    pools: Pools,
    carried: Carried,
    # Out
    found: wp.array[wp.int32],
):
    """Largest (2 mu + lambda) / (density volume^(2/3)) [1/s^2] of the leaves, as a float's bits, and the number of
    leaves of the finest level.

    ``modulus`` is 2 mu + lambda [Pa] if all elements have the same.
    """
    count = wp.where(goes[0] != 0, pools.counts[LEAVES], 0)
    most = float(0.0)
    finest = int(0)
    own = int(0)
    for i in range(wp.tid(), count, threads):
        e = pools.leaves[i]
        level = pools.level[e]
        size = carried.size[level]
        most = wp.max(most, modulus_of(e, modulus, carried) / float(carried.density[e] * size * size))
        if level > finest:
            finest = level
            own = 0
        if level == finest:
            own += 1
    # Positive floats have the order of their bits. Few threads reach the write.
    bits = wp.cast(most, wp.int32)
    if bits > found[STIFFEST]:
        wp.atomic_max(found, STIFFEST, bits)
    if own > 0:
        wp.atomic_add(found, 1 + PARTIAL_SUMS * finest + wp.tid() % PARTIAL_SUMS, own)
