"""Implicit steps of a Newton model: the motions d of particles, and of the bodies that these touch, within a step.

With v the velocities, f the forces on particles, and those of rows at the end, backward Euler with one
linearisation of the elastic forces is

    (M (1/dt^2 + damping/dt) + K + D/dt) d = M v/dt + f + rows(d),      v_after = d/dt.

K is R K R^T with each element's rotation where free pieces are turned as they will turn in the step (``turning``). The
forces f are those there plus K + D/dt times the way to there. D is R D R^T with the same rotations, so it leaves turns
alone, too: viscosity adds to the elements' moduli.

A vector has an entry for each particle, and two for each body, of its translation t and of its rotation r = G s, scaled
so that all three components of s have one moment of inertia. Entries of what is held, or moves as prescribed, are not
free.

A row is a spring and a damper between a soft surface and a rigid body. It sees the difference e = sum of b_j d_j -
(t + r x arm) of its two sides. Its force at the end of the step is a function of e, whose derivative S, symmetric and
positive semi-definite, joins the matrix of the step. A contact that is open then has neither force nor stiffness, so
forces are found again after each solve.
"""

from typing import Any

import warp as wp

from warp_corot.kernels.contact.law import LOOSE, SpringState, across, bound_of
from warp_corot.kernels.corotated.tangent import keep_gradients
from warp_corot.kernels.elements.constitutive import hooke, symmetric
from warp_corot.kernels.elements.elements import GeneralElements, add_force, load_node, store_node
from warp_corot.kernels.implicit.assembled import root_columns
from warp_corot.kernels.implicit.increments import MOTION_COLUMNS, Motion, motion_of
from warp_corot.kernels.implicit.line_search import TRIED
from warp_corot.kernels.math.rotation import byers_xu, identity3
from warp_corot.kernels.stepping.sums import Sums, store_sum

from .elements import difference_gradient
from .particles import SOUND, Bodies, Particles, in_world, is_active, is_fixed, is_moved
from .rows import ContactLaw, Row, ease_off, gap_of, is_attachment, point_and_arm, sum_of

wp.set_module_options({"enable_backward": False})


@wp.struct
class Linearised:
    """Elements where a step is linearised."""

    mu: wp.array[wp.float32]  # [T] with what viscosity adds [Pa]
    lam: wp.array[wp.float32]  # [T] [Pa]
    rotation: wp.array[wp.mat33]  # [T]
    kept: wp.array[wp.vec4]  # turned gradients, see ``KeptGradients``; empty on CUDA


@wp.kernel(enable_backward=False)
def linearise(
    # In
    elements: GeneralElements,
    mu: wp.array[wp.float32],
    lam: wp.array[wp.float32],
    k_damp: wp.array[wp.float32],
    dt: float,
    turned: wp.array[wp.vec3],
    # Out
    made: Linearised,
):
    t = wp.tid()
    r = byers_xu(difference_gradient(elements, t, turned))
    made.rotation[t] = r
    if made.kept.shape[0] > 0:
        keep_gradients(elements, t, r, made.kept)
    viscosity = k_damp[t] / dt
    made.mu[t] = mu[t] + 0.5 * viscosity
    made.lam[t] = lam[t] + viscosity


@wp.func
def linearised(elements: Any, t: int, made: Linearised, u: wp.array[wp.vec4], dg: wp.mat33):
    """The differential for ``elements.forces``."""
    r = made.rotation[t]
    return r * hooke(symmetric(wp.transpose(r) * dg), made.mu[t], made.lam[t])


@wp.kernel(enable_backward=False)
def add_element_blocks(elements: GeneralElements, made: Linearised, blocks: wp.array[wp.mat33]):
    """Add the 3x3 blocks of K + D/dt on the diagonal; in closed form, at a sixth of the differentials' cost."""
    t = wp.tid()
    b = elements.rest_inverse[t]
    first = -(b[0] + b[1] + b[2])
    for k in range(4):
        g = first
        if k > 0:
            g = b[k - 1]
        turned = made.rotation[t] * g
        block = (made.mu[t] * wp.dot(g, g)) * identity3() + (made.mu[t] + made.lam[t]) * wp.outer(turned, turned)
        wp.atomic_add(blocks, elements.nodes[t][k], elements.volume[t] * block)


