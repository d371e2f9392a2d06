"""Transfers between levels: linear interpolation on an edge, and its transpose, gathered."""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.kernel(enable_backward=False)
def average_ends(
    # In
    world_nodes: int,
    nodes: wp.array[wp.int32],
    ends: wp.array[wp.vec2i],
    # In and out
    x: wp.array[wp.vec4],
):
    """The mean of both ends at each node of a level."""
    world, i = wp.tid()
    first = world * world_nodes
    x[first + nodes[i]] = 0.5 * (x[first + ends[i][0]] + x[first + ends[i][1]])


@wp.kernel(enable_backward=False)
def gather_midpoints(
    # In
    world_nodes: int,
    coarse: wp.array[wp.int32],
    starts: wp.array[wp.int32],
    midpoints: wp.array[wp.int32],
    # In and out
    y: wp.array[wp.vec4],
):
    """Add half of the values at a level's nodes to the ends of their edges; ``starts`` has one more entry."""
    world, i = wp.tid()
    first = world * world_nodes
    total = wp.vec4(0.0)
    for at in range(starts[i], starts[i + 1]):
        total += y[first + midpoints[at]]
    y[first + coarse[i]] += 0.5 * total
