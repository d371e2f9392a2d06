"""Implicit steps of a Newton model: the motions d of particles, and of the bodies that these touch, within a step.

With v the velocities, f the forces on particles, and those of links at the end, backward Euler with one
linearisation of the elastic forces is

    (M (1/dt^2 + damping/dt) + K + D/dt) d = M v/dt + f + links(d),      v_after = d/dt.

K is R K R^T with each element's rotation where free pieces are turned as they will turn in the step (``turning``). The
forces f are those there plus K times the way to there. D is the viscosity midway, where a turn has none.

A vector has an entry for each particle, and two for each body, of its translation and its rotation. Entries of what is
held, or moves as prescribed, are not free.
"""

import warp as wp

from warp_corot.kernels.elements.elements import GeneralElements, add_force, load_node, store_node
from warp_corot.kernels.math.rotation import byers_xu
from warp_corot.kernels.stepping.integrate import is_finite

from .elements import difference_gradient
from .particles import ACTIVE
from .worlds import BAD_INPUT, SOUND, UNSTABLE, place_of

wp.set_module_options({"enable_backward": False})


@wp.struct
class Linearised:
    """Elements where a step is linearised; stiffness and viscosity times rest volumes."""

    nodes: wp.array[wp.vec4i]  # [T] entries
    rest_inverse: wp.array[wp.mat33]  # [T] [1/m]
    rotation: wp.array[wp.mat33]  # [T]
    gradient: wp.array[wp.mat33]  # [T] F; empty where nothing is viscous
    mu: wp.array[wp.float32]  # [T] [N m]
    lam: wp.array[wp.float32]  # [T] [N m]
    viscosity: wp.array[wp.float32]  # [T] over dt and |F|^2 / 3 [N m]


@wp.kernel(enable_backward=False)
def linearise(
    # In
    elements: GeneralElements,
    mu: wp.array[wp.float32],
    lam: wp.array[wp.float32],
    k_damp: wp.array[wp.float32],
    dt: float,
    q: wp.array[wp.vec3],
    turned: wp.array[wp.vec3],
    # Out
    made: Linearised,
):
    t = wp.tid()
    f = difference_gradient(elements, t, turned)
    volume = elements.volume[t]
    made.rotation[t] = byers_xu(f)
    made.mu[t] = volume * mu[t]
    made.lam[t] = volume * lam[t]
    if made.gradient.shape[0] == made.rotation.shape[0]:
        f = 0.5 * (f + difference_gradient(elements, t, q))
        made.gradient[t] = f
        made.viscosity[t] = 3.0 * volume * k_damp[t] / (dt * wp.max(wp.ddot(f, f), 1.0e-12))


@wp.kernel(enable_backward=False)
def add_element_products(made: Linearised, x: wp.array[wp.vec4], y: wp.array[wp.vec4]):
    """y += (K + D/dt) x."""
    t = wp.tid()
    nodes = made.nodes[t]
    x0 = load_node(x, nodes[0])
    edges = wp.matrix_from_cols(load_node(x, nodes[1]) - x0, load_node(x, nodes[2]) - x0, load_node(x, nodes[3]) - x0)
    inverse = made.rest_inverse[t]
    change = edges * inverse
    r = made.rotation[t]
    a = wp.transpose(r) * change
    unit = wp.identity(3, dtype=wp.float32)
    p = r * (made.mu[t] * (a + wp.transpose(a)) + made.lam[t] * wp.trace(a) * unit)
    if made.gradient.shape[0] == made.rotation.shape[0]:
        f = made.gradient[t]
        b = wp.transpose(f) * change
        p += made.viscosity[t] * (f * (0.5 * (b + wp.transpose(b)) + wp.trace(b) * unit))
    forces = p * wp.transpose(inverse)
    f1 = wp.vec3(forces[0, 0], forces[1, 0], forces[2, 0])
    f2 = wp.vec3(forces[0, 1], forces[1, 1], forces[2, 1])
    f3 = wp.vec3(forces[0, 2], forces[1, 2], forces[2, 2])
    add_force(y, nodes[0], -(f1 + f2 + f3))
    add_force(y, nodes[1], f1)
    add_force(y, nodes[2], f2)
    add_force(y, nodes[3], f3)


