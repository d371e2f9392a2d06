"""Contacts and attachments of an implicit step as links: springs and dampers between soft surfaces and rigid bodies.

An unknown is the motion d of a particle in the step, or the translation or the rotation of a body, each an entry of one
vector. A link sees the difference e = sum of b_j d_j - (t + r x arm) of its two sides. Its force at the end of the step
is a function of e, whose derivative S, symmetric and positive semi-definite, joins the matrix of the step. A contact
that is open then has neither force nor stiffness, so forces are found again after each solve.
"""

import warp as wp

from warp_corot.kernels.elements.elements import add_force, load_node
from warp_corot.kernels.implicit.line_search import TRIED

from .contacts import ContactLaw
from .touching import contact_gap, is_active, largest_of, mean_of, point_of, share_of

wp.set_module_options({"enable_backward": False})


@wp.struct
class Links:
    """Contacts, and after these attachments; those without a first node are none."""

    nodes: wp.array[wp.vec3i]  # [L] entries of particles, -1 where there is none
    weights: wp.array[wp.vec3]  # [L]
    body: wp.array[wp.int32]  # [L] entry of the body's translation, before that of its rotation; -1: there is none
    arm: wp.array[wp.vec3]  # [L] from the centre of mass [m]
    normal: wp.array[wp.vec3]  # [L] zero: an attachment
    gap: wp.array[wp.vec3]  # [L] at the beginning [m]; of a contact the first component
    slide: wp.array[wp.vec3]  # [L] velocity of the shape on its body [m/s]
    law: wp.array[wp.vec4]  # [L] stiffness [N/m], damping [N s/m], slope of friction [N s/m], friction
    stiffness: wp.array[wp.mat33]  # [L] S [N/m]
    force: wp.array[wp.vec3]  # [L] on the soft side [N]
    most: wp.array[wp.float32]  # [L] most of friction [N]


@wp.func
def entries_of(nodes: wp.vec3i, entry: wp.array[wp.int32]):
    found = wp.vec3i(-1, -1, -1)
    for k in range(3):
        if nodes[k] >= 0:
            found[k] = entry[nodes[k]]
    return found


@wp.kernel(enable_backward=False)
def begin_contacts(
    # In
    law: ContactLaw,
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
    radius: wp.array[wp.float32],
    q: wp.array[wp.vec3],
    body_q: wp.array[wp.transform],
    body_com: wp.array[wp.vec3],
    particle_entry: wp.array[wp.int32],
    body_entry: wp.array[wp.int32],
    # Out
    links: Links,
):
    """Links of the contacts that Newton's collision pipeline found."""
    c = wp.tid()
    links.nodes[c] = wp.vec3i(-1, -1, -1)
    if c >= wp.min(count[0], contact_particle.shape[0]):
        return
    p = point_of(c, contact_particle, contact_nodes, contact_weights)
    if not is_active(p, flags) or p.measure == 0.0:
        return
    shape = contact_shape[c]
    body = shape_body[shape]
    point = contact_point[c]
    velocity = contact_velocity[c]
    arm = wp.vec3()
    entry = int(-1)
    if body >= 0:
        pose = body_q[body]
        point = wp.transform_point(pose, point)
        arm = point - wp.transform_point(pose, body_com[body])
        velocity = wp.transform_vector(pose, velocity)
        entry = body_entry[body]
    normal = contact_normal[c]
    links.nodes[c] = entries_of(p.nodes, particle_entry)
    links.weights[c] = p.weights
    links.body[c] = entry
    links.arm[c] = arm
    links.normal[c] = normal
    gap = contact_gap(normal, mean_of(p, q), largest_of(p, radius), point, shape, shape_margin)
    links.gap[c] = wp.vec3(gap, 0.0, 0.0)
    links.slide[c] = velocity
    half = 0.5 * p.measure
    links.law[c] = wp.vec4(
        half * share_of(p, load, law.crowd) * (law.stiffness + shape_ke[shape]),
        half * (law.damping + shape_kd[shape]),
        half * (law.friction_slope + shape_kf[shape]),
        0.5 * (law.friction + shape_mu[shape]),
    )


