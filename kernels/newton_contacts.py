"""What acts between particles and rigid bodies of a Newton model: soft contacts with friction, and attachments.

Every force on a particle is taken from the body, wrench about its centre of mass, so momentum is exchanged exactly.
Damping and friction turn no particle's velocity round within a step, however light it is: so much of the law as would
do that is left out. A particle that touches several shapes is still slowed down by each.
"""

import warp as wp

from .elements import add_force
from .newton_particles import ACTIVE
from .newton_worlds import SURFACE_CONTACTS, place_of

wp.set_module_options({"enable_backward": False})


@wp.struct
class ContactLaw:
    """Parameters of particles; contacts take the mean of these and the shape's."""

    stiffness: float  # [N/m]
    damping: float  # [N s/m]
    friction_slope: float  # [N s/m]
    friction: float
    adhesion: float  # distance up to which a particle is held [m]


@wp.func
def body_point_velocity(twist: wp.spatial_vector, arm: wp.vec3):
    """Velocity of a point of a body, at ``arm`` from its centre of mass."""
    return wp.spatial_top(twist) + wp.cross(wp.spatial_bottom(twist), arm)


@wp.func
def contact_force(
    normal: wp.vec3, gap: float, v: wp.vec3, stiffness: float, damping: float, slope: float, mu: float, most: float
):
    """Force on the particle [N]: spring and damper along the normal, regularised Coulomb friction across it.

    Args:
        v: Velocity of the particle relative to the body's point.
        most: Mass over time step: what stops a velocity of one within the step [kg/s].
    """
    towards = wp.dot(normal, v)
    push = -stiffness * gap
    if gap < 0.0 and towards < 0.0:
        push -= wp.min(damping, most) * towards
    sliding = v - towards * normal
    speed = wp.length(sliding)
    drag = wp.min(wp.min(slope, most) * speed, mu * wp.max(push, 0.0))
    force = push * normal
    if speed > 0.0:
        force -= (drag / speed) * sliding
    return force


@wp.kernel(enable_backward=False)
def scatter_soft_contacts(
    # In
    law: ContactLaw,
    dt: float,
    count: wp.array[wp.int32],
    contact_particle: wp.array[wp.int32],
    contact_indices: wp.array[wp.vec3i],
    contact_shape: wp.array[wp.int32],
    contact_point: wp.array[wp.vec3],
    contact_velocity: wp.array[wp.vec3],
    contact_normal: wp.array[wp.vec3],
    shape_body: wp.array[wp.int32],
    shape_margin: wp.array[wp.float32],
    shape_ke: wp.array[wp.float32],
    shape_kd: wp.array[wp.float32],
    shape_kf: wp.array[wp.float32],
    shape_mu: wp.array[wp.float32],
    flags: wp.array[wp.int32],
    world: wp.array[wp.int32],
    radius: wp.array[wp.float32],
    inverse_mass: wp.array[wp.float32],
    q: wp.array[wp.vec3],
    qd: wp.array[wp.vec3],
    body_q: wp.array[wp.transform],
    body_qd: wp.array[wp.spatial_vector],
    body_com: wp.array[wp.vec3],
    # Out
    f: wp.array[wp.vec4],
    body_f: wp.array[wp.spatial_vector],
    trouble: wp.array[wp.int32],
):
    """Penalty forces of the contacts that Newton's collision pipeline found; points in the body's frame."""
    c = wp.tid()
    if c >= wp.min(count[0], contact_particle.shape[0]):
        return
    i = contact_particle[c]
    if i < 0:
        # A contact of an edge or a face.
        wp.atomic_max(trouble, place_of(world[contact_indices[c][0]], trouble.shape[0]), SURFACE_CONTACTS)
        return
    if (flags[i] & ACTIVE) == 0:
        return
    shape = contact_shape[c]
    body = shape_body[shape]
    point = contact_point[c]
    velocity = contact_velocity[c]
    arm = wp.vec3()
    if body >= 0:
        pose = body_q[body]
        point = wp.transform_point(pose, point)
        arm = point - wp.transform_point(pose, body_com[body])
        velocity = wp.transform_vector(pose, velocity) + body_point_velocity(body_qd[body], arm)
    normal = contact_normal[c]
    margin = float(0.0)
    if shape_margin.shape[0] > 0:
        margin = shape_margin[shape]
    gap = wp.dot(normal, q[i] - point) - radius[i] - margin
    if gap > law.adhesion:
        return
    most = float(1.0e30)
    if inverse_mass[i] > 0.0:
        most = 1.0 / (inverse_mass[i] * dt)
    force = contact_force(
        normal,
        gap,
        qd[i] - velocity,
        0.5 * (law.stiffness + shape_ke[shape]),
        0.5 * (law.damping + shape_kd[shape]),
        0.5 * (law.friction_slope + shape_kf[shape]),
        0.5 * (law.friction + shape_mu[shape]),
        most,
    )
    add_force(f, i, force)
    if body >= 0:
        wp.atomic_sub(body_f, body, wp.spatial_vector(force, wp.cross(arm, force)))


@wp.kernel(enable_backward=False)
def scatter_attachments(
    # In
    particle: wp.array[wp.int32],
    body: wp.array[wp.int32],
    body_point: wp.array[wp.vec3],
    stiffness: wp.array[wp.float32],
    damping: wp.array[wp.float32],
    enabled: wp.array[wp.bool],
    q: wp.array[wp.vec3],
    qd: wp.array[wp.vec3],
    body_q: wp.array[wp.transform],
    body_qd: wp.array[wp.spatial_vector],
    body_com: wp.array[wp.vec3],
    # Out
    f: wp.array[wp.vec4],
    body_f: wp.array[wp.spatial_vector],
):
    """Springs of no length with dampers between particles and points of bodies."""
    a = wp.tid()
    if not enabled[a]:
        return
    i = particle[a]
    b = body[a]
    pose = body_q[b]
    point = wp.transform_point(pose, body_point[a])
    arm = point - wp.transform_point(pose, body_com[b])
    relative = qd[i] - body_point_velocity(body_qd[b], arm)
    force = -stiffness[a] * (q[i] - point) - damping[a] * relative
    add_force(f, i, force)
    wp.atomic_sub(body_f, b, wp.spatial_vector(force, wp.cross(arm, force)))


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
