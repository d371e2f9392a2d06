"""Attachments of particles to rigid bodies: springs with dampers, which act on both."""

import warp as wp

from warp_corot.kernels.elements.elements import add_force

from .mobility import body_mobility, body_point_velocity, mobility_of

wp.set_module_options({"enable_backward": False})


@wp.kernel(enable_backward=False)
def scatter_attachments(
    # In
    dt: float,
    particle: wp.array[wp.int32],
    body: wp.array[wp.int32],
    body_point: wp.array[wp.vec3],
    stiffness: wp.array[wp.float32],
    damping: wp.array[wp.float32],
    enabled: wp.array[wp.bool],
    inverse_mass: wp.array[wp.float32],
    q: wp.array[wp.vec3],
    qd: wp.array[wp.vec3],
    fixed_flag: int,
    body_flags: wp.array[wp.int32],
    body_inverse_mass: wp.array[wp.float32],
    body_inverse_inertia: wp.array[wp.mat33],
    places: wp.array[wp.int32],
    body_q: wp.array[wp.transform],
    body_qd: wp.array[wp.spatial_vector],
    body_com: wp.array[wp.vec3],
    yielding: wp.array[wp.spatial_vector],
    # Out
    f: wp.array[wp.vec4],
    body_f: wp.array[wp.spatial_vector],
):
    """Springs of zero rest length with dampers between particles and points of bodies."""
    a = wp.tid()
    if not enabled[a]:
        return
    i = particle[a]
    b = body[a]
    pose = body_q[b]
    point = wp.transform_point(pose, body_point[a])
    arm = point - wp.transform_point(pose, body_com[b])
    relative = qd[i] - body_point_velocity(body_qd[b], arm)
    m = mobility_of(
        inverse_mass[i], b, places, fixed_flag, body_flags, body_inverse_mass, body_inverse_inertia, pose, arm
    )
    # The sum over three directions exceeds any single one.
    every = body_mobility(m, wp.vec3(1.0, 0.0, 0.0))
    every += body_mobility(m, wp.vec3(0.0, 1.0, 0.0)) + body_mobility(m, wp.vec3(0.0, 0.0, 1.0))
    d = float(damping[a])
    if every + m.particle > 0.0:
        d = wp.min(d, 1.0 / ((every + m.particle) * dt))
    point += body_point_velocity(yielding[b], arm)
    force = -stiffness[a] * (q[i] - point) - d * relative
    add_force(f, i, force)
    wp.atomic_sub(body_f, b, wp.spatial_vector(force, wp.cross(arm, force)))
