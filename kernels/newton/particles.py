"""Particles and bodies of a Newton model through a step: into padded arrays, one step of symplectic Euler, and out
again; worlds with a failure, which are found, restored and reported; and worlds that are reset.

A world is stepped completely or not at all. A world with a value that is not finite is marked, and its input state is
restored. If the input was not finite, the world is not written at all. Entities in no world (-1) use the last entry of
arrays over worlds.
"""

import functools

import warp as wp

from warp_corot.kernels.elements.elements import add_force, load_node, store_node
from warp_corot.kernels.stepping.integrate import is_finite

wp.set_module_options({"enable_backward": False})

#: Newton's ``ParticleFlags.ACTIVE``.
ACTIVE = wp.constant(1)
# Failures of a world in this step; the report keeps the largest number of a world with a failure, plus one.
# Of two failures, the graver one has the larger number.
SOUND, UNSTABLE, TOO_MANY_CONTACTS, TOO_MANY_PAIRS, BAD_INPUT = (wp.constant(k) for k in range(5))
REPORTS = 5

#: What particles had in the last step, if not ``rows.Row.ease``: nobody knows; no row.
UNKNOWN_BEFORE, NO_ROW = wp.constant(-2.0), wp.constant(-1.0)

#: Newton's default for the largest speed of a particle [m/s]. Beyond it the state is a failure.
RUNAWAY = wp.constant(1.0e5)


@wp.struct
class Particles:
    """Particles of a model, with Newton's names."""

    flags: wp.array[wp.int32]
    world: wp.array[wp.int32]
    inv_mass: wp.array[wp.float32]
    gravity: wp.array[wp.vec3]  # of each world


@wp.struct
class Bodies:
    """Rigid bodies of a model, with Newton's names, and their state."""

    fixed_flag: int  # of bodies with prescribed motion
    flags: wp.array[wp.int32]
    world: wp.array[wp.int32]
    inv_mass: wp.array[wp.float32]
    inv_inertia: wp.array[wp.mat33]
    inertia: wp.array[wp.mat33]
    com: wp.array[wp.vec3]
    places: wp.array[wp.float32]  # at how many places each may be touched or is held
    q: wp.array[wp.transform]
    qd: wp.array[wp.spatial_vector]


@wp.func
def place_of(world: int, count: int):
    """A world's entry in an array over worlds; the last one stands for no world."""
    return wp.where(world < 0, count - 1, world)


@wp.func
def is_active(i: int, particles: Particles):
    return (particles.flags[i] & ACTIVE) != 0


@wp.func
def is_moved(i: int, particles: Particles):
    """Whether forces move a particle."""
    return is_active(i, particles) and particles.inv_mass[i] > 0.0


@wp.func
def gravity_of(i: int, particles: Particles):
    return particles.gravity[place_of(particles.world[i], particles.gravity.shape[0])]


@wp.func
def trouble_of(i: int, particles: Particles, trouble: wp.array[wp.int32]):
    """The failure of a particle's world."""
    return trouble[place_of(particles.world[i], trouble.shape[0])]