@wp.struct
class Unknowns:
    """Vectors of a solve: an entry for each particle, and two for each body, world after world."""

    count: int  # entries of a world
    particle: wp.array[wp.int32]  # the entry of each particle
    body: wp.array[wp.int32]  # of each body's translation, before that of its rotation
    owner: wp.array[wp.int32]  # the body of an entry, or -1
    mass: wp.array[wp.float32]  # inertia [kg/s^2], zero if an entry is not free
    roots: wp.array[wp.mat33]  # G of each body, with G G^T its inverse inertia times a mean moment of inertia
    b: wp.array[wp.vec4]  # the right side
    d: wp.array[wp.vec4]  # the motions
    way: wp.array[wp.vec4]  # to where elements are linearised [m]
    fall: wp.array[wp.vec4]  # the guess of how gravity changes motions


@wp.func
def begin_entry(unknowns: Unknowns, k: int, mass: float, right: wp.vec3, motion: wp.vec3, fall: wp.vec3):
    """The right side of what is not free is its motion."""
    unknowns.mass[k] = mass
    store_node(unknowns.b, k, right)
    store_node(unknowns.d, k, motion)
    store_node(unknowns.fall, k, fall)


@wp.kernel(enable_backward=False)
def begin_particles(dt: float, damping: float, particles: Particles, f: wp.array[wp.vec4], unknowns: Unknowns):
    """Inertia of particles, their right side, in addition to K times the way, their first motion, and the guess of how
    gravity changes that: a solve to a share of large forces would not find that a body falls freely. Nothing moves in
    worlds that have failed."""
    i = wp.tid()
    k = unknowns.particle[i]
    motion = wp.vec3()
    if in_world(particles, i, particles.trouble) != SOUND or not is_active(i, particles):
        begin_entry(unknowns, k, 0.0, motion, motion, motion)
        return
    motion = dt * particles.qd[i]
    if particles.inv_mass[i] == 0.0:
        begin_entry(unknowns, k, 0.0, motion, motion, wp.vec3())
        return
    m = 1.0 / particles.inv_mass[i]
    g = in_world(particles, i, particles.gravity)
    right = load_node(unknowns.b, k) + (m / (dt * dt)) * motion + load_node(f, i) + m * g
    damped = 1.0 + dt * damping
    begin_entry(unknowns, k, m * damped / (dt * dt), right, motion / damped, (dt * dt / damped) * g)


@wp.kernel(enable_backward=False)
def begin_bodies(dt: float, bodies: Bodies, body_f: wp.array[wp.spatial_vector], moves: int, unknowns: Unknowns):
    """The same of bodies, as if nothing but soft bodies, gravity and ``body_f`` acted on them.

    Args:
        moves: Whether bodies move by their own velocities; else they stay.
    """
    i = wp.tid()
    k = unknowns.body[i]
    linear = wp.vec3()
    angular = wp.vec3()
    w = float(0.0)
    if in_world(bodies, i, bodies.trouble) == SOUND and moves != 0:
        linear = dt * wp.spatial_top(bodies.qd[i])
        angular = dt * wp.spatial_bottom(bodies.qd[i])
        if not is_fixed(i, bodies):
            w = bodies.inv_mass[i]
    begin_entry(unknowns, k, 0.0, linear, linear, wp.vec3())
    root = wp.identity(3, dtype=wp.float32)
    inertia = float(0.0)
    right = wp.vec3(angular)
    if w > 0.0:
        g = in_world(bodies, i, bodies.gravity)
        mass = 1.0 / (w * dt * dt)
        force = mass * linear + wp.spatial_top(body_f[i]) + g / w
        begin_entry(unknowns, k, mass, force, linear, (dt * dt) * g)
        if wp.determinant(bodies.inv_inertia[i]) > 0.0:
            turn = wp.quat_to_matrix(wp.transform_get_rotation(bodies.q[i]))
            moment = 3.0 / wp.trace(bodies.inv_inertia[i])
            root = wp.sqrt(moment) * root_columns(turn * bodies.inv_inertia[i] * wp.transpose(turn))
            inertia = moment / (dt * dt)
            spin = turn * (bodies.inertia[i] * (wp.transpose(turn) * angular))
            angular = (wp.transpose(root) * spin) / moment
            right = inertia * angular + wp.transpose(root) * wp.spatial_bottom(body_f[i])
    unknowns.roots[i] = root
    begin_entry(unknowns, k + 1, inertia, right, angular, wp.vec3())


# --- how free pieces turn in a step; see ``kernels.implicit.increments`` ----------------------------------------------
#
# A piece is all particles that tetrahedra connect. It is turned about its centre of mass, as it will turn in the step.


