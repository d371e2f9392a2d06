"""Implicit steps of a Newton model: the motions d of particles, and of the bodies that these touch, within a step.

With v the velocities, f the forces on particles, and those of rows at the end, backward Euler with one
linearisation of the elastic forces is

    (M (1/dt^2 + damping/dt) + K + D/dt) d = M v/dt + f + rows(d),      v_after = d/dt.

K is R K R^T with each element's rotation where free pieces are turned as they will turn in the step (``turning``). The
forces f are those there plus K times the way to there. D is the viscosity midway, where a turn has none.

A vector has an entry for each particle, and two for each body, of its translation and its rotation. Entries of what is
held, or moves as prescribed, are not free.
"""

import functools
from typing import Any

import warp as wp

from warp_corot.kernels.corotated.tangent import keep_gradients
from warp_corot.kernels.elements.constitutive import hooke, symmetric
from warp_corot.kernels.elements.elements import GeneralElements, load_node, store_node
from warp_corot.kernels.implicit.increments import COLUMNS, Sums, motion_of
from warp_corot.kernels.math.rotation import byers_xu, identity3
from warp_corot.kernels.stepping.balance import sum_of_lanes

from .elements import difference_gradient, viscous_product
from .particles import (
    SOUND,
    Bodies,
    Particles,
    gravity_of,
    is_active,
    is_fixed,
    is_moved,
    place_of,
    trouble_of,
)

wp.set_module_options({"enable_backward": False})


@wp.struct
class Linearised:
    """Elements where a step is linearised."""

    mu: wp.array[wp.float32]  # [T] [Pa]
    lam: wp.array[wp.float32]  # [T] [Pa]
    rotation: wp.array[wp.mat33]  # [T]
    gradient: wp.array[wp.mat33]  # [T] F midway; empty where nothing is viscous
    viscosity: wp.array[wp.float32]  # [T] over dt and |F|^2 / 3 [Pa]
    kept: wp.array[wp.vec4]  # turned gradients, see ``KeptGradients``; empty on CUDA


@wp.kernel(enable_backward=False)
def linearise(
    # In
    elements: GeneralElements,
    k_damp: wp.array[wp.float32],
    dt: float,
    q: wp.array[wp.vec3],
    turned: wp.array[wp.vec3],
    # Out
    made: Linearised,
):
    t = wp.tid()
    f = difference_gradient(elements, t, turned)
    r = byers_xu(f)
    made.rotation[t] = r
    if made.kept.shape[0] > 0:
        keep_gradients(elements, t, r, made.kept)
    if made.gradient.shape[0] > 0:
        f = 0.5 * (f + difference_gradient(elements, t, q))
        made.gradient[t] = f
        made.viscosity[t] = 3.0 * k_damp[t] / (dt * wp.max(wp.ddot(f, f), 1.0e-12))


@functools.cache
def linearised(is_viscous: bool) -> wp.Function:
    """The differential for ``elements.forces``."""

    @wp.func
    def linearised(elements: Any, t: int, made: Linearised, u: wp.array[wp.vec4], dg: wp.mat33):
        r = made.rotation[t]
        p = r * hooke(symmetric(wp.transpose(r) * dg), made.mu[t], made.lam[t])
        if wp.static(is_viscous):
            p += made.viscosity[t] * viscous_product(made.gradient[t], dg)
        return p

    return linearised


@wp.kernel(enable_backward=False)
def add_element_blocks(elements: GeneralElements, made: Linearised, blocks: wp.array[wp.mat33]):
    """Add the 3x3 blocks of K + D/dt on the diagonal; in closed form, at a sixth of the differentials' cost."""
    t = wp.tid()
    b = elements.rest_inverse[t]
    volume = elements.volume[t]
    first = -(b[0] + b[1] + b[2])
    for k in range(4):
        g = first
        if k > 0:
            g = b[k - 1]
        square = wp.dot(g, g)
        turned = made.rotation[t] * g
        block = (made.mu[t] * square) * identity3() + (made.mu[t] + made.lam[t]) * wp.outer(turned, turned)
        if made.gradient.shape[0] > 0:
            f = made.gradient[t]
            stretched = f * g
            block += made.viscosity[t] * ((0.5 * square) * (f * wp.transpose(f)) + 1.5 * wp.outer(stretched, stretched))
        wp.atomic_add(blocks, elements.nodes[t][k], volume * block)


