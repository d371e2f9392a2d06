"""Rows in an implicit step: springs and dampers between soft surfaces and rigid bodies.

An unknown is the motion d of a particle in the step, or the translation or the rotation of a body, each an entry of one
vector. A row sees the difference e = sum of b_j d_j - (t + r x arm) of its two sides. Its force at the end of the step
is a function of e, whose derivative S, symmetric and positive semi-definite, joins the matrix of the step. A contact
that is open then has neither force nor stiffness, so forces are found again after each solve.
"""

import warp as wp

from warp_corot.kernels.contact.springs import LOOSE, bound_of
from warp_corot.kernels.contact.vertices import across
from warp_corot.kernels.elements.elements import add_force, load_node
from warp_corot.kernels.implicit.line_search import TRIED

from .particles import Bodies
from .rows import ContactLaw, Row, ease_off, gap_of, is_attachment, point_and_arm, share_of, sum_of

wp.set_module_options({"enable_backward": False})


@wp.struct
class RowSprings:
    """Rows, as functions of motions; those without a first node are none."""

    nodes: wp.array[wp.vec4i]  # [R] entries of particles, -1 where there is none
    weights: wp.array[wp.vec4]  # [R]
    body: wp.array[wp.int32]  # [R] entry of the body's translation, before that of its rotation; -1: there is none
    arm: wp.array[wp.vec3]  # [R] from the centre of mass, or from the origin [m]
    normal: wp.array[wp.vec3]  # [R] zero: an attachment
    gap: wp.array[wp.vec3]  # [R] at the beginning [m]; of a contact the first component
    slide: wp.array[wp.vec3]  # [R] velocity of the shape on its body [m/s]
    law: wp.array[wp.vec4]  # [R] stiffness [N/m], damping [N s/m], slope of friction [N s/m], friction
    stiffness: wp.array[wp.mat33]  # [R] S [N/m]
    force: wp.array[wp.vec3]  # [R] on the particles [N]
    most: wp.array[wp.float32]  # [R] bound of friction [N]
    solves: wp.array[wp.int32]  # [1] number of linear solves that the step has had so far
    free: wp.array[wp.float32]  # of each entry, whether it is free


@wp.kernel(enable_backward=False)
def begin_springs(
    # In
    dt: float,
    law: ContactLaw,
    rows: wp.array[Row],
    load: wp.array[wp.float32],
    q: wp.array[wp.vec3],
    bodies: Bodies,
    particle_entry: wp.array[wp.int32],
    body_entry: wp.array[wp.int32],
    # Out
    springs: RowSprings,
):
    """Springs of rows at the beginning of a step."""
    c = wp.tid()
    ease_off(c, dt, law, rows)
    row = rows[c]
    if c == 0:
        springs.solves[0] = 0
    entries = wp.vec4i(-1, -1, -1, -1)
    springs.stiffness[c] = wp.mat33()
    if row.nodes[0] >= 0:
        for k in range(4):
            if row.nodes[k] >= 0:
                entries[k] = particle_entry[row.nodes[k]]
        point, arm = point_and_arm(row, bodies)
        entry = int(-1)
        slide = row.velocity
        if row.body >= 0:
            entry = body_entry[row.body]
            slide = wp.transform_vector(bodies.q[row.body], slide)
        apart = sum_of(row, q) - point
        stiffness = float(row.stiffness)
        if not is_attachment(row):
            apart = wp.vec3(gap_of(row, apart), 0.0, 0.0)
            stiffness *= share_of(row, load, law.crowd)
        springs.weights[c] = row.weights
        springs.body[c] = entry
        springs.arm[c] = arm
        springs.normal[c] = row.normal
        springs.gap[c] = apart
        springs.slide[c] = slide
        springs.most[c] = 0.0
        springs.law[c] = wp.vec4(
            row.measure * stiffness, row.measure * row.damping, row.measure * row.slope, row.friction
        )
    springs.nodes[c] = entries


@wp.func
def difference(springs: RowSprings, c: int, d: wp.array[wp.vec4]):
    """e of row c."""
    nodes = springs.nodes[c]
    weights = springs.weights[c]
    e = weights[0] * load_node(d, nodes[0])
    for k in range(1, 4):
        if nodes[k] >= 0:
            e += weights[k] * load_node(d, nodes[k])
    body = springs.body[c]
    if body >= 0:
        e -= load_node(d, body) + wp.cross(load_node(d, body + 1), springs.arm[c])
    return e


@wp.func
def add_to_sides(springs: RowSprings, c: int, force: wp.vec3, y: wp.array[wp.vec4]):
    """Add a force on the particles of row c to the free entries of both sides."""
    nodes = springs.nodes[c]
    weights = springs.weights[c]
    for k in range(4):
        if nodes[k] >= 0:  # noqa: SIM102 - the next value exists only then
            if springs.free[nodes[k]] > 0.0:
                add_force(y, nodes[k], weights[k] * force)
    body = springs.body[c]
    if body >= 0:
        if springs.free[body] > 0.0:
            add_force(y, body, -force)
        if springs.free[body + 1] > 0.0:
            add_force(y, body + 1, -wp.cross(springs.arm[c], force))