@wp.kernel(enable_backward=False)
def sum_motion(sums: Sums, first: wp.array[wp.int32], members: wp.array[wp.int32], particles: Particles):
    """Find parts of the sums of each piece, whose particles begin at ``first`` among the members."""
    piece, thread = wp.tid()
    total = Motion()
    for k in range(first[piece] + thread, first[piece + 1], sums.threads):
        i = members[k]
        if is_moved(i, particles):
            mass = wp.float64(1.0) / wp.float64(particles.inv_mass[i])
            total += motion_of(mass, False, wp.vec3d(particles.q[i]), wp.vec3d(particles.qd[i]))
        else:
            total += motion_of(wp.float64(0.0), True, wp.vec3d(), wp.vec3d())
    for column in range(MOTION_COLUMNS):
        store_sum(sums, piece, thread, column, total[column])


@wp.kernel(enable_backward=False)
def turn_particles(
    # In
    piece_of: wp.array[wp.int32],
    centres: wp.array[wp.vec3],
    turns: wp.array[wp.mat33],
    particles: Particles,
    # In and out
    unknowns: Unknowns,
    u: wp.array[wp.vec4],
    # Out
    turned: wp.array[wp.vec3],
):
    """Find the turned positions and the way to them; gathered displacements are turned, too."""
    i = wp.tid()
    at = particles.q[i]
    d = wp.vec3()
    piece = piece_of[i]
    if piece >= 0:
        d = turns[piece] * (at - centres[piece])
        store_node(u, i, load_node(u, i) + d)
    turned[i] = at + d
    store_node(unknowns.way, unknowns.particle[i], d)


# --- rows ------------------------------------------------------------------------------------------------------------


@wp.struct
class RowSprings:
    """Rows, as functions of motions in a step dt; those without a first node are none."""

    dt: float
    adhesion: float  # see ``ContactLaw``
    nodes: wp.array[wp.vec4i]  # [R] entries of particles, -1 where there is none
    weights: wp.array[wp.vec4]  # [R]
    body: wp.array[wp.int32]  # [R] entry of the body's translation, before that of its rotation; -1: there is none
    arm: wp.array[wp.vec3]  # [R] from the centre of mass, or from the origin [m]
    lever: wp.array[wp.mat33]  # [R] the matrix of s in r x arm
    normal: wp.array[wp.vec3]  # [R] zero: an attachment
    gap: wp.array[wp.vec3]  # [R] at the beginning [m]; of a contact the first component
    slide: wp.array[wp.vec3]  # [R] velocity of the shape on its body [m/s]
    law: wp.array[wp.vec4]  # [R] stiffness [N/m], damping [N s/m], slope of friction [N s/m], friction
    stiffness: wp.array[wp.mat33]  # [R] S [N/m]
    force: wp.array[wp.vec3]  # [R] on the particles [N]
    most: wp.array[wp.float32]  # [R] bound of friction [N]
    solves: wp.array[wp.int32]  # [1] number of linear solves that the step has had so far


@wp.kernel(enable_backward=False)
def begin_springs(
    # In
    law: ContactLaw,
    particles: Particles,
    bodies: Bodies,
    unknowns: Unknowns,
    # In and out
    rows: wp.array[Row],
    # Out
    springs: RowSprings,
):
    """Springs of rows at the beginning of a step."""
    c = wp.tid()
    ease_off(c, springs.dt, law, rows)
    row = rows[c]
    if c == 0:
        springs.solves[0] = 0
    entries = wp.vec4i(-1, -1, -1, -1)
    springs.stiffness[c] = wp.mat33()
    if row.nodes[0] >= 0:
        for k in range(4):
            if row.nodes[k] >= 0:
                entries[k] = unknowns.particle[row.nodes[k]]
        point, arm = point_and_arm(row, bodies)
        springs.body[c] = -1
        springs.slide[c] = row.velocity
        if row.body >= 0:
            springs.body[c] = unknowns.body[row.body]
            springs.slide[c] = wp.transform_vector(bodies.q[row.body], row.velocity)
            springs.lever[c] = -wp.skew(arm) * unknowns.roots[row.body]
        apart = sum_of(row, particles.q) - point
        if not is_attachment(row):
            apart = wp.vec3(gap_of(row, apart), 0.0, 0.0)
        springs.weights[c] = row.weights
        springs.arm[c] = arm
        springs.normal[c] = row.normal
        springs.gap[c] = apart
        springs.most[c] = 0.0
        whole = row.measure
        springs.law[c] = wp.vec4(whole * row.stiffness, whole * row.damping, whole * row.slope, row.friction)
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
        e -= load_node(d, body) + springs.lever[c] * load_node(d, body + 1)
    return e


