"""Contact sleeps while nothing is near: steps then only check that nothing has moved too far for that to stay true.

A search that finds nothing near also finds how much more room there is. Nodes may use a half of it and obstacles the
other half before contact wakes and searches again. Between soft surfaces no such room is known; there searches that
find nothing reserve more and more for all nodes, until they find something.
"""

import warp as wp

from warp_corot.kernels.elements.elements import load_node
from warp_corot.kernels.stepping.pace import DONE, DT, Pace

from .motion import Motions, Surface
from .watch import HIT, SKIN, Near, Watch, begin_obstacle, pair_of, reserved, stays, wake

wp.set_module_options({"enable_backward": False})

#: After more than a search could reserve was tried, this many searches pass before it is tried again: twice as many
#: each time, up to the second number.
PATIENCE, MOST_PATIENCE = wp.constant(8.0), wp.constant(256.0)
#: For so many elements motion is reserved first to sleep beside soft surfaces.
LEAST_CALM = wp.constant(0.5)


@wp.func
def gone_from_search(
    s: int, i: int, nodes: Surface, is_framed: int, rest: wp.array[wp.vec4], u: wp.array[wp.vec4], watch: Watch
):
    """How far a node has moved since the last search, which was in the last step in which contact was awake."""
    gone = load_node(rest, i) + load_node(u, i) - nodes.x[s]
    if is_framed != 0:
        gone -= watch.drift[nodes.world[s]]
    return gone


@wp.kernel(enable_backward=False)
def rouse(
    # In
    threads: int,
    start: int,
    count: int,
    nodes: Surface,
    is_framed: int,
    obstacles: int,
    motions: Motions,
    world_starts: wp.array[wp.float64],
    pace: Pace,
    offset: int,
    rest: wp.array[wp.vec4],
    u: wp.array[wp.vec4],
    v: wp.array[wp.vec4],
    # In and out
    watch: Watch,
):
    """Move obstacles, and wake contact if one of them or a node of a body may move too far in this step.

    Args:
        start, count: The first of the ``nodes``, which are places or bear them, and how many there are.
        is_framed: Whether only motion relative to frames counts.
        obstacles: Number of obstacles of all worlds to move.
    """
    k = wp.tid()
    while k < obstacles:
        world, o = pair_of(k, watch)
        begin_obstacle(world, o, motions, pace, world_starts, offset, 1, watch)
        k += threads
    if watch.awake[0] != 0:
        return
    dt = float(pace.seconds[DT])
    free = watch.free[0]
    # Before a run nodes may have been moved from outside.
    counts = offset > 0 or pace.counts[DONE] != watch.published[0]
    k = wp.tid()
    while k < count:
        s = start + k
        k += threads
        i = nodes.node[s]
        if i >= 0:
            gone = gone_from_search(s, i, nodes, is_framed, rest, u, watch)
            step = dt * load_node(v, i)
            if is_framed != 0:
                step -= watch.common[nodes.world[s]]
            # Most nodes pass this test, without roots; (a + b)^2 is at most 2 (a^2 + b^2).
            if not (2.0 * (wp.dot(gone, gone) + wp.dot(step, step)) <= SKIN * SKIN * free * free):
                far = wp.length(gone)
                if not stays(far, wp.length(step), free):
                    wake(watch)
                    if counts and far > free:
                        wp.atomic_add(watch.missed, 0, 1)


@wp.kernel(enable_backward=False)
def check_sleep(
    # In
    start: int,
    nodes: Surface,
    is_framed: int,
    pace: Pace,
    rest: wp.array[wp.vec4],
    u: wp.array[wp.vec4],
    # In and out
    watch: Watch,
):
    """Check after a run whether its last step has moved a node too far."""
    k = wp.tid()
    i = nodes.node[start + k]
    if watch.awake[0] == 0 and i >= 0:
        gone = wp.length(gone_from_search(start + k, i, nodes, is_framed, rest, u, watch))
        if gone > watch.free[0]:
            wp.atomic_add(watch.missed, 0, 1)
    if k == 0:
        watch.published[0] = pace.counts[DONE]


@wp.func
def choose_calm(is_clear: bool, needed: float, watch: Watch):
    """Choose how much to reserve for all nodes, of which sleep needs as much; whether the search must be repeated."""
    calm = watch.calm[0]
    wait = watch.calm[1]
    if not is_clear:
        if calm > 0.0:
            watch.calm[0] = wp.where(0.5 * calm >= needed, 0.5 * calm, 0.0)
            patience = wp.max(watch.calm[2], PATIENCE)
            watch.calm[1] = patience
            watch.calm[2] = wp.min(2.0 * patience, MOST_PATIENCE)
        return calm > 0.0
    if wait > 0.0:
        watch.calm[1] = wait - 1.0
        return False
    most = watch.most_calm * watch.size
    if calm >= needed:
        watch.calm[0] = wp.max(calm, wp.min(2.0 * calm, most))
        watch.calm[2] = 0.0
        return False
    enough = wp.max(needed, LEAST_CALM * watch.size)
    if enough > most:
        return False
    watch.calm[0] = enough
    return True


@wp.func
def end_search(sleeps: int, near: Near, watch: Watch):
    """End a search. Contact sleeps after it if nothing is near and there is as much room as would be reserved.

    Args:
        sleeps: Whether it may, and the search is repeated while it is due.
    """
    watch.due[0] = 0
    watch.awake[0] = 1
    is_clear = near.count[0] == 0 and near.touch_count[0] == 0
    if sleeps != 0:
        meets = watch.most_calm > 0.0
        fastest = watch.fastest[0]
        needed = watch.spread * reserved(fastest, fastest, 1.0, HIT, watch)
        room = 0.5 * watch.room[0]
        # Everything may move by what is reserved for something at rest, too.
        reserve = wp.where(meets, watch.calm[0], reserved(0.0, fastest, 1.0, watch.hit, watch) + room)
        if is_clear and reserve >= needed:
            watch.free[0] = reserve / watch.spread
            watch.free[1] = room
            watch.awake[0] = 0
        if meets and choose_calm(is_clear, needed, watch):
            wake(watch)
    watch.fastest[0] = 0.0
    watch.searches[0] = watch.searches[0] + 1
