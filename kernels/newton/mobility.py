"""Mobility of a particle and a body at their contact, and the largest damping that they can follow."""

import warp as wp

wp.set_module_options({"enable_backward": False})

#: More than any limit.
NO_LIMIT = wp.constant(1.0e30)


@wp.func
def body_point_velocity(twist: wp.spatial_vector, arm: wp.vec3):
    """Velocity of a point of a body, at ``arm`` from its centre of mass."""
    return wp.spatial_top(twist) + wp.cross(wp.spatial_bottom(twist), arm)


@wp.struct
class Mobility:
    """Response of a particle, and of a body's piece at a contact."""

    particle: float  # 1/m [1/kg]
    linear: float  # 1/m of the body's piece [1/kg]
    angular: wp.mat33  # inverse inertia of the piece in world axes [1/(kg m^2)]
    arm: wp.vec3  # from the body's centre of mass [m]


@wp.func
def mobility_of(
    particle: float,
    body: int,
    places: wp.array[wp.int32],
    fixed_flag: int,
    body_flags: wp.array[wp.int32],
    inverse_mass: wp.array[wp.float32],
    inverse_inertia: wp.array[wp.mat33],
    pose: wp.transform,
    arm: wp.vec3,
):
    """The mobility of a particle with an inverse mass, and of a body; its share if it is touched in several places."""
    m = Mobility()
    m.particle = particle
    m.arm = arm
    if body >= 0:  # noqa: SIM102 - the next value exists only then
        if (body_flags[body] & fixed_flag) == 0:
            n = float(wp.max(places[body], 1))
            rotation = wp.quat_to_matrix(wp.transform_get_rotation(pose))
            m.linear = n * inverse_mass[body]
            m.angular = n * (rotation * inverse_inertia[body] * wp.transpose(rotation))
    return m


@wp.func
def body_mobility(m: Mobility, direction: wp.vec3):
    """Inverse mass of the body's piece at the contact along a unit vector [1/kg]."""
    a = wp.cross(m.arm, direction)
    return m.linear + wp.dot(a, m.angular * a)


@wp.func
def most_damping(m: Mobility, direction: wp.vec3, dt: float):
    """The damping that stops the relative velocity along a unit vector within a step [kg/s]."""
    w = m.particle + body_mobility(m, direction)
    most = float(NO_LIMIT)
    if w > 0.0:
        most = 1.0 / (w * dt)
    return most


@wp.func
def spring_row(normal: wp.vec3, arm: wp.vec3):
    """Velocity of a body's point at ``arm`` along a unit vector, as a row for the body's twist."""
    return wp.spatial_vector(normal, wp.cross(arm, normal))