@wp.kernel(enable_backward=False)
def begin_attachments(
    # In
    first: int,
    particle: wp.array[wp.int32],
    body: wp.array[wp.int32],
    body_point: wp.array[wp.vec3],
    stiffness: wp.array[wp.float32],
    damping: wp.array[wp.float32],
    enabled: wp.array[wp.bool],
    q: wp.array[wp.vec3],
    body_q: wp.array[wp.transform],
    body_com: wp.array[wp.vec3],
    particle_entry: wp.array[wp.int32],
    body_entry: wp.array[wp.int32],
    # Out
    links: Links,
):
    """Links of attachments, from the ``first`` on."""
    a = wp.tid()
    c = first + a
    links.nodes[c] = wp.vec3i(-1, -1, -1)
    if not enabled[a]:
        return
    i = particle[a]
    b = body[a]
    pose = body_q[b]
    point = wp.transform_point(pose, body_point[a])
    links.nodes[c] = wp.vec3i(particle_entry[i], -1, -1)
    links.weights[c] = wp.vec3(1.0, 0.0, 0.0)
    links.body[c] = body_entry[b]
    links.arm[c] = point - wp.transform_point(pose, body_com[b])
    links.normal[c] = wp.vec3()
    links.gap[c] = q[i] - point
    links.slide[c] = wp.vec3()
    links.law[c] = wp.vec4(stiffness[a], damping[a], 0.0, 0.0)


@wp.func
def difference(links: Links, c: int, d: wp.array[wp.vec4]):
    """e of link c."""
    nodes = links.nodes[c]
    weights = links.weights[c]
    e = weights[0] * load_node(d, nodes[0])
    for k in range(1, 3):
        if nodes[k] >= 0:
            e += weights[k] * load_node(d, nodes[k])
    body = links.body[c]
    if body >= 0:
        e -= load_node(d, body) + wp.cross(load_node(d, body + 1), links.arm[c])
    return e


@wp.func
def add_to_sides(links: Links, c: int, force: wp.vec3, y: wp.array[wp.vec4]):
    """Add a force on the soft side of link c to the entries of both sides."""
    nodes = links.nodes[c]
    weights = links.weights[c]
    for k in range(3):
        if nodes[k] >= 0:
            add_force(y, nodes[k], weights[k] * force)
    body = links.body[c]
    if body >= 0:
        add_force(y, body, -force)
        add_force(y, body + 1, -wp.cross(links.arm[c], force))


@wp.struct
class LinkState:
    """A link's force on the soft side [N], its derivative S [N/m], and a contact's push along its normal [N]."""

    force: wp.vec3
    stiffness: wp.mat33
    push: float


@wp.func
def link_state(links: Links, c: int, e: wp.vec3, most: float, dt: float, adhesion: float):
    """Link c at the difference e of its sides, with friction of at most ``most`` [N].

    Dampers of contacts act on what is deeper than at the beginning, so that the force is monotonic and continuous.
    """
    made = LinkState()
    law = links.law[c]
    n = links.normal[c]
    velocity = e / dt - links.slide[c]
    unit = wp.identity(3, dtype=wp.float32)
    if n == wp.vec3():
        made.force = -law[0] * (links.gap[c] + e) - law[1] * velocity
        made.stiffness = (law[0] + law[1] / dt) * unit
        return made
    first = links.gap[c][0]
    gap = first + wp.dot(n, e)
    whole = wp.outer(n, n)
    if gap <= adhesion:
        made.push = -law[0] * gap
        rate = law[0]
        deeper = wp.max(-gap, 0.0) - wp.max(-first, 0.0)
        if deeper > 0.0:
            made.push += law[1] / dt * deeper
            rate += law[1] / dt
        made.stiffness = rate * whole
        made.force = made.push * n
    if most > 0.0 and law[2] > 0.0:
        across = velocity - wp.dot(n, velocity) * n
        speed = wp.length(across)
        sideways = unit - whole
        slope = law[2]
        if slope * speed > most:
            # A contact that slides has no stiffness in the direction in which it slides.
            slope = most / speed
            sideways -= wp.outer(across, across) / (speed * speed)
        made.force -= slope * across
        made.stiffness += (slope / dt) * sideways
    return made


