"""What acts between particles and rigid bodies of a Newton model: soft contacts with friction, and attachments.

Every force on a particle is taken from the body, wrench about its centre of mass, so momentum is exchanged exactly.
Damping and friction turn no relative velocity round within a step, however light particle and body are: so much of the
law as would do that is left out. A body that is touched in n places counts in each as a piece of 1/n of its mass and
inertia, which bounds what all of them do together. A particle that touches several shapes is still slowed down by
each. Springs act on the body where it would give way to them; see ``yielding``.
"""

import warp as wp

from warp_corot.kernels.elements.elements import add_force, load_node

from .mobility import Mobility, body_mobility, body_point_velocity, mobility_of, most_damping, spring_row
from .particles import ACTIVE
from .worlds import SURFACE_CONTACTS, place_of

wp.set_module_options({"enable_backward": False})

#: Where a body gives way to springs entirely, this share of the strongest damper acts, too: explicit steps give back up
#: to a quarter more than they got from a contact that lasts only a few of them.
LOSS = wp.constant(0.5)


@wp.struct
class ContactLaw:
    """Parameters of particles; contacts take the mean of these and the shape's."""

    stiffness: float  # [N/m]
    damping: float  # [N s/m]
    friction_slope: float  # [N s/m]
    friction: float
    adhesion: float  # distance up to which a particle is held [m]


@wp.func
def contact_force(
    normal: wp.vec3,
    gap: float,
    v: wp.vec3,
    stiffness: float,
    damping: float,
    slope: float,
    mu: float,
    pull: wp.vec3,
    m: Mobility,
    yielded: float,
    dt: float,
):
    """Force on the particle [N]: spring and damper along the normal, regularised Coulomb friction across it.

    Args:
        gap: As the body gives way.
        v: Velocity of the particle relative to the body's point.
        pull: What all other forces add to it in this step [m/s].
        yielded: Share of the gap that is gone by that.
    """
    towards = wp.dot(normal, v)
    push = -stiffness * gap
    if gap < 0.0 and towards < 0.0:
        most = most_damping(m, normal, dt)
        push -= wp.min(damping + LOSS * yielded * most, most) * towards
    # Implicit, of the velocity that there would be without friction. Of the present one, what pulls at a light particle
    # would move it on by a step's worth of that every step, however much friction there may be.
    sliding = v + pull
    sliding -= wp.dot(normal, sliding) * normal
    speed = wp.length(sliding)
    force = push * normal
    if speed > 0.0 and slope > 0.0:
        across = sliding / speed
        drag = wp.min(speed / (1.0 / slope + 1.0 / most_damping(m, across, dt)), mu * wp.max(push, 0.0))
        force -= drag * across
    return force


@wp.func
def contact_gap(
    normal: wp.vec3, x: wp.vec3, radius: float, point: wp.vec3, shape: int, shape_margin: wp.array[wp.float32]
):
    gap = wp.dot(normal, x - point) - radius
    if shape_margin.shape[0] > 0:
        gap -= shape_margin[shape]
    return gap


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
    gravity: wp.array[wp.vec3],
    before: wp.array[wp.vec4],
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
    pose = wp.transform_identity()
    if body >= 0:
        pose = body_q[body]
        point = wp.transform_point(pose, point)
        arm = point - wp.transform_point(pose, body_com[body])
        velocity = wp.transform_vector(pose, velocity) + body_point_velocity(body_qd[body], arm)
    normal = contact_normal[c]
    gap = contact_gap(normal, q[i], radius[i], point, shape, shape_margin)
    yielded = float(0.0)
    if body >= 0:
        less = wp.dot(spring_row(normal, arm), yielding[body])
        if gap < 0.0:
            yielded = wp.clamp(less / gap, 0.0, 1.0)
        gap -= less
    if gap > law.adhesion:
        return
    m = mobility_of(
        inverse_mass[i],
        body,
        places,
        fixed_flag,
        body_flags,
        body_inverse_mass,
        body_inverse_inertia,
        pose,
        arm,
    )
    pull = wp.vec3()
    if inverse_mass[i] > 0.0:
        pull = dt * (inverse_mass[i] * load_node(before, i) + gravity[place_of(world[i], gravity.shape[0])])
    force = contact_force(
        normal,
        gap,
        qd[i] - velocity,
        0.5 * (law.stiffness + shape_ke[shape]),
        0.5 * (law.damping + shape_kd[shape]),
        0.5 * (law.friction_slope + shape_kf[shape]),
        0.5 * (law.friction + shape_mu[shape]),
        pull,
        m,
        yielded,
        dt,
    )
    add_force(f, i, force)
    if body >= 0:
        wp.atomic_sub(body_f, body, wp.spatial_vector(force, wp.cross(arm, force)))


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
    m = mobility_of(
        inverse_mass[i], b, places, fixed_flag, body_flags, body_inverse_mass, body_inverse_inertia, pose, arm
    )
    # The sum over three directions is more than any one's.
    every = body_mobility(m, wp.vec3(1.0, 0.0, 0.0))
    every += body_mobility(m, wp.vec3(0.0, 1.0, 0.0)) + body_mobility(m, wp.vec3(0.0, 0.0, 1.0))
    d = float(damping[a])
    if every + m.particle > 0.0:
        d = wp.min(d, 1.0 / ((every + m.particle) * dt))
    point += body_point_velocity(yielding[b], arm)
    force = -stiffness[a] * (q[i] - point) - d * relative
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
