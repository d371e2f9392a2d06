"""Particles and bodies of a Newton model through a step: into padded arrays, one step of symplectic Euler, and out
again; worlds with a failure, which are found, restored and reported; and worlds that are reset.

A world is stepped completely or not at all. A world with a value that is not finite is marked, and its input state is
restored. If the input was not finite, the world is not written at all. Entities in no world (-1) use the last entry of
arrays over worlds.
"""

from typing import Any

import warp as wp

from warp_corot.kernels.elements.elements import load_node, store_node
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
    """Particles of a model in a state, with Newton's names."""

    flags: wp.array[wp.int32]
    world: wp.array[wp.int32]
    inv_mass: wp.array[wp.float32]
    radius: wp.array[wp.float32]
    gravity: wp.array[wp.vec3]  # of each world
    q: wp.array[wp.vec3]
    qd: wp.array[wp.vec3]
    trouble: wp.array[wp.int32]  # the failure of each world in this step


@wp.struct
class Bodies:
    """Rigid bodies of a model in a state, with Newton's names."""

    fixed_flag: int  # of bodies with prescribed motion
    flags: wp.array[wp.int32]
    world: wp.array[wp.int32]
    inv_mass: wp.array[wp.float32]
    inv_inertia: wp.array[wp.mat33]
    inertia: wp.array[wp.mat33]
    com: wp.array[wp.vec3]
    gravity: wp.array[wp.vec3]
    places: wp.array[wp.float32]  # at how many places each may be touched or is held
    q: wp.array[wp.transform]
    qd: wp.array[wp.spatial_vector]
    trouble: wp.array[wp.int32]


@wp.struct
class Memory:
    """What particles had in the last step and have in this one, see ``UNKNOWN_BEFORE``; empty without contacts."""

    eased: float  # how far contacts that were found late have been let out in the last step [m]
    before: wp.array[wp.float32]
    after: wp.array[wp.float32]


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
def in_world(owner: Any, i: int, values: wp.array[Any]):
    """The value of the world of particle or body i."""
    return values[place_of(owner.world[i], values.shape[0])]


@wp.func
def mark(i: int, wrong: int, owner: Any):
    """Mark the world of particle or body i."""
    wp.atomic_max(owner.trouble, place_of(owner.world[i], owner.trouble.shape[0]), wrong)


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
    particles: Particles,
    external: wp.array[wp.vec3],
    rest: wp.array[wp.vec4],
    wrong: int,
    # In and out
    memory: Memory,
    # Out
    u: wp.array[wp.vec4],
    f: wp.array[wp.vec4],
    kept_q: wp.array[wp.vec3],
    kept_qd: wp.array[wp.vec3],
):
    """Gather displacements from ``rest``, or positions if it is empty, and copies into the arrays that are not empty;
    forces start with the external ones [N]. A value that is not finite marks its world as ``wrong``. What particles
    have in this step becomes what they had before.
    """
    i = wp.tid()
    if memory.after.shape[0] > 0:
        memory.before[i] = memory.after[i]
        memory.after[i] = NO_ROW
    at = particles.q[i]
    velocity = particles.qd[i]
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
        mark(i, wrong, particles)


@wp.kernel(enable_backward=False)
def step_particles(
    # In
    dt: float,
    damping: float,
    most: float,
    fastest: float,
    particles: Particles,
    f: wp.array[wp.vec4],
    entry: wp.array[wp.int32],
    d: wp.array[wp.vec4],
    # Out
    q: wp.array[wp.vec3],
    qd: wp.array[wp.vec3],
):
    """v <- (v + dt (f/m + g)) / (1 + dt damping), or d/dt of solved motions d; x <- x + dt v.

    A particle without mass is kinematic: it keeps its velocity. An inactive one is frozen. In worlds marked before
    nothing moves. No active particle is faster than ``most`` [m/s]; one faster than ``fastest`` marks its world, like a
    value that is not finite.

    Args:
        entry, d: Where the motion of each particle is, and motions [m], see ``implicit``; empty in explicit steps.
    """
    i = wp.tid()
    wrong = in_world(particles, i, particles.trouble)
    if wrong == BAD_INPUT:
        return
    at = particles.q[i]
    velocity = particles.qd[i]
    if wrong == SOUND and is_active(i, particles):
        w = particles.inv_mass[i]
        if w > 0.0 and d.shape[0] > 0:
            velocity = load_node(d, entry[i]) / dt
        elif w > 0.0:
            g = in_world(particles, i, particles.gravity)
            velocity = (velocity + dt * (w * load_node(f, i) + g)) / (1.0 + dt * damping)
        # Scaled, so that nothing overflows.
        size = wp.max(wp.max(wp.abs(velocity)), 1.0)
        speed = size * wp.length(velocity / size)
        if speed > most:
            velocity = velocity * (most / speed)
        at += dt * velocity
        if speed >= fastest or not is_finite(at):
            mark(i, UNSTABLE, particles)
    store_vector(q, i, at)
    store_vector(qd, i, velocity)


@wp.kernel(enable_backward=False)
def add_changes(dt: float, particles: Particles, after: wp.array[wp.vec3], f: wp.array[wp.vec4]):
    """Add the forces besides gravity that changed velocities in a step."""
    i = wp.tid()
    if is_moved(i, particles):
        change = (after[i] - particles.qd[i]) / dt - in_world(particles, i, particles.gravity)
        store_node(f, i, load_node(f, i) + change / particles.inv_mass[i])


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
def add_wrenches(share: float, a: wp.array[wp.spatial_vector], b: wp.array[wp.spatial_vector]):
    """b += share a."""
    i = wp.tid()
    b[i] = b[i] + share * a[i]


# --- worlds ----------------------------------------------------------------------------------------------------------


@wp.kernel(enable_backward=False)
def check_bodies(bodies: Bodies, wrong: int):
    """Mark worlds with a body whose pose or velocity is not finite."""
    i = wp.tid()
    twist = bodies.qd[i]
    sum = wp.abs(bodies.q[i][0:3]) + wp.abs(wp.spatial_top(twist)) + wp.abs(wp.spatial_bottom(twist))
    if not wp.dot(sum, wp.vec3(1.0)) <= 3.0e38:
        mark(i, wrong, bodies)


def state_kernels(Place: type, Velocity: type) -> tuple[wp.Kernel, wp.Kernel]:
    """The kernels that finish a step and that reset a state, for states with these types.

    They are one module, so that those of resets are loaded with those of steps and may be recorded. They are not
    instances of one generic kernel, which recordings on the CPU mistake for one another.
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
        world: wp.array[wp.int32],
        chosen: wp.array[wp.bool],
        initial_q: wp.array[Place],
        initial_qd: wp.array[Velocity],
        # Out
        q: wp.array[Place],
        qd: wp.array[Velocity],
    ):
        """Reset what is in chosen worlds; arrays that are empty are left out."""
        i = wp.tid()
        if chosen[place_of(world[i], chosen.shape[0])]:
            if q.shape[0] > 0:
                q[i] = initial_q[i]
            if qd.shape[0] > 0:
                qd[i] = initial_qd[i]

    return finish, reset


FINISH_PARTICLES, RESET_PARTICLES = state_kernels(wp.vec3, wp.vec3)
FINISH_BODIES, RESET_BODIES = state_kernels(wp.transform, wp.spatial_vector)


@wp.kernel(enable_backward=False)
def report_trouble(trouble: wp.array[wp.int32], report: wp.array[wp.int32], seen: wp.array[wp.float64]):
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