@wp.struct
class RowState:
    """A row's force on the particles, its derivative S [N/m], and a contact's push along its normal [N]."""

    force: wp.vec3
    stiffness: wp.mat33
    push: float


@wp.func
def row_state(springs: RowSprings, c: int, e: wp.vec3, most: float, dt: float, adhesion: float):
    """Row c at the difference e of its sides, with friction of at most ``most`` [N].

    Dampers of contacts act on what is deeper than at the beginning, so that the force is monotonic and continuous.
    """
    made = RowState()
    law = springs.law[c]
    n = springs.normal[c]
    velocity = e / dt - springs.slide[c]
    unit = wp.identity(3, dtype=wp.float32)
    if n == wp.vec3():
        made.force = -law[0] * (springs.gap[c] + e) - law[1] * velocity
        made.stiffness = (law[0] + law[1] / dt) * unit
        return made
    first = springs.gap[c][0]
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
        sliding = across(velocity, n)
        speed = wp.length(sliding)
        sideways = unit - whole
        slope = law[2]
        if slope * speed > most:
            slope = most / speed
            sideways -= (LOOSE / (speed * speed)) * wp.outer(sliding, sliding)
        made.force -= slope * sliding
        made.stiffness += (slope / dt) * sideways
    return made


@wp.kernel(enable_backward=False)
def update_springs(
    # In
    dt: float,
    adhesion: float,
    is_solved: int,
    d: wp.array[wp.vec4],
    # In and out
    springs: RowSprings,
):
    """Forces and stiffness after motions d. If these have just been solved for, the bounds of friction follow the
    pushes there."""
    c = wp.tid()
    if springs.nodes[c][0] < 0:
        return
    e = difference(springs, c, d)
    push = wp.max(row_state(springs, c, e, 0.0, dt, adhesion).push, 0.0)
    most = bound_of(springs.most[c], push, springs.law[c][3], is_solved != 0, springs.solves[0])
    made = row_state(springs, c, e, most, dt, adhesion)
    springs.most[c] = most
    springs.force[c] = made.force
    springs.stiffness[c] = made.stiffness


@wp.kernel(enable_backward=False)
def add_row_slopes(
    # In
    dt: float,
    adhesion: float,
    springs: RowSprings,
    count: int,
    d: wp.array[wp.vec4],
    change: wp.array[wp.vec4],
    search: wp.array2d[wp.float64],
    # Out
    slopes: wp.array[wp.float64],
):
    """Add the power of rows along ``change`` at the tried share of it, world by world [count entries]."""
    c = wp.tid()
    node = springs.nodes[c][0]
    if node < 0:
        return
    world = node / count
    of_change = difference(springs, c, change)
    e = difference(springs, c, d) + float(search[world, TRIED]) * of_change
    made = row_state(springs, c, e, springs.most[c], dt, adhesion)
    wp.atomic_add(slopes, world, wp.dot(wp.vec3d(made.force), wp.vec3d(of_change)))


@wp.kernel(enable_backward=False)
def add_row_forces(springs: RowSprings, y: wp.array[wp.vec4]):
    """Add the rows' forces [N, N m]."""
    c = wp.tid()
    if springs.nodes[c][0] >= 0:
        add_to_sides(springs, c, springs.force[c], y)


@wp.kernel(enable_backward=False)
def add_row_products(springs: RowSprings, x: wp.array[wp.vec4], y: wp.array[wp.vec4]):
    """y += S x."""
    c = wp.tid()
    if springs.nodes[c][0] >= 0:
        s = springs.stiffness[c]
        if wp.trace(s) > 0.0:
            add_to_sides(springs, c, s * difference(springs, c, x), y)


@wp.kernel(enable_backward=False)
def add_row_blocks(springs: RowSprings, blocks: wp.array[wp.mat33]):
    """Add the 3x3 blocks on the diagonal."""
    c = wp.tid()
    s = springs.stiffness[c]
    nodes = springs.nodes[c]
    if nodes[0] < 0 or wp.trace(s) == 0.0:
        return
    weights = springs.weights[c]
    for k in range(4):
        if nodes[k] >= 0:
            wp.atomic_add(blocks, nodes[k], weights[k] * weights[k] * s)
    body = springs.body[c]
    if body >= 0:
        turn = wp.skew(springs.arm[c])
        wp.atomic_add(blocks, body, s)
        wp.atomic_add(blocks, body + 1, turn * s * wp.transpose(turn))


@wp.kernel(enable_backward=False)
def report_rows(
    # In
    springs: RowSprings,
    contacts: int,
    entry_body: wp.array[wp.int32],
    share: float,
    first: int,
    # Out
    body_f: wp.array[wp.spatial_vector],
    reported: wp.array[wp.spatial_vector],
):
    """Wrenches on bodies, about their centres of mass, and of each contact; see ``explicit_rows.scatter_rows``."""
    c = wp.tid()
    if springs.nodes[c][0] < 0:
        return
    force = springs.force[c]
    wrench = -wp.spatial_vector(force, wp.cross(springs.arm[c], force))
    if springs.body[c] >= 0:
        wp.atomic_add(body_f, entry_body[springs.body[c]], wrench)
    if c < contacts and reported.shape[0] > 0:
        reported[first + c] += share * wrench
