"""A step with contact: the motion of surfaces without contact and of obstacles, and the forces at the end."""

import warp as wp

from warp_corot.kernels.elements.elements import load_node, store_node
from warp_corot.kernels.modules import INLINED
from warp_corot.kernels.stepping.balance import count_constraint

from .bearing import place_among, store_borne
from .mass_split import Sums, take_force
from .motion import Foreseen, Motions, Part, Surface, force_at, foreseen
from .watch import Watch, begin_obstacle, follow_node, pair_of

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": INLINED})

#: Number of threads of a block on CUDA: few, so that the places of a small surface are on many multiprocessors.
BLOCK = 64


@wp.kernel(enable_backward=False)
def begin_step(
    # In
    start: int,
    count: int,
    borne_start: int,
    borne: int,
    frames: int,
    obstacles: int,
    part: Part,
    motions: Motions,
    world_starts: wp.array[wp.float64],
    watches: int,
    # In and out
    watch: Watch,
    # Out
    surface: Surface,
):
    """Find the positions of a body's surface nodes and their motion in this step without contact, unless contact
    sleeps; move obstacles.

    Args:
        start, count: The first of the carriers, and how many there are.
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
        begin_obstacle(world, o, motions, part.pace, world_starts, part.offset, watches, watch)
    if watch.awake[0] == 0:
        return
    nodes = part.nodes
    if k < count:
        s = start + k
        i = nodes.node[s]
        nodes.f[s] = wp.vec3()
        nodes.yielding[s] = 0.0
        if i >= 0:
            own = foreseen(i, part)
            nodes.rest[s] = own.rest
            nodes.x[s] = own.x
            nodes.d[s] = own.d
            nodes.yielding[s] = own.yielding
    elif k < count + borne:
        # Other threads than those of nodes, so that neither wait for the other.
        s = borne_start + k - count
        surface.f[s] = wp.vec3()
        surface.yielding[s] = 0.0
        if surface.node[s] >= 0:
            b = surface.bearing.bearers[s]
            w = surface.bearing.weights[s]
            place = Foreseen()
            # Without branches, so that CUDA loads all at once.
            for m in range(4):
                place = place_among(place, w[m], foreseen(nodes.node[b[m]], part))
            store_borne(s, place, surface)


# --- the end ----------------------------------------------------------------------------------------------------------


@wp.func
def push(
    i: int, force: wp.vec3, counts: int, part: Part, account: wp.array2d[wp.float64], contact_forces: wp.array[wp.vec4]
):
    """Add the contact force of a node to its forces, and count its work if ``counts`` says so."""
    body = part.dynamics
    store_node(contact_forces, i, force)
    if wp.dot(force, force) > 0.0:
        store_node(body.f, i, load_node(body.f, i) + force)
        if counts != 0:
            w = body.inverse_mass[i]
            v = load_node(body.v, i)
            count_constraint(
                i, force, force_at(i, body), v, body.damping, body.gravity, w, part.pace, part.offset, account
            )


@wp.kernel(enable_backward=False)
def end_contact(
    # In
    start: int,
    count: int,
    place_start: int,
    places: int,
    buffer: int,
    grain: float,
    surface: Surface,
    counts: int,
    part: Part,
    # In and out
    sums: Sums,
    watch: Watch,
    account: wp.array2d[wp.float64],
    # Out
    contact_forces: wp.array[wp.vec4],
):
    """Add the contact forces to a body's forces, and clear their sums; follow the body's places.

    Args:
        start, count: The first of the carriers, and how many there are.
        place_start, places: The first place, and how many of them to follow.
        buffer: That of the sums.
        counts: Whether the work of contact is counted here.
    """
    k = wp.tid()
    if k < count:
        s = start + k
        i = part.nodes.node[s]
        if i >= 0:
            force = wp.vec3()
            n = s + part.shift
            if watch.awake[0] != 0 and sums.touched[n] != 0:
                force = take_force(n, buffer, grain, sums)
            push(i, force, counts, part, account, contact_forces)
    elif k < count + places and watch.awake[0] != 0:
        # Other threads than those of nodes, so that neither wait for the other.
        s = place_start + k - count
        if surface.node[s] >= 0:
            follow_node(s, surface, watch)
