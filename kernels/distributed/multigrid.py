"""Transfers between the finest level of multigrid, in parts, and the next coarser one, which every rank holds."""

import warp as wp

from warp_corot.kernels.elements.elements import load_node, store_node

wp.set_module_options({"enable_backward": False})


@wp.kernel(enable_backward=False)
def add_correction(
    # In
    coarse: int,
    fine: int,
    free: wp.array[wp.uint8],
    ends: wp.array[wp.vec2i],
    correction: wp.array[wp.vec4],
    # In and out
    z: wp.array[wp.vec4],
):
    """z += the mean of the coarser level's correction at the ends of each node's edge, at free nodes; the ends of a
    coarser node are the node itself."""
    world, i = wp.tid()
    at = world * fine + i
    if free[at] == wp.uint8(0):
        return
    pair = ends[i]
    first = world * coarse
    value = 0.5 * (load_node(correction, first + pair[0]) + load_node(correction, first + pair[1]))
    store_node(z, at, load_node(z, at) + value)
