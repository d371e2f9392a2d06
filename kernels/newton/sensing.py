"""Sums of contact forces over what a sensor watches."""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.kernel(enable_backward=False)
def sum_soft_contacts(
    # In
    count: wp.array[wp.int32],
    contact_shape: wp.array[wp.int32],
    contact_normal: wp.array[wp.vec3],
    first_row: int,
    wrenches: wp.array[wp.spatial_vector],
    row_of_shape: wp.array[wp.int32],
    # Out
    force: wp.array[wp.vec3],
    friction: wp.array[wp.vec3],
):
    """Add the forces on watched shapes, and their parts across the normals [N]; a row of -1 is not watched."""
    c = wp.tid()
    if c >= wp.min(count[0], contact_shape.shape[0]):
        return
    row = row_of_shape[contact_shape[c]]
    if row < 0:
        return
    f = wp.spatial_top(wrenches[first_row + c])
    n = contact_normal[c]
    wp.atomic_add(force, row, f)
    wp.atomic_add(friction, row, f - wp.dot(f, n) * n)
