"""Values of elements at the points of a shown surface: averages at nodes, by volume, carried to bound points."""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.kernel(enable_backward=False)
def add_to_nodes(
    # In
    values: wp.array[wp.float32],
    tets: wp.array[wp.vec4i],
    volumes: wp.array[wp.float32],
    # In and out
    sums: wp.array[wp.float32],
):
    """Add an element's value times its volume to its nodes."""
    e = wp.tid()
    part = volumes[e] * values[e]
    for n in range(4):
        wp.atomic_add(sums, tets[e][n], part)


@wp.kernel(enable_backward=False)
def carry_to_points(
    # In
    nodes: wp.array[wp.vec4i],
    weights: wp.array[wp.vec4],
    sums: wp.array[wp.float32],
    volumes: wp.array[wp.float32],
    # Out
    values: wp.array[wp.float32],
):
    """The averages at the nodes that a point is bound to, by its weights; ``volumes`` are those around each node."""
    i = wp.tid()
    value = float(0.0)
    for n in range(4):
        node = nodes[i][n]
        if weights[i][n] != 0.0:
            value += weights[i][n] * sums[node] / wp.max(volumes[node], 1.0e-30)
    values[i] = value