@wp.func
def mark(i: int, wrong: int, particles: Particles, trouble: wp.array[wp.int32]):
    """Mark the world of a particle."""
    wp.atomic_max(trouble, place_of(particles.world[i], trouble.shape[0]), wrong)


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
    particles: Particles,
    rest: wp.array[wp.vec4],
    wrong: int,
    # In and out
    before: wp.array[wp.float32],
    after: wp.array[wp.float32],
    # Out
    u: wp.array[wp.vec4],
    f: wp.array[wp.vec4],
    kept_q: wp.array[wp.vec3],
    kept_qd: wp.array[wp.vec3],
    trouble: wp.array[wp.int32],
):
    """Gather displacements from ``rest``, or positions if it is empty, and copies into the arrays that are not empty;
    forces start with the external ones [N]. A value that is not finite marks its world.

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
    from_rest = at
    if rest.shape[0] > 0:
        from_rest = at - load_node(rest, i)
    store_node(u, i, from_rest)
    if kept_q.shape[0] > 0:
        store_vector(kept_q, i, at)
        store_vector(kept_qd, i, velocity)
    if not (is_finite(at) and is_finite(velocity) and is_finite(force)):
        mark(i, wrong, particles, trouble)


@wp.kernel(enable_backward=False)
def step_particles(
    # In
    dt: float,
    damping: float,
    most: float,
    fastest: float,
    particles: Particles,
    f: wp.array[wp.vec4],
    q: wp.array[wp.vec3],
    qd: wp.array[wp.vec3],
    entry: wp.array[wp.int32],
    d: wp.array[wp.vec4],
    # Out
    q_out: wp.array[wp.vec3],
    qd_out: wp.array[wp.vec3],
    trouble: wp.array[wp.int32],
):
    """v <- (v + dt (f/m + g)) / (1 + dt damping), or d/dt of solved motions d; x <- x + dt v.

    A particle without mass is kinematic: it keeps its velocity. An inactive one is frozen. In worlds marked before
    nothing moves. No active particle is faster than ``most`` [m/s]; one faster than ``fastest`` marks its world, like a
    value that is not finite.

    Args:
        entry, d: Where the motion of each particle is, and motions [m], see ``implicit``; empty in explicit steps.
    """
    i = wp.tid()
    wrong = trouble_of(i, particles, trouble)
    if wrong == BAD_INPUT:
        return
    at = q[i]
    velocity = qd[i]
    if wrong == SOUND and is_active(i, particles):
        w = particles.inv_mass[i]
        if w > 0.0 and d.shape[0] > 0:
            velocity = load_node(d, entry[i]) / dt
        elif w > 0.0:
            velocity = (velocity + dt * (w * load_node(f, i) + gravity_of(i, particles))) / (1.0 + dt * damping)
        # Scaled, so that nothing overflows.
        size = wp.max(wp.max(wp.abs(velocity)), 1.0)
        speed = size * wp.length(velocity / size)
        if speed > most:
            velocity = velocity * (most / speed)
        at += dt * velocity
        if speed >= fastest or not is_finite(at):
            mark(i, UNSTABLE, particles, trouble)
    store_vector(q_out, i, at)
    store_vector(qd_out, i, velocity)


@wp.kernel(enable_backward=False)
def add_changes(
    # In
    dt: float,
    particles: Particles,
    before: wp.array[wp.vec3],
    after: wp.array[wp.vec3],
    # In and out
    f: wp.array[wp.vec4],
):
    """Add the forces besides gravity that changed velocities in a step."""
    i = wp.tid()
    if is_moved(i, particles):
        change = (after[i] - before[i]) / dt - gravity_of(i, particles)
        store_node(f, i, load_node(f, i) + change / particles.inv_mass[i])


@wp.kernel(enable_backward=False)
def scatter_blocks(
    # In
    pairs: wp.array[wp.vec2i],
    stiffness: wp.array[wp.mat33],
    damping: wp.array[wp.mat33],
    a: float,
    b: float,
    u: wp.array[wp.vec4],
    # Out
    f: wp.array[wp.vec4],
):
    """f -= (a K + b C) u of matrices that are given by blocks of pairs of particles, which may repeat."""
    k = wp.tid()
    pair = pairs[k]
    add_force(f, pair[0], -(a * stiffness[k] + b * damping[k]) * load_node(u, pair[1]))


# --- rigid bodies within a step, between the states that another solver gives ----------------------------------------


@wp.func
def is_fixed(b: int, bodies: Bodies):
    """Whether a body's motion is prescribed."""
    return (bodies.flags[b] & bodies.fixed_flag) != 0


