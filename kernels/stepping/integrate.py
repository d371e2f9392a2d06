"""The motion of nodes in explicit steps, prescribed motions, and changes that users make to held and loaded nodes.

The state is the displacement from rest, because float32 positions would lose the digits that small strains need.
Positions are published for users after each run of steps, and adopted before the next run if a user has changed them.

Loads and positions may be arrays of other programs. Kernels that read them exist twice: for vec4 arrays, such as the
solver's own, and for vec3 arrays with any stride.

If there are fewer values than nodes, they are repeated: one value for all nodes, or the values of one world for every
world.
"""

from typing import Any

import warp as wp

from warp_corot.kernels.elements.elements import load_node, store_node
from warp_corot.kernels.modules import unique_kernel

from .pace import DONE, DT, Pace, key_before, length_before, time_after

wp.set_module_options({"enable_backward": False})


@wp.func
def vector_at(vectors: wp.array[wp.vec4], i: int):
    return load_node(vectors, i)


@wp.func
def vector_at(vectors: wp.array[wp.vec3], i: int):
    return vectors[i]


@wp.func
def write_vector(vectors: wp.array[wp.vec4], i: int, value: wp.vec3):
    store_node(vectors, i, value)


@wp.func
def write_vector(vectors: wp.array[wp.vec3], i: int, value: wp.vec3):
    vectors[i] = value


def by_vectors(kernel: wp.Kernel, argument: str) -> dict[type, wp.Kernel]:
    """The instances of a generic kernel for both vector types of one of its arrays.

    They are made once, because Warp would look for the right one at every launch. Replays of a recording on the CPU
    call the instance that was recorded last for all of them (Warp 1.19), so recorded ones must only read the array.
    """
    return {dtype: wp.overload(kernel, {argument: wp.array(dtype=dtype)}) for dtype in (wp.vec3, wp.vec4)}


@wp.func
def is_finite(a: wp.vec3):
    """False if any component is NaN or infinite."""
    return wp.abs(a[0]) + wp.abs(a[1]) + wp.abs(a[2]) <= 3.0e38


@wp.struct
class Dynamics:
    """What moves the nodes of a body in a step."""

    damping: float  # [1/s]
    gravity: wp.vec3  # [m/s^2]
    inverse_mass: wp.array[wp.float32]  # [1/kg]; zero for held nodes
    load: wp.array[wp.float32]  # external forces [N]; empty: there are none
    load_stride: int  # numbers from one node to the next
    rest: wp.array[wp.vec4]  # [m]
    f: wp.array[wp.vec4]  # all forces but loads and gravity [N]
    u: wp.array[wp.vec4]  # [m]
    v: wp.array[wp.vec4]  # [m/s]


@wp.func
def load_at(i: int, body: Dynamics):
    """The load on a node [N]."""
    load = wp.vec3()
    if body.load.shape[0] > 0:
        k = body.load_stride * i
        load = wp.vec3(body.load[k], body.load[k + 1], body.load[k + 2])
    return load


@wp.func
def force_at(i: int, body: Dynamics):
    """The force on a node besides gravity [N]."""
    return load_node(body.f, i) + load_at(i, body)


@wp.func
def symplectic_euler_velocity(
    v: wp.vec3, force: wp.vec3, inverse_mass: float, gravity: wp.vec3, dt: float, damped: float
):
    """(v + dt (f/m + g)) damped, where damped = 1 / (1 + dt damping)."""
    return (v + dt * (inverse_mass * force + gravity)) * damped


@wp.func
def add_support_work(elastic: wp.vec3, moved: wp.vec3, work: wp.array[wp.float64]):
    """Add the work [J] of a support that moves a node against its elastic force; zero is not added, which saves
    time."""
    added = wp.float64(-wp.dot(elastic, moved))
    if added != wp.float64(0.0):
        wp.atomic_add(work, 0, added)
        wp.atomic_add(work, 1, wp.abs(added))


@wp.func
def count_support_work(elastic: wp.vec3, moved: wp.vec3, i: int, work: wp.array[wp.float64]):
    """``add_support_work`` for a ``work`` array with two places for all nodes, or two for each node i.

    The absolute values are in the second half.
    """
    added = wp.float64(-wp.dot(elastic, moved))
    if added != wp.float64(0.0):
        count = work.shape[0] / 2
        wp.atomic_add(work, i % count, added)
        wp.atomic_add(work, count + i % count, wp.abs(added))


