"""How far bodies yield to springs of contacts and attachments within a step.

Together, the springs of many contacts are far too stiff for explicit steps of a light body. So they act
on the body not at its position but at the one to which it would yield: their energy V becomes its Moreau envelope in
the metric of the body's mass matrix M,

    V'(x, b) = min over d of V(x, b + d) + d . M d / (2 dt^2),

with particles x, the body b, and its small displacement and rotation d. The gradient is that of V at b + d: every
spring still connects a particle and the body, only shorter. V' is an energy, so contacts that come and go add none;
M^-1 times its curvature is below 1/dt^2 for any number and stiffness of springs; without stiff springs, d vanishes. At
rest springs carry the same forces, with the body deeper by g dt^2. V is quadratic except for the set of closed
contacts, so Newton's method finds d.
"""

import warp as wp

from .contacts import ContactLaw
from .mobility import spring_row
from .touching import contact_gap, is_active, largest_of, mean_of, point_of, share_of

wp.set_module_options({"enable_backward": False})


@wp.kernel(enable_backward=False)
def gather_soft_contacts(
    # In
    law: ContactLaw,
    count: wp.array[wp.int32],
    contact_particle: wp.array[wp.int32],
    contact_nodes: wp.array[wp.vec3i],
    contact_weights: wp.array[wp.vec3],
    load: wp.array[wp.float32],
    contact_shape: wp.array[wp.int32],
    contact_point: wp.array[wp.vec3],
    contact_normal: wp.array[wp.vec3],
    shape_body: wp.array[wp.int32],
    shape_margin: wp.array[wp.float32],
    shape_ke: wp.array[wp.float32],
    flags: wp.array[wp.int32],
    radius: wp.array[wp.float32],
    q: wp.array[wp.vec3],
    fixed_flag: int,
    body_flags: wp.array[wp.int32],
    body_q: wp.array[wp.transform],
    body_com: wp.array[wp.vec3],
    yielding: wp.array[wp.spatial_vector],
    number: int,
    # In and out
    places: wp.array[wp.int32],
    curvature: wp.array[wp.spatial_matrix],
    slope: wp.array[wp.spatial_vector],
):
    """Gather the data of contacts for ``solve_yielding`` that hold after bodies have yielded so far; the first time, of
    those that hold at the current positions, and the number of places where each body is touched."""
    c = wp.tid()
    if c >= wp.min(count[0], contact_particle.shape[0]):
        return
    p = point_of(c, contact_particle, contact_nodes, contact_weights)
    shape = contact_shape[c]
    body = shape_body[shape]
    if body < 0 or not is_active(p, flags):
        return
    if (body_flags[body] & fixed_flag) != 0:
        return
    point = wp.transform_point(body_q[body], contact_point[c])
    arm = point - wp.transform_point(body_q[body], body_com[body])
    row = spring_row(contact_normal[c], arm)
    gap = contact_gap(contact_normal[c], mean_of(p, q), largest_of(p, radius), point, shape, shape_margin)
    now = float(gap)
    if number > 0:
        now -= wp.dot(row, yielding[body])
    if now <= law.adhesion:
        k = 0.5 * p.measure * share_of(p, load, law.crowd) * (law.stiffness + shape_ke[shape])
        wp.atomic_add(curvature, body, k * wp.outer(row, row))
        wp.atomic_add(slope, body, k * gap * row)
        if number == 0:
            wp.atomic_add(places, body, 1)


@wp.kernel(enable_backward=False)
def gather_attachments(
    # In
    particle: wp.array[wp.int32],
    body: wp.array[wp.int32],
    body_point: wp.array[wp.vec3],
    stiffness: wp.array[wp.float32],
    enabled: wp.array[wp.bool],
    q: wp.array[wp.vec3],
    body_q: wp.array[wp.transform],
    body_com: wp.array[wp.vec3],
    number: int,
    # In and out
    places: wp.array[wp.int32],
    curvature: wp.array[wp.spatial_matrix],
    slope: wp.array[wp.spatial_vector],
):
    """Gather the data of attachments like ``gather_soft_contacts``."""
    a = wp.tid()
    if not enabled[a]:
        return
    b = body[a]
    point = wp.transform_point(body_q[b], body_point[a])
    arm = point - wp.transform_point(body_q[b], body_com[b])
    apart = q[particle[a]] - point
    k = stiffness[a]
    sum = wp.spatial_matrix()
    for axis in range(3):
        direction = wp.vec3()
        direction[axis] = 1.0
        row = spring_row(direction, arm)
        sum += wp.outer(row, row)
    wp.atomic_add(curvature, b, k * sum)
    wp.atomic_add(slope, b, k * wp.spatial_vector(apart, wp.cross(arm, apart)))
    if number == 0:
        wp.atomic_add(places, b, 1)


@wp.func
def factor_of(a: wp.mat33):
    """L with L L^T = a, symmetric and positive semi-definite."""
    r = wp.mat33()
    for j in range(3):
        rest = a[j, j] - r[j, 0] * r[j, 0] - r[j, 1] * r[j, 1] - r[j, 2] * r[j, 2]
        if rest > 1.0e-6 * a[j, j]:
            r[j, j] = wp.sqrt(rest)
            for i in range(j + 1, 3):
                r[i, j] = (a[i, j] - r[i, 0] * r[j, 0] - r[i, 1] * r[j, 1] - r[i, 2] * r[j, 2]) / r[j, j]
    return r


@wp.kernel(enable_backward=False)
def solve_yielding(
    # In
    dt: float,
    fixed_flag: int,
    body_flags: wp.array[wp.int32],
    inverse_mass: wp.array[wp.float32],
    inverse_inertia: wp.array[wp.mat33],
    body_q: wp.array[wp.transform],
    # In and out
    curvature: wp.array[wp.spatial_matrix],
    slope: wp.array[wp.spatial_vector],
    # Out
    yielding: wp.array[wp.spatial_vector],
):
    """Solve for d of bodies: (K + M/dt^2) d = s with V = d . K d / 2 - s . d; K and s are reset to zero.

    With M^-1 = L L^T, which may be singular, and d = dt L e this is (1 + dt^2 L^T K L) e = dt L^T s.
    """
    b = wp.tid()
    k = curvature[b]
    s = slope[b]
    curvature[b] = wp.spatial_matrix()
    slope[b] = wp.spatial_vector()
    if (body_flags[b] & fixed_flag) != 0:
        yielding[b] = wp.spatial_vector()
        return
    turn = wp.quat_to_matrix(wp.transform_get_rotation(body_q[b]))
    angular = factor_of(turn * inverse_inertia[b] * wp.transpose(turn))
    linear = wp.sqrt(inverse_mass[b])
    factor = wp.spatial_matrix()
    for i in range(3):
        factor[i, i] = dt * linear
        for j in range(3):
            factor[3 + i, 3 + j] = dt * angular[i, j]
    a = wp.transpose(factor) * k * factor
    e = wp.transpose(factor) * s
    for i in range(6):
        a[i, i] += 1.0
    # By elimination.
    for i in range(6):
        for j in range(i + 1, 6):
            share = a[j, i] / a[i, i]
            e[j] -= share * e[i]
            for column in range(i, 6):
                a[j, column] -= share * a[i, column]
    for step in range(6):
        i = 5 - step
        for column in range(i + 1, 6):
            e[i] -= a[i, column] * e[column]
        e[i] /= a[i, i]
    yielding[b] = factor * e
