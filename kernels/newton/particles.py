"""Particles of a Newton model through a step: into padded arrays, one step of symplectic Euler, and out again.

A world is stepped completely or not at all. A world with a value that is not finite is marked, and ``worlds``
restores its input state. If the input was not finite, the world is not written at all.
"""

import warp as wp

from warp_corot.kernels.elements.elements import load_node, store_node
from warp_corot.kernels.stepping.integrate import is_finite

from .worlds import BAD_INPUT, NO_ROW, SOUND, UNSTABLE, place_of

wp.set_module_options({"enable_backward": False})

#: Newton's ``ParticleFlags.ACTIVE``.
ACTIVE = wp.constant(1)


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    __shared__ float staged[3 * 1024];
    const unsigned all = 0xffffffffu;
    const int lane = threadIdx.x & 31;
    if (__activemask() == all && __all_sync(all, a.strides[0] == 12 && i == __shfl_sync(all, i, 0) + lane)) {
        float* const own = staged + 3 * (threadIdx.x - lane);
        float* const out = reinterpret_cast<float*>(&wp::index(a, i - lane));
        __syncwarp();
        for (int axis = 0; axis < 3; ++axis) own[3 * lane + axis] = value[axis];
        __syncwarp();
        for (int part = 0; part < 96; part += 32) out[part + lane] = own[part + lane];
        return;
    }
#endif
    wp::index(a, i) = value;
""")
def store_vector(a: wp.array[wp.vec3], i: int, value: wp.vec3):
    """Write vector i; neighbouring threads write neighbouring vectors.

    A vec3 is three words of four bytes, and a warp would write each to every third place: twelve sectors of memory,
    three times. So if all its threads are active, they exchange their words first and write whole sectors.
    """
    ...


@wp.kernel(enable_backward=False)
def gather_particles(
    # In
    q: wp.array[wp.vec3],
    qd: wp.array[wp.vec3],
    external: wp.array[wp.vec3],
    world: wp.array[wp.int32],
    rest: wp.array[wp.vec4],
    wrong: int,
    # In and out
    before: wp.array[wp.float32],
    after: wp.array[wp.float32],
    # Out
    x: wp.array[wp.vec4],
    u: wp.array[wp.vec4],
    f: wp.array[wp.vec4],
    kept_q: wp.array[wp.vec3],
    kept_qd: wp.array[wp.vec3],
    trouble: wp.array[wp.int32],
):
    """Gather positions, displacements from ``rest``, and copies into the arrays that are not empty; forces start with
    the external ones [N]. A value that is not finite marks its world.

    Args:
        before, after: What particles had in the last step, which is replaced, and have in this one; see ``records``.
    """
    i = wp.tid()
    if after.shape[0] > 0:
        before[i] = after[i]
        after[i] = NO_ROW
    at = q[i]
    velocity = qd[i]
    force = external[i]
    store_node(f, i, force)
    if x.shape[0] > 0:
        store_node(x, i, at)
    if u.shape[0] > 0:
        store_node(u, i, at - load_node(rest, i))
    if kept_q.shape[0] > 0:
        store_vector(kept_q, i, at)
        store_vector(kept_qd, i, velocity)
    if not (is_finite(at) and is_finite(velocity) and is_finite(force)):
        wp.atomic_max(trouble, place_of(world[i], trouble.shape[0]), wrong)


@wp.kernel(enable_backward=False)
def gather_nodes(
    # In
    particles: wp.array[wp.int32],
    x: wp.array[wp.vec4],
    rest: wp.array[wp.vec4],
    # Out
    u: wp.array[wp.vec4],
):
    """Displacements of a forest's nodes from their rest positions."""
    k = wp.tid()
    store_node(u, k, load_node(x, particles[k]) - load_node(rest, k))


@wp.kernel(enable_backward=False)
def add_nodes(
    # In
    particles: wp.array[wp.int32],
    # In and out
    nodal: wp.array[wp.vec4],
    # Out
    f: wp.array[wp.vec4],
):
    """Add a forest's nodal forces to the particles' and reset them to zero. A particle is at most one node."""
    k = wp.tid()
    i = particles[k]
    store_node(f, i, load_node(f, i) + load_node(nodal, k))
    store_node(nodal, k, wp.vec3())


@wp.kernel(enable_backward=False)
def step_particles(
    # In
    dt: float,
    damping: float,
    most: float,
    fastest: float,
    gravity: wp.array[wp.vec3],
    inverse_mass: wp.array[wp.float32],
    flags: wp.array[wp.int32],
    world: wp.array[wp.int32],
    f: wp.array[wp.vec4],
    q: wp.array[wp.vec3],
    qd: wp.array[wp.vec3],
    # Out
    q_out: wp.array[wp.vec3],
    qd_out: wp.array[wp.vec3],
    trouble: wp.array[wp.int32],
):
    """v <- (v + dt (f/m + g)) / (1 + dt damping), no faster than ``most``; x <- x + dt v.

    A particle without mass is kinematic: it keeps its velocity. An inactive one is frozen. A particle faster
    than ``fastest`` marks its world, like a value that is not finite; in worlds marked before nothing moves.
    """
    i = wp.tid()
    place = place_of(world[i], trouble.shape[0])
    wrong = trouble[place]
    if wrong == BAD_INPUT:
        return
    at = q[i]
    velocity = qd[i]
    if wrong == SOUND and (flags[i] & ACTIVE) != 0:
        w = inverse_mass[i]
        if w > 0.0:
            g = gravity[place_of(world[i], gravity.shape[0])]
            velocity = (velocity + dt * (w * load_node(f, i) + g)) / (1.0 + dt * damping)
        # Scaled, so that nothing overflows.
        size = wp.max(wp.max(wp.abs(velocity)), 1.0)
        speed = size * wp.length(velocity / size)
        runs_away = speed >= fastest
        if speed > most:
            velocity = velocity * (most / speed)
        at += dt * velocity
        if runs_away or not is_finite(at):
            wp.atomic_max(trouble, place, UNSTABLE)
    store_vector(q_out, i, at)
    store_vector(qd_out, i, velocity)


@wp.kernel(enable_backward=False)
def damp_particles(
    # In
    dt: float,
    damping: float,
    inverse_mass: wp.array[wp.float32],
    flags: wp.array[wp.int32],
    # In and out
    q: wp.array[wp.vec3],
    qd: wp.array[wp.vec3],
):
    """Apply the damping of ``step_particles`` after a step without it."""
    i = wp.tid()
    if inverse_mass[i] > 0.0 and (flags[i] & ACTIVE) != 0:
        velocity = qd[i]
        slower = velocity / (1.0 + dt * damping)
        q[i] += dt * (slower - velocity)
        qd[i] = slower


@wp.kernel(enable_backward=False)
def unpad(a: wp.array[wp.vec4], b: wp.array[wp.vec3]):
    i = wp.tid()
    b[i] = load_node(a, i)