@unique_kernel()
def step_symplectic_euler(
    # In
    damping: float,
    gravity: wp.vec3,
    mass: wp.array[wp.float32],
    inverse_mass: wp.array[wp.float32],
    has_load: int,
    load: wp.array[Any],
    pace: Pace,
    offset: int,
    # In and out
    f: wp.array[wp.vec4],
    u: wp.array[wp.vec4],
    v: wp.array[wp.vec4],
    # Out
    reactions: wp.array[wp.vec4],
    support_work: wp.array[wp.float64],
    bad_step: wp.array[wp.int64],
):
    """v <- (v + dt (f/m + g)) / (1 + dt damping); u <- u + dt v; f <- 0, so that the next step can add to it.

    After the length of a step has changed, forces act for half of the old length and half of the new one.

    ``offset`` is this step's place in a recorded run; ``pace`` counts the steps of a run only at its end.
    ``support_work`` adds up the work of moving supports against the elastic forces, and its absolute value [J], in two
    places for all nodes, or in two places for each. A node without inverse mass moves with its present velocity (zero
    if fixed), and its support bears the weight, the elastic force and the load.
    """
    i = wp.tid()
    dt = float(pace.seconds[DT])
    kick = dt
    if offset == 0:
        kick = 0.5 * (float(length_before(pace)) + dt)
    elastic = load_node(f, i)
    force = elastic
    if has_load != 0:
        force += vector_at(load, i)
    w = inverse_mass[i]
    velocity = load_node(v, i)
    if w > 0.0:
        velocity = symplectic_euler_velocity(velocity, force, w, gravity, kick, 1.0 / (1.0 + dt * damping))
        store_node(v, i, velocity)
    else:
        store_node(reactions, i, -(force + mass[i] * gravity))
        count_support_work(elastic, kick * velocity, i, support_work)
    displacement = load_node(u, i) + dt * velocity
    store_node(u, i, displacement)
    store_node(f, i, wp.vec3())
    if not is_finite(displacement):
        wp.atomic_min(bad_step, 0, pace.counts[DONE] + wp.int64(offset + 1))


@wp.kernel(enable_backward=False)
def take_in_work(parts: wp.array2d[wp.float64], support_work: wp.array[wp.float64]):
    """Add the work of supports in the parts of a step to that of the step, and empty them."""
    for part in range(parts.shape[0]):
        for k in range(2):
            support_work[k] += parts[part, k]
            parts[part, k] = wp.float64(0.0)


@unique_kernel()
def set_start(pace: Pace, world_starts: wp.array[wp.float64]):
    """Set the starting time of the only world to the present time."""
    world_starts[0] = time_after(pace, 0)


