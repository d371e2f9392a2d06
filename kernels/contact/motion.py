"""The input of contact for a step: places on the surfaces, and the motion of obstacles."""

import warp as wp

from warp_corot.kernels.elements.elements import load_node
from warp_corot.kernels.stepping.integrate import Dynamics, force_at, symplectic_euler_velocity
from warp_corot.kernels.stepping.pace import DT, Pace, length_before, time_after

wp.set_module_options({"enable_backward": False})

#: How an obstacle moves: not at all, along keyframes, or towards a target at limited speed.
FIXED, KEYED, SENT = (wp.constant(k) for k in range(3))


@wp.struct
class Bearing:
    """The places that other nodes bear, [S], or empty if there are none, and these nodes, [B]; see ``bearing``."""

    bearers: wp.array[wp.vec4i]  # [S] places among the bearers; -1: the place is a node itself
    weights: wp.array[wp.vec4]  # [S] their weights
    loose: wp.array[wp.float32]  # [S] the share of the weights that free nodes have
    held: wp.array[wp.vec3]  # [S] the part of the displacement that comes from held nodes [m]
    d: wp.array[wp.vec3]  # [B] motion in this step without contact [m]
    yielding: wp.array[wp.float32]  # [B] additional motion per force [m/N]
    starts: wp.array[wp.int32]  # [B + 1] the places that a node bears, from one start to the next
    places: wp.array[wp.int32]
    shares: wp.array[wp.float32]  # its weights there


@wp.struct
class Surface:
    """The surface of all bodies in all worlds: places, which are nodes or points that nodes bear."""

    node: wp.array[wp.int32]  # [S] index among the nodes of all worlds of its body, or of one that bears it; -1: unused
    world: wp.array[wp.int32]  # [S]
    rest: wp.array[wp.vec3]  # [S] rest position [m]
    x: wp.array[wp.vec3]  # [S] where it is [m]
    d: wp.array[wp.vec3]  # [S] its motion in this step [m]; after an explicit step that with contact, near things
    yielding: wp.array[wp.float32]  # [S] additional motion per force [m/N]; zero for held nodes
    f: wp.array[wp.vec3]  # [S] contact force [N]
    bearing: Bearing
    body: wp.array[wp.int32]  # [S]
    triangles: wp.array[wp.vec3i]  # [T] places; -1: unused
    opposite: wp.array[wp.int32]  # [T] the fourth nodes of their tetrahedra, -1 inside the body
    # [T] fraction of the last step's normal force of an obstacle that is left beside corners that touch
    warmth: wp.array[wp.float32]
    edges: wp.array[wp.vec2i]  # [E] places; -1: unused
    sides: wp.array[wp.vec2i]  # [E] their two triangles
    # [S + 1] for each place, from one start to the next, three times a triangle there and which corner
    corner_starts: wp.array[wp.int32]
    corners: wp.array[wp.int32]


@wp.struct
class Part:
    """The surface of a body in a step. Its carriers are places, or the nodes that bear places."""

    number: int
    place: int  # its first place
    start: int  # its first carrier among ``nodes``
    shift: int  # how much larger the numbers of these are among all carriers; zero: they are places
    nodes: Surface
    dynamics: Dynamics
    pace: Pace
    offset: int  # the number of the step since the clock was last advanced


@wp.struct
class Motions:
    """The motion of obstacles, [O], or [W, O] with a row for each world."""

    mode: wp.array[wp.int32]
    speed: wp.array2d[wp.float32]  # SENT: at most [m/s]
    reach: wp.array[wp.float32]  # largest distance of its points from its origin [m], for rotations
    first: wp.array[wp.int32]  # KEYED: the first key
    keys: wp.array[wp.int32]  # how many
    times: wp.array[wp.float64]
    poses: wp.array[wp.transform]
    target: wp.array2d[wp.transform]
    now: wp.array2d[wp.transform]
    later: wp.array2d[wp.transform]  # at the end of the step


@wp.struct
class Foreseen:
    """A place without contact; see ``Surface``."""

    rest: wp.vec3
    x: wp.vec3
    d: wp.vec3
    yielding: float
    loose: float  # share of the weights that free nodes have
    held: wp.vec3  # part of the displacement that comes from held nodes [m]


@wp.func
def kick_of(pace: Pace, offset: int):
    """How long forces act until the velocity of this step: half of the last step and half of this one [s]."""
    dt = float(pace.seconds[DT])
    if offset == 0:
        return 0.5 * (float(length_before(pace)) + dt)
    return dt