@wp.kernel(enable_backward=False)
def add_element_blocks(made: Linearised, blocks: wp.array[wp.mat33]):
    """Add the 3x3 blocks of K + D/dt on the diagonal."""
    t = wp.tid()
    inverse = made.rest_inverse[t]
    nodes = made.nodes[t]
    g1 = inverse[0]
    g2 = inverse[1]
    g3 = inverse[2]
    r = made.rotation[t]
    unit = wp.identity(3, dtype=wp.float32)
    for k in range(4):
        g = -(g1 + g2 + g3)
        if k == 1:
            g = g1
        elif k == 2:
            g = g2
        elif k == 3:
            g = g3
        square = wp.dot(g, g)
        turned = r * g
        block = (made.mu[t] * square) * unit + (made.mu[t] + made.lam[t]) * wp.outer(turned, turned)
        if made.gradient.shape[0] == made.rotation.shape[0]:
            f = made.gradient[t]
            stretched = f * g
            of_rates = (0.5 * square) * (f * wp.transpose(f)) + 1.5 * wp.outer(stretched, stretched)
            block += made.viscosity[t] * of_rates
        wp.atomic_add(blocks, nodes[k], block)


@wp.kernel(enable_backward=False)
def begin_particles(
    # In
    dt: float,
    damping: float,
    gravity: wp.array[wp.vec3],
    inverse_mass: wp.array[wp.float32],
    flags: wp.array[wp.int32],
    world: wp.array[wp.int32],
    f: wp.array[wp.vec4],
    qd: wp.array[wp.vec3],
    trouble: wp.array[wp.int32],
    entry: wp.array[wp.int32],
    # Out
    free: wp.array[wp.float32],
    inertia: wp.array[wp.mat33],
    b: wp.array[wp.vec4],
    d: wp.array[wp.vec4],
    fall: wp.array[wp.vec4],
):
    """Inertia, right side and first motion of particles, and the guess of how gravity changes that. Nothing moves in
    worlds that have failed."""
    i = wp.tid()
    k = entry[i]
    free[k] = 0.0
    right = wp.vec3()
    motion = wp.vec3()
    falls = wp.vec3()
    if trouble[place_of(world[i], trouble.shape[0])] == SOUND and (flags[i] & ACTIVE) != 0:
        motion = dt * qd[i]
        if inverse_mass[i] > 0.0:
            m = 1.0 / inverse_mass[i]
            free[k] = 1.0
            inertia[k] = (m * (1.0 / dt + damping) / dt) * wp.identity(3, dtype=wp.float32)
            g = gravity[place_of(world[i], gravity.shape[0])]
            right = (m / dt) * qd[i] + load_node(f, i) + m * g
            # A solve to a share of large forces would not find that a body falls freely.
            falls = (dt * dt / (1.0 + dt * damping)) * g
            motion = motion / (1.0 + dt * damping)
    store_node(b, k, right)
    store_node(d, k, motion)
    store_node(fall, k, falls)


@wp.kernel(enable_backward=False)
def begin_bodies(
    # In
    dt: float,
    fixed_flag: int,
    flags: wp.array[wp.int32],
    world: wp.array[wp.int32],
    gravity: wp.array[wp.vec3],
    inverse_mass: wp.array[wp.float32],
    inverse_inertia: wp.array[wp.mat33],
    inertia_of: wp.array[wp.mat33],
    q: wp.array[wp.transform],
    qd: wp.array[wp.spatial_vector],
    body_f: wp.array[wp.spatial_vector],
    moves: int,
    trouble: wp.array[wp.int32],
    entry: wp.array[wp.int32],
    # Out
    free: wp.array[wp.float32],
    inertia: wp.array[wp.mat33],
    b: wp.array[wp.vec4],
    d: wp.array[wp.vec4],
    fall: wp.array[wp.vec4],
):
    """The same of bodies, as if nothing but soft bodies, gravity and ``body_f`` acted on them.

    Args:
        moves: Whether bodies move by their own velocities; else they stay.
    """
    i = wp.tid()
    k = entry[i]
    linear = wp.vec3()
    angular = wp.vec3()
    right = wp.vec3()
    right_angular = wp.vec3()
    falls = wp.vec3()
    free[k] = 0.0
    free[k + 1] = 0.0
    if trouble[place_of(world[i], trouble.shape[0])] == SOUND and moves != 0:
        linear = dt * wp.spatial_top(qd[i])
        angular = dt * wp.spatial_bottom(qd[i])
        w = inverse_mass[i]
        if w > 0.0 and (flags[i] & fixed_flag) == 0:
            free[k] = 1.0
            inertia[k] = (1.0 / (w * dt * dt)) * wp.identity(3, dtype=wp.float32)
            right = linear / (w * dt * dt) + wp.spatial_top(body_f[i])
            g = gravity[place_of(world[i], gravity.shape[0])]
            right += g / w
            falls = (dt * dt) * g
            if wp.determinant(inverse_inertia[i]) > 0.0:
                turn = wp.quat_to_matrix(wp.transform_get_rotation(q[i]))
                free[k + 1] = 1.0
                inertia[k + 1] = (turn * inertia_of[i] * wp.transpose(turn)) / (dt * dt)
                right_angular = inertia[k + 1] * angular + wp.spatial_bottom(body_f[i])
    store_node(b, k, right)
    store_node(d, k, linear)
    store_node(fall, k, falls)
    store_node(b, k + 1, right_angular)
    store_node(d, k + 1, angular)
    store_node(fall, k + 1, wp.vec3())


