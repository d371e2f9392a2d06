"""Particles of a Newton model through a step: into padded arrays, one step of symplectic Euler, and out again.

A step is taken world by world or not at all. Velocities after the step are found first, and a world in which anything
is not finite is marked; then all other worlds are written, and the marked ones keep the state they came with.
"""

import warp as wp

from .elements import load_node, store_node
from .integrate import is_finite
from .newton_worlds import BAD_INPUT, RUNAWAY, SOUND, UNSTABLE, place_of

wp.set_module_options({"enable_backward": False})

#: Newton's ``ParticleFlags.ACTIVE``.
ACTIVE = wp.constant(1)


@wp.kernel(enable_backward=False)
def gather_particles(
    # In
    q: wp.array[wp.vec3],
    qd: wp.array[wp.vec3],
    external: wp.array[wp.vec3],
    world: wp.array[wp.int32],
    # Out
    x: wp.array[wp.vec4],
    v: wp.array[wp.vec4],
    f: wp.array[wp.vec4],
    trouble: wp.array[wp.int32],
):
    """Positions and velocities padded to 16 bytes; forces begin with the external ones [N]."""
    i = wp.tid()
    store_node(x, i, q[i])
    store_node(v, i, qd[i])
    store_node(f, i, external[i])
    if not (is_finite(q[i]) and is_finite(qd[i]) and is_finite(external[i])):
        trouble[place_of(world[i], trouble.shape[0])] = BAD_INPUT


@wp.kernel(enable_backward=False)
def gather_nodes(
    # In
    particles: wp.array[wp.int32],
    x: wp.array[wp.vec4],
    rest: wp.array[wp.vec4],
    # Out
    u: wp.array[wp.vec4],
):
    """Displacements of a forest's nodes from where they rest."""
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
    """Add a forest's nodal forces to the particles' and begin anew with none. A particle is one node at most."""
    k = wp.tid()
    i = particles[k]
    store_node(f, i, load_node(f, i) + load_node(nodal, k))
    store_node(nodal, k, wp.vec3())


@wp.kernel(enable_backward=False)
def step_velocities(
    # In
    dt: float,
    damping: float,
    most: float,
    gravity: wp.array[wp.vec3],
    inverse_mass: wp.array[wp.float32],
    flags: wp.array[wp.int32],
    world: wp.array[wp.int32],
    f: wp.array[wp.vec4],
    x: wp.array[wp.vec4],
    # In and out
    v: wp.array[wp.vec4],
    # Out
    trouble: wp.array[wp.int32],
):
    """v <- (v + dt (f/m + g)) / (1 + dt damping), no faster than ``most``.

    A particle of no mass is kinematic: it keeps its velocity. One that is not active is frozen. What would be faster
    than ``RUNAWAY`` marks its world as what is not finite does.
    """
    i = wp.tid()
    velocity = load_node(v, i)
    runs_away = bool(False)
    w = inverse_mass[i]
    if (flags[i] & ACTIVE) != 0:
        if w > 0.0:
            g = gravity[place_of(world[i], gravity.shape[0])]
            velocity = (velocity + dt * (w * load_node(f, i) + g)) / (1.0 + dt * damping)
        # Scaled, so that nothing is out of range.
        size = wp.max(wp.max(wp.abs(velocity)), 1.0)
        speed = size * wp.length(velocity / size)
        runs_away = speed >= RUNAWAY
        if speed > most:
            velocity = velocity * (most / speed)
        store_node(v, i, velocity)
    if runs_away or not is_finite(load_node(x, i) + dt * velocity):
        wp.atomic_max(trouble, place_of(world[i], trouble.shape[0]), UNSTABLE)


@wp.kernel(enable_backward=False)
def move_particles(
    # In
    dt: float,
    flags: wp.array[wp.int32],
    world: wp.array[wp.int32],
    trouble: wp.array[wp.int32],
    q: wp.array[wp.vec3],
    qd: wp.array[wp.vec3],
    v: wp.array[wp.vec4],
    # Out
    q_out: wp.array[wp.vec3],
    qd_out: wp.array[wp.vec3],
):
    """x <- x + dt v in sound worlds; the others keep what they came with, or what was there if that was not finite."""
    i = wp.tid()
    wrong = trouble[place_of(world[i], trouble.shape[0])]
    if wrong == SOUND:
        velocity = load_node(v, i)
        moving = (flags[i] & ACTIVE) != 0
        q_out[i] = q[i] + wp.where(moving, dt, 0.0) * velocity
        qd_out[i] = velocity
    elif wrong != BAD_INPUT:
        q_out[i] = q[i]
        qd_out[i] = qd[i]


@wp.kernel(enable_backward=False)
def unpad(a: wp.array[wp.vec4], b: wp.array[wp.vec3]):
    i = wp.tid()
    b[i] = load_node(a, i)
