"""Points that follow a mesh while its elements change."""

import warp as wp

from warp_corot.kernels.meshing.bisection import refinement_end

from .pools import LEAVES, Pools

wp.set_module_options({"enable_backward": False})


@wp.func
def in_child(w: wp.vec4d, k: int, second: bool):
    """Barycentric coordinates in a child from those in its parent, whose refinement edge is x0-xk."""
    lower = w[0]
    upper = w[k]
    child = w
    if second:
        for n in range(3):
            if n + 1 <= k:
                child[n] = w[n + 1]
        child[k - 1] = upper - lower
        child[k] = wp.float64(2.0) * lower
    else:
        child[0] = lower - upper
        child[k] = wp.float64(2.0) * upper
    return child


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