@wp.func
def foreseen(i: int, part: Part):
    """The position of a node and its motion in this step without contact, as the step computes it."""
    body = part.dynamics
    dt = float(part.pace.seconds[DT])
    kick = kick_of(part.pace, part.offset)
    damped = 1.0 / (1.0 + dt * body.damping)
    w = body.inverse_mass[i]
    velocity = load_node(body.v, i)
    if w > 0.0:
        velocity = symplectic_euler_velocity(velocity, force_at(i, body), w, body.gravity, kick, damped)
    found = Foreseen()
    found.rest = load_node(body.rest, i)
    found.x = found.rest + load_node(body.u, i)
    found.d = dt * velocity
    found.yielding = dt * kick * w * damped
    return found


@wp.func
def between(a: wp.transform, b: wp.transform, share: float):
    """Interpolate between two poses: a straight line, with a uniform rotation the shorter way."""
    p = wp.transform_get_translation(a)
    q = wp.transform_get_rotation(a)
    r = wp.transform_get_rotation(b)
    if wp.dot(q, r) < 0.0:
        r = -r
    place = p + share * (wp.transform_get_translation(b) - p)
    return wp.transformation(place, wp.normalize(wp.quat_slerp(q, r, share)))


@wp.func
def distance_between(a: wp.transform, b: wp.transform, reach: float):
    """An upper bound on the distance between the places of an obstacle's point in two poses [m]."""
    far = wp.length(wp.transform_get_translation(b) - wp.transform_get_translation(a))
    p = wp.transform_get_rotation(a)
    q = wp.transform_get_rotation(b)
    # For a large obstacle the rounding error of a zero rotation would be a large distance.
    if p[0] == q[0] and p[1] == q[1] and p[2] == q[2] and p[3] == q[3]:
        return far
    turn = wp.quat_inverse(p) * q
    sine = wp.length(wp.vec3(turn[0], turn[1], turn[2]))
    return far + reach * 2.0 * wp.atan2(sine, wp.abs(turn[3]))


@wp.func
def sent(now: wp.transform, target: wp.transform, most: float, reach: float):
    """Move towards a target so that no point of the obstacle moves by more than ``most`` [m]."""
    far = distance_between(now, target, reach)
    if far <= most:
        return target
    return between(now, target, most / far)


@wp.func
def move_obstacle(world: int, o: int, motions: Motions, pace: Pace, world_starts: wp.array[wp.float64], offset: int):
    """Take an obstacle's pose at the end of the last step as its current one, and find its pose at the end of this
    step.
    """
    now = motions.later[world, o]
    motions.now[world, o] = now
    mode = motions.mode[o]
    if mode == KEYED:
        t = time_after(pace, offset + 1) - world_starts[world]
        # The last key that is not after t, excluding the final key; the first key if t is before all of them.
        key = motions.first[o]
        beyond = key + motions.keys[o] - 1
        while beyond - key > 1:
            middle = (key + beyond) // 2
            if motions.times[middle] <= t:
                key = middle
            else:
                beyond = middle
        share = (t - motions.times[key]) / (motions.times[key + 1] - motions.times[key])
        share = wp.clamp(share, wp.float64(0.0), wp.float64(1.0))
        motions.target[world, o] = between(motions.poses[key], motions.poses[key + 1], float(share))
    if mode != FIXED:
        most = motions.speed[world, o] * float(pace.seconds[DT])
        motions.later[world, o] = sent(now, motions.target[world, o], most, motions.reach[o])


@wp.kernel(enable_backward=False)
def take_targets(given: wp.array[wp.transform], o: int, target: wp.array2d[wp.transform]):
    """Copy the targets of tools, for each world or one for all. Invalid poses are skipped."""
    world = wp.tid()
    pose = given[wp.min(world, given.shape[0] - 1)]
    p = wp.transform_get_translation(pose)
    q = wp.transform_get_rotation(pose)
    length = wp.length(q)
    # False if a number is NaN or infinite.
    if wp.abs(p[0]) + wp.abs(p[1]) + wp.abs(p[2]) <= 3.0e38 and length > 0.0 and length <= 3.0e38:
        target[world, o] = wp.transformation(p, q / length)


@wp.kernel(enable_backward=False)
def reset_obstacles(chosen: wp.array[wp.int32], initial: wp.array2d[wp.transform], motions: Motions):
    """Put obstacles back to their first poses in the worlds that are reset."""
    world, o = wp.tid()
    if chosen[world] != 0:
        motions.now[world, o] = initial[world, o]
        motions.later[world, o] = initial[world, o]
        motions.target[world, o] = initial[world, o]


@wp.kernel(enable_backward=False)
def measure_rates(
    start: int, node: wp.array[wp.int32], v: wp.array[wp.vec4], thinnest: float, rates: wp.array[wp.float32]
):
    """Find how many times a second the fastest node could pass through the thinnest obstacle [1/s]."""
    i = node[start + wp.tid()]
    if i >= 0:
        rate = wp.length(load_node(v, i)) / thinnest
        if rate > rates[1]:
            wp.atomic_max(rates, 1, rate)