@wp.kernel(enable_backward=False)
def move_bodies(elapsed: float, bodies: Bodies, moved: wp.array[wp.transform]):
    """Poses after a time [s] at constant velocities of the centres of mass and constant angular velocities."""
    b = wp.tid()
    pose, twist = bodies.q[b], bodies.qd[b]
    spin = wp.spatial_bottom(twist)
    angle = elapsed * wp.length(spin)
    rotation = wp.transform_get_rotation(pose)
    if angle > 0.0:
        rotation = wp.quat_from_axis_angle(wp.normalize(spin), angle) * rotation
    centre = wp.transform_point(pose, bodies.com[b]) + elapsed * wp.spatial_top(twist)
    moved[b] = wp.transform(centre - wp.quat_rotate(rotation, bodies.com[b]), rotation)


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


# --- worlds ----------------------------------------------------------------------------------------------------------


@wp.kernel(enable_backward=False)
def check_bodies(
    # In
    q: wp.array[wp.transform],
    qd: wp.array[wp.spatial_vector],
    world: wp.array[wp.int32],
    wrong: int,
    # Out
    trouble: wp.array[wp.int32],
):
    """Mark worlds with a body whose pose or velocity is not finite."""
    i = wp.tid()
    size = wp.dot(wp.abs(q[i][0:3]), wp.vec3(1.0)) + wp.dot(wp.abs(wp.spatial_top(qd[i])), wp.vec3(1.0))
    size += wp.dot(wp.abs(wp.spatial_bottom(qd[i])), wp.vec3(1.0))
    if not size <= 3.0e38:
        wp.atomic_max(trouble, place_of(world[i], trouble.shape[0]), wrong)


@functools.cache
def state_kernels(Place: type, Velocity: type) -> tuple[wp.Kernel, wp.Kernel]:
    """The kernels that finish a step and that reset a state, for states with these types: of particles vec3 both, of
    bodies transforms and spatial vectors.

    They are one module, so that those of resets are loaded with those of steps and may be recorded.
    """
    module = wp.get_module(f"newton_states_{Place.__name__}")
    module.options["enable_backward"] = False

    @wp.kernel(module=module, enable_backward=False)
    def finish(
        # In
        world: wp.array[wp.int32],
        trouble: wp.array[wp.int32],
        before_q: wp.array[Place],
        before_qd: wp.array[Velocity],
        made_q: wp.array[Place],
        made_qd: wp.array[Velocity],
        # Out
        q: wp.array[Place],
        qd: wp.array[Velocity],
    ):
        """Write what a step has made, and the state before it in marked worlds; where that was not finite, nothing.

        Args:
            before_q, before_qd: The state before the step.
            made_q, made_qd: The result; empty if it is in q and qd already.
        """
        i = wp.tid()
        wrong = trouble[place_of(world[i], trouble.shape[0])]
        if wrong == SOUND and made_q.shape[0] > 0:
            q[i] = made_q[i]
            qd[i] = made_qd[i]
        elif wrong != SOUND and wrong != BAD_INPUT:
            q[i] = before_q[i]
            qd[i] = before_qd[i]

    @wp.kernel(module=module, enable_backward=False)
    def reset(
        # In
        chosen: wp.array[wp.bool],
        world: wp.array[wp.int32],
        with_q: int,
        with_qd: int,
        initial_q: wp.array[Place],
        initial_qd: wp.array[Velocity],
        # Out
        q: wp.array[Place],
        qd: wp.array[Velocity],
    ):
        i = wp.tid()
        if chosen[place_of(world[i], chosen.shape[0])]:
            if with_q != 0:
                q[i] = initial_q[i]
            if with_qd != 0:
                qd[i] = initial_qd[i]

    return finish, reset


@wp.kernel(enable_backward=False)
def report_trouble(
    # In and out
    trouble: wp.array[wp.int32],
    # Out
    report: wp.array[wp.int32],
    seen: wp.array[wp.float64],
):
    """Record the failure and its world, and clear failures for the next step.

    Args:
        seen: Whether there was a failure, in the host's memory.
    """
    w = wp.tid()
    wrong = trouble[w]
    if wrong != SOUND:
        wp.atomic_max(report, wrong, w + 1)
        seen[0] = wp.float64(1.0)
        trouble[w] = SOUND