@wp.kernel(enable_backward=False)
def finish_rows(
    # In
    free: wp.array[wp.float32],
    inertia: wp.array[wp.mat33],
    x: wp.array[wp.vec4],
    # In and out
    y: wp.array[wp.vec4],
):
    """y += M x at free entries, y = x at others."""
    k = wp.tid()
    v = load_node(x, k)
    if free[k] > 0.0:
        v = load_node(y, k) + inertia[k] * v
    store_node(y, k, v)


@wp.kernel(enable_backward=False)
def finish_blocks(free: wp.array[wp.float32], inertia: wp.array[wp.mat33], blocks: wp.array[wp.mat33]):
    k = wp.tid()
    block = wp.identity(3, dtype=wp.float32)
    if free[k] > 0.0:
        block = blocks[k] + inertia[k]
    blocks[k] = block


@wp.kernel(enable_backward=False)
def find_residual(
    # In
    free: wp.array[wp.float32],
    b: wp.array[wp.vec4],
    product: wp.array[wp.vec4],
    # In and out
    r: wp.array[wp.vec4],
):
    """r += b - A d at free entries, where r has the forces of links; r = 0 at others."""
    k = wp.tid()
    rest = wp.vec3()
    if free[k] > 0.0:
        rest = load_node(r, k) + load_node(b, k) - load_node(product, k)
    store_node(r, k, rest)


@wp.kernel(enable_backward=False)
def judge_round(
    # In
    iterations: wp.array[wp.int32],
    most: int,
    # In and out
    rounds: wp.array[wp.int32],
    total: wp.array[wp.int32],
    # Out
    going: wp.array[wp.int32],
):
    """Solve again unless the last solve had next to nothing to do; count iterations [worlds]."""
    again = int(0)
    for world in range(iterations.shape[0]):
        total[world] = total[world] + iterations[world]
        if iterations[world] > 1:
            again = 1
    rounds[0] = rounds[0] + 1
    if rounds[0] >= most:
        again = 0
    going[0] = again


@wp.kernel(enable_backward=False)
def count_solves(
    # In
    iterations: wp.array[wp.int32],
    rounds: wp.array[wp.int32],
    status: wp.array[wp.int32],
    good: int,
    # Out
    totals: wp.array[wp.int64],
):
    """Count steps, solves, iterations of the world that needed most, and steps in which a solve did not end well."""
    linear = int(0)
    unfinished = int(0)
    for world in range(status.shape[0]):
        linear = wp.max(linear, iterations[world])
        if status[world] != good:
            unfinished = 1
    totals[0] = totals[0] + wp.int64(1)
    totals[1] = totals[1] + wp.int64(rounds[0])
    totals[2] = totals[2] + wp.int64(linear)
    totals[3] = totals[3] + wp.int64(unfinished)


@wp.kernel(enable_backward=False)
def move_particles(
    # In
    dt: float,
    most: float,
    fastest: float,
    inverse_mass: wp.array[wp.float32],
    flags: wp.array[wp.int32],
    world: wp.array[wp.int32],
    entry: wp.array[wp.int32],
    d: wp.array[wp.vec4],
    q: wp.array[wp.vec3],
    qd: wp.array[wp.vec3],
    # Out
    q_out: wp.array[wp.vec3],
    qd_out: wp.array[wp.vec3],
    trouble: wp.array[wp.int32],
):
    """The state after motions d, as ``particles.step_particles`` writes it."""
    i = wp.tid()
    place = place_of(world[i], trouble.shape[0])
    wrong = trouble[place]
    if wrong == BAD_INPUT:
        return
    at = q[i]
    velocity = qd[i]
    if wrong == SOUND and (flags[i] & ACTIVE) != 0:
        if inverse_mass[i] > 0.0:
            velocity = load_node(d, entry[i]) / dt
        size = wp.max(wp.max(wp.abs(velocity)), 1.0)
        speed = size * wp.length(velocity / size)
        runs_away = speed >= fastest
        if speed > most:
            velocity = velocity * (most / speed)
        at += dt * velocity
        if runs_away or not is_finite(at):
            wp.atomic_max(trouble, place, UNSTABLE)
    q_out[i] = at
    qd_out[i] = velocity
