"""Rigid bodies within a step, between the states that another solver gives."""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.kernel(enable_backward=False)
def move_bodies(
    # In
    elapsed: float,
    body_q: wp.array[wp.transform],
    body_qd: wp.array[wp.spatial_vector],
    body_com: wp.array[wp.vec3],
    # Out
    moved: wp.array[wp.transform],
):
    """Poses after a time [s] at constant velocities of the centres of mass and constant angular velocities."""
    b = wp.tid()
    pose, twist = body_q[b], body_qd[b]
    spin = wp.spatial_bottom(twist)
    angle = elapsed * wp.length(spin)
    rotation = wp.transform_get_rotation(pose)
    if angle > 0.0:
        rotation = wp.quat_from_axis_angle(wp.normalize(spin), angle) * rotation
    centre = wp.transform_point(pose, body_com[b]) + elapsed * wp.spatial_top(twist)
    moved[b] = wp.transform(centre - wp.quat_rotate(rotation, body_com[b]), rotation)


@wp.kernel(enable_backward=False)
def add_wrenches(
    # In
    share: float,
    a: wp.array[wp.spatial_vector],
    # In and out
    b: wp.array[wp.spatial_vector],
):
    i = wp.tid()
    b[i] = b[i] + share * a[i]