@unique_kernel()
def follow_trajectory(
    # In
    nodes: wp.array[wp.int32],
    times: wp.array[wp.float64],
    displacements: wp.array2d[wp.vec3],
    pace: Pace,
    world_starts: wp.array[wp.float64],
    world_node_count: int,
    offset: int,
    f: wp.array[wp.vec4],
    u: wp.array[wp.vec4],
    # Out
    v: wp.array[wp.vec4],
    support_work: wp.array[wp.float64],
):
    """Give prescribed nodes the velocity that moves them to their keyframed displacement at the end of the step.

    The work of a step is that of the mean of the forces f at its two ends (trapezoidal rule): each force counts along
    half of the motion before it and half of the motion after it. The step itself counts both halves with the velocity
    after it; the difference is added here.
    """
    k = wp.tid()
    i = nodes[k]
    start = world_starts[i // world_node_count]
    t = time_after(pace, offset + 1) - start
    key, s = key_before(times, t)
    row = wp.min(k, displacements.shape[1] - 1)
    a = displacements[key, row]
    target = a + s * (displacements[key + 1, row] - a)
    dt = float(pace.seconds[DT])
    before = dt
    if offset == 0:
        before = float(length_before(pace))
    velocity = (target - load_node(u, i)) / dt
    count_support_work(load_node(f, i), 0.5 * before * (load_node(v, i) - velocity), i, support_work)
    store_node(v, i, velocity)


@wp.kernel(enable_backward=False)
def publish_positions(
    # In
    rest: wp.array[wp.vec4],
    u: wp.array[wp.vec4],
    # Out
    positions: wp.array[Any],
):
    i = wp.tid()
    write_vector(positions, i, load_node(rest, i) + load_node(u, i))


@wp.kernel(enable_backward=False)
def adopt_positions(
    # In
    rest: wp.array[wp.vec4],
    positions: wp.array[Any],
    # In and out
    u: wp.array[wp.vec4],
):
    """Adopt positions that a user wrote since they were published; the others keep the digits of their
    displacements."""
    i = wp.tid()
    x = load_node(rest, i)
    p = vector_at(positions, i)
    q = x + load_node(u, i)
    if p[0] != q[0] or p[1] != q[1] or p[2] != q[2]:
        store_node(u, i, p - x)


@unique_kernel()
def reset_nodes(
    # In
    chosen: wp.array[wp.int32],
    world_node_count: int,
    has_initial: int,
    initial_u: wp.array[wp.vec4],
    initial_v: wp.array[wp.vec4],
    rest: wp.array[wp.vec4],
    inverse_mass: wp.array[wp.float32],
    pace: Pace,
    # Out
    u: wp.array[wp.vec4],
    v: wp.array[wp.vec4],
    positions: wp.array[Any],
    reactions: wp.array[wp.vec4],
    world_starts: wp.array[wp.float64],
):
    """Reset the nodes of chosen worlds to their initial state, or to rest if there is none.

    Held nodes keep their velocity.
    """
    i = wp.tid()
    world = i // world_node_count
    if chosen[world] == 0:
        return
    if i % world_node_count == 0:
        world_starts[world] = time_after(pace, 0)
    displacement = wp.vec3()
    velocity = wp.vec3()
    if has_initial != 0:
        displacement = load_node(initial_u, i)
        velocity = load_node(initial_v, i)
    if inverse_mass[i] > 0.0:
        store_node(v, i, velocity)
    store_node(u, i, displacement)
    write_vector(positions, i, load_node(rest, i) + displacement)
    store_node(reactions, i, wp.vec3())


STEP_SYMPLECTIC_EULER = by_vectors(step_symplectic_euler, "load")
PUBLISH_POSITIONS = by_vectors(publish_positions, "positions")
ADOPT_POSITIONS = by_vectors(adopt_positions, "positions")
RESET_NODES = by_vectors(reset_nodes, "positions")


@wp.func
def inverse_of(mass: float):
    """The inverse mass of a free node, 1/m, or zero if it has no mass [1/kg]."""
    if mass > 0.0:
        return float(wp.float64(1.0) / wp.float64(mass))
    return float(0.0)


@wp.kernel(enable_backward=False)
def free_nodes(
    # In
    mass: wp.array[wp.float32],
    held: wp.array[wp.uint8],
    # Out
    inverse_mass: wp.array[wp.float32],
):
    """Give every free node its inverse mass, and held nodes zero."""
    i = wp.tid()
    inverse = float(0.0)
    if held[i] == wp.uint8(0):
        inverse = inverse_of(mass[i])
    inverse_mass[i] = inverse


@wp.kernel(enable_backward=False)
def hold_nodes(
    # In
    nodes: wp.array[wp.int32],
    velocities: wp.array[wp.vec3],
    # Out
    held: wp.array[wp.uint8],
    inverse_mass: wp.array[wp.float32],
    v: wp.array[wp.vec4],
):
    """Hold nodes; they move with the given velocities [m/s]. With zero they stay where they are."""
    k = wp.tid()
    i = nodes[k]
    held[i] = wp.uint8(1)
    inverse_mass[i] = 0.0
    store_node(v, i, velocities[k % velocities.shape[0]])


@wp.kernel(enable_backward=False)
def release_nodes(
    # In
    nodes: wp.array[wp.int32],
    mass: wp.array[wp.float32],
    # Out
    held: wp.array[wp.uint8],
    inverse_mass: wp.array[wp.float32],
    reactions: wp.array[wp.vec4],
):
    """Release nodes; they keep their present velocities."""
    i = nodes[wp.tid()]
    held[i] = wp.uint8(0)
    inverse_mass[i] = inverse_of(mass[i])
    store_node(reactions, i, wp.vec3())


@wp.kernel(enable_backward=False)
def load_nodes(
    # In
    nodes: wp.array[wp.int32],
    forces: wp.array[wp.vec3],
    # Out
    loads: wp.array[Any],
):
    """Set the loads of nodes [N]."""
    k = wp.tid()
    write_vector(loads, nodes[k], forces[k % forces.shape[0]])


LOAD_NODES = by_vectors(load_nodes, "loads")


# --- active stress that follows keyframes ----------------------------------------------------------------------------


@wp.kernel(enable_backward=False)
def follow_activation(
    # In
    elements: wp.array[wp.int32],
    times: wp.array[wp.float64],
    stress: wp.array2d[wp.float32],
    pace: Pace,
    world_starts: wp.array[wp.float64],
    world_element_count: int,
    offset: int,
    # Out
    activation: wp.array[wp.float32],
):
    """Set the active stress [Pa] to the keyframes' value at the beginning of a step, ``offset`` steps after the last
    counted one.
    """
    k = wp.tid()
    t = elements[k]
    start = world_starts[t // world_element_count]
    now = time_after(pace, offset) - start
    key, s = key_before(times, now)
    row = wp.min(k, stress.shape[1] - 1)
    a = stress[key, row]
    activation[t] = a + s * (stress[key + 1, row] - a)
