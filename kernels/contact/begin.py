"""The beginning of a step with contact: the motion of surfaces without contact, and the motion of obstacles."""

from typing import Any

import warp as wp

from warp_corot.kernels.elements.elements import load_node
from warp_corot.kernels.stepping.integrate import by_vectors, symplectic_euler_velocity, vector_at
from warp_corot.kernels.stepping.pace import DT, Pace, length_before

from .bearing import place_among
from .motion import Foreseen, Motions, Surface
from .watch import Watch, begin_obstacle, pair_of

wp.set_module_options({"enable_backward": False})

#: Number of threads of a block on CUDA: few, so that the places of a small surface are on many multiprocessors.
BLOCK = 64


@wp.func
def foreseen(
    i: int,
    damping: float,
    gravity: wp.vec3,
    inverse_mass: wp.array[wp.float32],
    has_load: int,
    load: wp.array[Any],
    pace: Pace,
    offset: int,
    rest: wp.array[wp.vec4],
    f: wp.array[wp.vec4],
    u: wp.array[wp.vec4],
    v: wp.array[wp.vec4],
):
    """The position of a node and its motion in this step without contact, as the step computes it."""
    dt = float(pace.seconds[DT])
    kick = dt
    if offset == 0:
        kick = 0.5 * (float(length_before(pace)) + dt)
    damped = 1.0 / (1.0 + dt * damping)
    force = load_node(f, i)
    if has_load != 0:
        force += vector_at(load, i)
    w = inverse_mass[i]
    velocity = load_node(v, i)
    if w > 0.0:
        velocity = symplectic_euler_velocity(velocity, force, w, gravity, kick, damped)
    found = Foreseen()
    found.rest = load_node(rest, i)
    found.x = found.rest + load_node(u, i)
    found.d = dt * velocity
    found.yielding = dt * kick * w * damped
    return found


@wp.kernel(enable_backward=False)
def begin_step(
    # In
    start: int,
    count: int,
    borne_start: int,
    borne: int,
    frames: int,
    obstacles: int,
    damping: float,
    gravity: wp.vec3,
    inverse_mass: wp.array[wp.float32],
    has_load: int,
    load: wp.array[Any],
    pace: Pace,
    offset: int,
    rest: wp.array[wp.vec4],
    f: wp.array[wp.vec4],
    u: wp.array[wp.vec4],
    v: wp.array[wp.vec4],
    bearers: Surface,
    motions: Motions,
    world_starts: wp.array[wp.float64],
    watches: int,
    # In and out
    watch: Watch,
    # Out
    nodes: Surface,
    surface: Surface,
):
    """Find the positions of a body's surface nodes and their motion in this step without contact, unless contact
    sleeps; move obstacles.

    Args:
        start, count: The first of the ``nodes``, which are places or bear them, and how many there are.
        borne_start, borne: The first place that nodes bear, and how many of them to find here.
        frames: Number of worlds in which the frame of the watch moves.
        obstacles: Number of obstacles of all worlds to move.
        watches: Whether a search becomes due if they move too far.
    """
    k = wp.tid()
    if k < frames:
        watch.drift[k] = watch.drift[k] + watch.common[k]
    if k < obstacles:
        world, o = pair_of(k, watch)
        begin_obstacle(world, o, motions, pace, world_starts, offset, watches, watch)
    if watch.awake[0] == 0:
        return
    if k < count:
        s = start + k
        i = nodes.node[s]
        nodes.f[s] = wp.vec3()
        nodes.yielding[s] = 0.0
        if i >= 0:
            own = foreseen(i, damping, gravity, inverse_mass, has_load, load, pace, offset, rest, f, u, v)
            nodes.rest[s] = own.rest
            nodes.x[s] = own.x
            nodes.d[s] = own.d
            nodes.yielding[s] = own.yielding
    if k < borne:
        s = borne_start + k
        surface.f[s] = wp.vec3()
        surface.yielding[s] = 0.0
        if surface.node[s] >= 0:
            b = surface.bearing.bearers[s]
            w = surface.bearing.weights[s]
            place = Foreseen()
            # Without branches, so that CUDA loads all at once.
            for m in range(4):
                i = bearers.node[b[m]]
                own = foreseen(i, damping, gravity, inverse_mass, has_load, load, pace, offset, rest, f, u, v)
                place = place_among(place, w[m], own)
            surface.rest[s] = place.rest
            surface.x[s] = place.x
            surface.d[s] = place.d
            surface.yielding[s] = place.yielding
            surface.bearing.loose[s] = wp.clamp(place.loose, 0.0, 1.0)
            surface.bearing.held[s] = place.held


BEGIN_STEP = by_vectors(begin_step, "load")
