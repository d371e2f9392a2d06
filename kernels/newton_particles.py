"""Particles of a Newton model through a step: into padded arrays, one step of symplectic Euler, and out again.

A step is taken world by world or not at all. Velocities after the step are found first, and a world in which anything
is not finite is marked; then all other worlds are written, and the marked ones keep the state they came with. Entities
of no world (-1) have the last place in arrays over worlds.
"""

import warp as wp

from .elements import load_node, store_node
from .integrate import is_finite

wp.set_module_options({"enable_backward": False})

#: Newton's ``ParticleFlags.ACTIVE``.
ACTIVE = wp.constant(1)

# What is wrong with a world in this step; the report keeps the largest number of a world it was seen in, plus one.
# The graver of two has the larger number.
SOUND = wp.constant(0)
UNSTABLE = wp.constant(1)
TOO_MANY_CONTACTS = wp.constant(2)
SURFACE_CONTACTS = wp.constant(3)
BAD_INPUT = wp.constant(4)
REPORTS = 5


#: Newton's default for how fast a particle may be [m/s]. What gets there is no motion any more.
RUNAWAY = wp.constant(1.0e5)


@wp.func
def place_of(world: int, count: int):
    """A world's place in an array over worlds; the last one is that of no world."""
    return wp.where(world < 0, count - 1, world)


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
def check_contact_count(
    # In
    count: wp.array[wp.int32],
    most: int,
    # Out
    trouble: wp.array[wp.int32],
):
    """More contacts than there is room for: nobody knows which worlds' are missing, so none is stepped."""
    w = wp.tid()
    if count[0] > most:
        wp.atomic_max(trouble, w, TOO_MANY_CONTACTS)


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


@wp.kernel(enable_backward=False)
def check_particles(
    # In
    q: wp.array[wp.vec3],
    qd: wp.array[wp.vec3],
    world: wp.array[wp.int32],
    # Out
    trouble: wp.array[wp.int32],
):
    i = wp.tid()
    if not (is_finite(q[i]) and wp.max(wp.abs(qd[i])) < 0.5 * RUNAWAY):
        wp.atomic_max(trouble, place_of(world[i], trouble.shape[0]), UNSTABLE)


@wp.kernel(enable_backward=False)
def put_back_particles(
    # In
    world: wp.array[wp.int32],
    trouble: wp.array[wp.int32],
    x: wp.array[wp.vec4],
    v: wp.array[wp.vec4],
    kept_q: wp.array[wp.vec3],
    kept_qd: wp.array[wp.vec3],
    # Out
    q: wp.array[wp.vec3],
    qd: wp.array[wp.vec3],
):
    """Undo what another solver wrote to particles of marked worlds."""
    i = wp.tid()
    wrong = trouble[place_of(world[i], trouble.shape[0])]
    if wrong == BAD_INPUT:
        q[i] = kept_q[i]
        qd[i] = kept_qd[i]
    elif wrong != SOUND:
        q[i] = load_node(x, i)
        qd[i] = load_node(v, i)


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
    b = wp.tid()
    size = wp.dot(wp.abs(q[b][0:3]), wp.vec3(1.0)) + wp.dot(wp.abs(wp.spatial_top(qd[b])), wp.vec3(1.0))
    size += wp.dot(wp.abs(wp.spatial_bottom(qd[b])), wp.vec3(1.0))
    if not (size <= 3.0e38):
        wp.atomic_max(trouble, place_of(world[b], trouble.shape[0]), wrong)


@wp.kernel(enable_backward=False)
def put_back_bodies(
    # In
    world: wp.array[wp.int32],
    trouble: wp.array[wp.int32],
    before_q: wp.array[wp.transform],
    before_qd: wp.array[wp.spatial_vector],
    kept_q: wp.array[wp.transform],
    kept_qd: wp.array[wp.spatial_vector],
    # Out
    q: wp.array[wp.transform],
    qd: wp.array[wp.spatial_vector],
):
    """Undo what a rigid solver wrote to bodies of marked worlds."""
    b = wp.tid()
    wrong = trouble[place_of(world[b], trouble.shape[0])]
    if wrong == BAD_INPUT:
        q[b] = kept_q[b]
        qd[b] = kept_qd[b]
    elif wrong != SOUND:
        q[b] = before_q[b]
        qd[b] = before_qd[b]


@wp.kernel(enable_backward=False)
def report_trouble(
    # In and out
    trouble: wp.array[wp.int32],
    # Out
    report: wp.array[wp.int32],
):
    """Remember what was wrong and in which world, and begin the next step with nothing wrong."""
    w = wp.tid()
    if trouble[w] != SOUND:
        wp.atomic_max(report, trouble[w], w + 1)
        trouble[w] = SOUND


@wp.kernel(enable_backward=False)
def reset_particles(
    # In
    chosen: wp.array[wp.bool],
    world: wp.array[wp.int32],
    with_q: int,
    with_qd: int,
    initial_q: wp.array[wp.vec3],
    initial_qd: wp.array[wp.vec3],
    # Out
    q: wp.array[wp.vec3],
    qd: wp.array[wp.vec3],
):
    i = wp.tid()
    if chosen[place_of(world[i], chosen.shape[0])]:
        if with_q != 0:
            q[i] = initial_q[i]
        if with_qd != 0:
            qd[i] = initial_qd[i]


@wp.kernel(enable_backward=False)
def reset_rotations(
    # In
    chosen: wp.array[wp.bool],
    world: wp.array[wp.int32],
    tets: wp.array[wp.vec4i],
    # Out
    rotations: wp.array[wp.quat],
):
    """Start the rotations of elements in chosen worlds from the identity again; an element is where its nodes are."""
    t = wp.tid()
    if chosen[place_of(world[tets[t][0]], chosen.shape[0])]:
        rotations[t] = wp.quat_identity()


@wp.kernel(enable_backward=False)
def reset_bodies(
    # In
    chosen: wp.array[wp.bool],
    world: wp.array[wp.int32],
    with_q: int,
    with_qd: int,
    initial_q: wp.array[wp.transform],
    initial_qd: wp.array[wp.spatial_vector],
    # Out
    q: wp.array[wp.transform],
    qd: wp.array[wp.spatial_vector],
):
    b = wp.tid()
    if chosen[place_of(world[b], chosen.shape[0])]:
        if with_q != 0:
            q[b] = initial_q[b]
        if with_qd != 0:
            qd[b] = initial_qd[b]