@wp.kernel(enable_backward=False)
def update_links(
    # In
    dt: float,
    adhesion: float,
    d: wp.array[wp.vec4],
    # In and out
    links: Links,
):
    """Forces and stiffness of links after motions d, with the friction that their push there allows."""
    c = wp.tid()
    if links.nodes[c][0] < 0:
        return
    e = difference(links, c, d)
    most = links.law[c][3] * wp.max(link_state(links, c, e, 0.0, dt, adhesion).push, 0.0)
    made = link_state(links, c, e, most, dt, adhesion)
    links.most[c] = most
    links.force[c] = made.force
    links.stiffness[c] = made.stiffness


@wp.kernel(enable_backward=False)
def add_link_slopes(
    # In
    dt: float,
    adhesion: float,
    links: Links,
    count: int,
    d: wp.array[wp.vec4],
    change: wp.array[wp.vec4],
    search: wp.array2d[wp.float64],
    # Out
    slopes: wp.array[wp.float64],
):
    """Add the power of links along ``change`` at the tried share of it, world by world [count entries]."""
    c = wp.tid()
    node = links.nodes[c][0]
    if node < 0:
        return
    world = node / count
    of_change = difference(links, c, change)
    e = difference(links, c, d) + float(search[world, TRIED]) * of_change
    made = link_state(links, c, e, links.most[c], dt, adhesion)
    wp.atomic_add(slopes, world, wp.dot(wp.vec3d(made.force), wp.vec3d(of_change)))


@wp.kernel(enable_backward=False)
def add_link_forces(links: Links, y: wp.array[wp.vec4]):
    """Add the links' forces [N, N m]."""
    c = wp.tid()
    if links.nodes[c][0] >= 0:
        add_to_sides(links, c, links.force[c], y)


@wp.kernel(enable_backward=False)
def add_link_products(links: Links, x: wp.array[wp.vec4], y: wp.array[wp.vec4]):
    """y += S x."""
    c = wp.tid()
    if links.nodes[c][0] >= 0:
        s = links.stiffness[c]
        if wp.trace(s) > 0.0:
            add_to_sides(links, c, s * difference(links, c, x), y)


@wp.kernel(enable_backward=False)
def add_link_blocks(links: Links, blocks: wp.array[wp.mat33]):
    """Add the 3x3 blocks on the diagonal."""
    c = wp.tid()
    if links.nodes[c][0] < 0:
        return
    s = links.stiffness[c]
    if wp.trace(s) == 0.0:
        return
    nodes = links.nodes[c]
    weights = links.weights[c]
    for k in range(3):
        if nodes[k] >= 0:
            wp.atomic_add(blocks, nodes[k], weights[k] * weights[k] * s)
    body = links.body[c]
    if body >= 0:
        turn = wp.skew(links.arm[c])
        wp.atomic_add(blocks, body, s)
        wp.atomic_add(blocks, body + 1, turn * s * wp.transpose(turn))


@wp.kernel(enable_backward=False)
def report_links(
    # In
    links: Links,
    contacts: int,
    entry_body: wp.array[wp.int32],
    contact_shape: wp.array[wp.int32],
    contact_point: wp.array[wp.vec3],
    shape_body: wp.array[wp.int32],
    share: float,
    first_row: int,
    # Out
    body_f: wp.array[wp.spatial_vector],
    reported: wp.array[wp.spatial_vector],
):
    """Wrenches on bodies, about their centres of mass, and of each contact; see ``scatter_soft_contacts``."""
    c = wp.tid()
    if links.nodes[c][0] < 0:
        return
    force = links.force[c]
    arm = links.arm[c]
    entry = links.body[c]
    if c < contacts:  # noqa: SIM102 - the next value exists only then
        if shape_body[contact_shape[c]] < 0:
            arm = contact_point[c]
    wrench = -wp.spatial_vector(force, wp.cross(arm, force))
    if entry >= 0:
        wp.atomic_add(body_f, entry_body[entry], wrench)
    if c < contacts and reported.shape[0] > 0:
        reported[first_row + c] += share * wrench
