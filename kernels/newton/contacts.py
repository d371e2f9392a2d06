"""Forces between soft surfaces and rigid bodies of a Newton model: soft contacts with friction.

A contact is at a particle, or at a point of an edge or a triangle, where the particles share the force by their
weights. Every force acts on the body with the opposite sign, as a wrench about its centre of mass, so momentum is
exchanged exactly. Damping and friction do not reverse a relative velocity within a step, however light particle and
body are: the part of the law that would do so is left out. A body that is touched in n places counts in each as a
piece of 1/n of its mass and inertia, which bounds their total effect; particles in many contacts likewise, see
``touching``. If every contact has a particle of its own, one that touches several shapes is still slowed down by each.
Springs act on the body at the position to which it yields; see ``yielding``.
"""

import warp as wp

from .mobility import Mobility, body_point_velocity, mobility_of, most_damping, spring_row
from .touching import (
    add_to_point,
    contact_gap,
    is_active,
    largest_of,
    mean_of,
    mobility_of_point,
    point_of,
    pull_of,
    share_of,
)

wp.set_module_options({"enable_backward": False})

#: If a body yields entirely to springs, this fraction of the strongest damper acts, too: explicit steps return up
#: to a quarter more energy than they took from a contact that lasts only a few of them.
LOSS = wp.constant(0.5)


@wp.struct
class ContactLaw:
    """Parameters of particles; contacts use the mean of these and the shape's."""

    stiffness: float  # [N/m]
    damping: float  # [N s/m]
    friction_slope: float  # [N s/m]
    friction: float
    adhesion: float  # distance up to which a particle adheres [m]
    crowd: float  # most times the stiffness of one contact at a particle


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
        gap: Gap after the body has yielded.
        v: Velocity of the particle relative to the body's point.
        pull: Change of this velocity by all other forces in this step [m/s].
        yielded: Fraction of the gap that yielding closes.
    """
    towards = wp.dot(normal, v)
    push = -stiffness * gap
    if gap < 0.0 and towards < 0.0:
        most = most_damping(m, normal, dt)
        push -= wp.min(damping + LOSS * yielded * most, most) * towards
    # Implicit in the velocity that there would be without friction. With the current velocity, a force on a light
    # particle would move it by one step's change of velocity in every step, however strong the friction.
    sliding = v + pull
    sliding -= wp.dot(normal, sliding) * normal
    speed = wp.length(sliding)
    force = push * normal
    if speed > 0.0 and slope > 0.0:
        across = sliding / speed
        drag = wp.min(speed / (1.0 / slope + 1.0 / most_damping(m, across, dt)), mu * wp.max(push, 0.0))
        force -= drag * across
    return force


@wp.kernel(enable_backward=False)
def scatter_soft_contacts(
    # In
    law: ContactLaw,
    dt: float,
    count: wp.array[wp.int32],
    contact_particle: wp.array[wp.int32],
    contact_nodes: wp.array[wp.vec3i],
    contact_weights: wp.array[wp.vec3],
    load: wp.array[wp.float32],
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
    share: float,
    first_row: int,
    # Out
    f: wp.array[wp.vec4],
    body_f: wp.array[wp.spatial_vector],
    reported: wp.array[wp.spatial_vector],
):
    """Penalty forces of the contacts that Newton's collision pipeline found; points in the body's frame.

    Args:
        share: The substep's share of the step, for the mean wrench of each contact on its shape's body [N, N m], about
            the body's centre of mass or, for a fixed shape, the origin.
        first_row: The row of ``reported`` for the first contact; ``reported`` may be empty.
    """
    c = wp.tid()
    if c >= wp.min(count[0], contact_particle.shape[0]):
        return
    p = point_of(c, contact_particle, contact_nodes, contact_weights)
    if not is_active(p, flags):
        return
    shape = contact_shape[c]
    body = shape_body[shape]
    point = contact_point[c]
    velocity = contact_velocity[c]
    arm = contact_point[c]
    pose = wp.transform_identity()
    if body >= 0:
        pose = body_q[body]
        point = wp.transform_point(pose, point)
        arm = point - wp.transform_point(pose, body_com[body])
        velocity = wp.transform_vector(pose, velocity) + body_point_velocity(body_qd[body], arm)
    normal = contact_normal[c]
    gap = contact_gap(normal, mean_of(p, q), largest_of(p, radius), point, shape, shape_margin)
    yielded = float(0.0)
    if body >= 0:
        less = wp.dot(spring_row(normal, arm), yielding[body])
        if gap < 0.0:
            yielded = wp.clamp(less / gap, 0.0, 1.0)
        gap -= less
    if gap > law.adhesion:
        return
    m = mobility_of(
        mobility_of_point(p, load, inverse_mass, flags),
        body,
        places,
        fixed_flag,
        body_flags,
        body_inverse_mass,
        body_inverse_inertia,
        pose,
        arm,
    )
    force = p.measure * contact_force(
        normal,
        gap,
        mean_of(p, qd) - velocity,
        0.5 * share_of(p, load, law.crowd) * (law.stiffness + shape_ke[shape]),
        0.5 * (law.damping + shape_kd[shape]),
        0.5 * (law.friction_slope + shape_kf[shape]),
        0.5 * (law.friction + shape_mu[shape]),
        pull_of(p, dt, inverse_mass, flags, world, gravity, before),
        m,
        yielded,
        dt,
    )
    add_to_point(p, force, f)
    wrench = -wp.spatial_vector(force, wp.cross(arm, force))
    if body >= 0:
        wp.atomic_add(body_f, body, wrench)
    if reported.shape[0] > 0:
        reported[first_row + c] += share * wrench


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