@wp.func
def row_state(springs: RowSprings, c: int, e: wp.vec3, most: float):
    """Row c at the difference e of its sides, with friction of at most ``most`` [N]. Its derivative is S.

    Dampers of contacts act on what is deeper than at the beginning, so that the force is monotonic and continuous.
    """
    made = SpringState()
    law = springs.law[c]
    n = springs.normal[c]
    velocity = e / springs.dt - springs.slide[c]
    unit = wp.identity(3, dtype=wp.float32)
    if n == wp.vec3():
        made.force = -law[0] * (springs.gap[c] + e) - law[1] * velocity
        made.derivative = (law[0] + law[1] / springs.dt) * unit
        return made
    first = springs.gap[c][0]
    gap = first + wp.dot(n, e)
    whole = wp.outer(n, n)
    if gap <= springs.adhesion:
        deeper = wp.max(wp.max(-gap, 0.0) - wp.max(-first, 0.0), 0.0)
        rate = wp.where(deeper > 0.0, law[1] / springs.dt, 0.0)
        made.push = rate * deeper - law[0] * gap
        made.derivative = (law[0] + rate) * whole
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
        made.derivative += (slope / springs.dt) * sideways
    return made


@wp.kernel(enable_backward=False)
def update_springs(is_solved: int, d: wp.array[wp.vec4], springs: RowSprings):
    """Forces and stiffness after motions d. If these have just been solved for, the bounds of friction follow the
    pushes there."""
    c = wp.tid()
    if springs.nodes[c][0] < 0:
        return
    e = difference(springs, c, d)
    push = wp.max(row_state(springs, c, e, 0.0).push, 0.0)
    most = bound_of(springs.most[c], push, springs.law[c][3], is_solved != 0, springs.solves[0])
    made = row_state(springs, c, e, most)
    springs.most[c] = most
    springs.force[c] = made.force
    springs.stiffness[c] = made.derivative


@wp.kernel(enable_backward=False)
def add_row_slopes(
    # In
    unknowns: Unknowns,
    springs: RowSprings,
    d: wp.array[wp.vec4],
    change: wp.array[wp.vec4],
    search: wp.array2d[wp.float64],
    # Out
    slopes: wp.array[wp.float64],
):
    """Add the power of rows along ``change`` at the tried share of it, world by world."""
    c = wp.tid()
    node = springs.nodes[c][0]
    if node < 0:
        return
    world = node / unknowns.count
    of_change = difference(springs, c, change)
    made = row_state(springs, c, difference(springs, c, d) + float(search[world, TRIED]) * of_change, springs.most[c])
    wp.atomic_add(slopes, world, wp.dot(wp.vec3d(made.force), wp.vec3d(of_change)))


@wp.func
def add_free(unknowns: Unknowns, entry: int, force: wp.vec3, y: wp.array[wp.vec4]):
    if entry >= 0:  # noqa: SIM102 - the next value exists only then
        if unknowns.mass[entry] > 0.0:
            add_force(y, entry, force)


@wp.kernel(enable_backward=False)
def add_row_forces(unknowns: Unknowns, springs: RowSprings, x: wp.array[wp.vec4], y: wp.array[wp.vec4]):
    """y += S x at free entries; if x is empty, the rows' forces [N, N m]."""
    c = wp.tid()
    nodes = springs.nodes[c]
    if nodes[0] < 0:
        return
    force = springs.force[c]
    if x.shape[0] > 0:
        s = springs.stiffness[c]
        if wp.trace(s) == 0.0:
            return
        force = s * difference(springs, c, x)
    for k in range(4):
        add_free(unknowns, nodes[k], springs.weights[c][k] * force, y)
    body = springs.body[c]
    if body >= 0:
        add_free(unknowns, body, -force, y)
        add_free(unknowns, body + 1, -(wp.transpose(springs.lever[c]) * force), y)


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
        lever = springs.lever[c]
        wp.atomic_add(blocks, body, s)
        wp.atomic_add(blocks, body + 1, wp.transpose(lever) * s * lever)


@wp.kernel(enable_backward=False)
def report_rows(
    # In
    springs: RowSprings,
    unknowns: Unknowns,
    contacts: int,
    share: float,
    first: int,
    # Out
    body_f: wp.array[wp.spatial_vector],
    reported: wp.array[wp.spatial_vector],
):
    """Wrenches on bodies, about their centres of mass, and of each contact; see ``explicit.scatter_rows``."""
    c = wp.tid()
    if springs.nodes[c][0] < 0:
        return
    force = springs.force[c]
    wrench = -wp.spatial_vector(force, wp.cross(springs.arm[c], force))
    if springs.body[c] >= 0:
        wp.atomic_add(body_f, unknowns.owner[springs.body[c]], wrench)
    if c < contacts and reported.shape[0] > 0:
        reported[first + c] += share * wrench