@wp.kernel(enable_backward=False)
def begin_particles(
    # In
    dt: float,
    damping: float,
    particles: Particles,
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
    if trouble_of(i, particles, trouble) == SOUND and is_active(i, particles):
        motion = dt * qd[i]
        if particles.inv_mass[i] > 0.0:
            m = 1.0 / particles.inv_mass[i]
            free[k] = 1.0
            inertia[k] = (m * (1.0 / dt + damping) / dt) * wp.identity(3, dtype=wp.float32)
            g = gravity_of(i, particles)
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
    bodies: Bodies,
    gravity: wp.array[wp.vec3],
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
    for part in range(2):
        free[k + part] = 0.0
        store_node(b, k + part, wp.vec3())
        store_node(d, k + part, wp.vec3())
        store_node(fall, k + part, wp.vec3())
    if trouble[place_of(bodies.world[i], trouble.shape[0])] != SOUND or moves == 0:
        return
    linear = dt * wp.spatial_top(bodies.qd[i])
    angular = dt * wp.spatial_bottom(bodies.qd[i])
    store_node(d, k, linear)
    store_node(d, k + 1, angular)
    w = bodies.inv_mass[i]
    if w == 0.0 or is_fixed(i, bodies):
        return
    g = gravity[place_of(bodies.world[i], gravity.shape[0])]
    free[k] = 1.0
    inertia[k] = (1.0 / (w * dt * dt)) * wp.identity(3, dtype=wp.float32)
    store_node(b, k, linear / (w * dt * dt) + wp.spatial_top(body_f[i]) + g / w)
    store_node(fall, k, (dt * dt) * g)
    if wp.determinant(bodies.inv_inertia[i]) > 0.0:
        turn = wp.quat_to_matrix(wp.transform_get_rotation(bodies.q[i]))
        free[k + 1] = 1.0
        inertia[k + 1] = (turn * bodies.inertia[i] * wp.transpose(turn)) / (dt * dt)
        store_node(b, k + 1, inertia[k + 1] * angular + wp.spatial_bottom(body_f[i]))


@wp.kernel(enable_backward=False)
def finish_rows(
    # In
    free: wp.array[wp.float32],
    inertia: wp.array[wp.mat33],
    x: wp.array[wp.vec4],
    # In and out
    y: wp.array[wp.vec4],
):
    """y += M x at free entries, y = 0 at others."""
    k = wp.tid()
    v = wp.vec3()
    if free[k] > 0.0:
        v = load_node(y, k) + inertia[k] * load_node(x, k)
    store_node(y, k, v)


@wp.kernel(enable_backward=False)
def finish_blocks(free: wp.array[wp.float32], inertia: wp.array[wp.mat33], blocks: wp.array[wp.mat33]):
    k = wp.tid()
    block = wp.identity(3, dtype=wp.float32)
    if free[k] > 0.0:
        block = blocks[k] + inertia[k]
    blocks[k] = block


@wp.kernel(enable_backward=False)
def clear_held(free: wp.array[wp.float32], a: wp.array[wp.vec4]):
    """a = 0 at entries that are not free."""
    k = wp.tid()
    if free[k] == 0.0:
        store_node(a, k, wp.vec3())


@wp.kernel(enable_backward=False)
def count_solves(
    # In
    first: wp.array[wp.int32],
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
        linear = wp.max(linear, first[world] + iterations[world])
        if status[world] != good:
            unfinished = 1
    totals[0] = totals[0] + wp.int64(1)
    totals[1] = totals[1] + wp.int64(rounds[0] + 1)
    totals[2] = totals[2] + wp.int64(linear)
    totals[3] = totals[3] + wp.int64(unfinished)


# --- how free pieces turn in a step; see ``kernels.implicit.increments`` ----------------------------------------------
#
# A piece is all particles that tetrahedra connect. It is turned about its centre of mass, as it will turn in the step.


@wp.kernel(enable_backward=False)
def sum_motion(
    # In
    first: wp.array[wp.int32],
    members: wp.array[wp.int32],
    particles: Particles,
    q: wp.array[wp.vec3],
    qd: wp.array[wp.vec3],
    threads: int,
    lanes: int,
    # Out
    parts: wp.array3d[wp.float64],
):
    """Find parts of the sums of each piece, whose particles begin at ``first`` among the members."""
    piece, thread = wp.tid()
    total = Sums()
    k = first[piece] + thread
    while k < first[piece + 1]:
        i = members[k]
        if is_moved(i, particles):
            mass = wp.float64(1.0) / wp.float64(particles.inv_mass[i])
            total += motion_of(mass, False, wp.vec3d(q[i]), wp.vec3d(qd[i]))
        else:
            total += motion_of(wp.float64(0.0), True, wp.vec3d(), wp.vec3d())
        k += threads
    for column in range(COLUMNS):
        part = sum_of_lanes(total[column])
        if thread % lanes == 0:
            parts[piece, thread / lanes, column] = part


@wp.kernel(enable_backward=False)
def turn_particles(
    # In
    piece_of: wp.array[wp.int32],
    q: wp.array[wp.vec3],
    centres: wp.array[wp.vec3],
    turns: wp.array[wp.mat33],
    entry: wp.array[wp.int32],
    # In and out
    u: wp.array[wp.vec4],
    # Out
    turned: wp.array[wp.vec3],
    way: wp.array[wp.vec4],
):
    """Find the turned positions and the way to them; gathered displacements are turned, too."""
    i = wp.tid()
    at = q[i]
    d = wp.vec3()
    piece = piece_of[i]
    if piece >= 0:
        d = turns[piece] * (at - centres[piece])
        store_node(u, i, load_node(u, i) + d)
    turned[i] = at + d
    store_node(way, entry[i], d)
