"""Motion since the last search for near surfaces, and whether a new search is due.

Contact sleeps while nothing is near: steps then only check that nothing has moved too far for that to stay true. A
search that finds nothing near also finds how much more room there is. Nodes may use a half of it and obstacles the
other half before contact wakes and searches again. Between soft surfaces no such room is known; there searches that
find nothing reserve more and more for all nodes, until they find something.
"""

import warp as wp

from warp_corot.kernels.elements.elements import load_node
from warp_corot.kernels.modules import INLINED
from warp_corot.kernels.stepping.pace import DONE, DT, Pace

from .motion import Motions, Part, Surface, distance_between, move_obstacle

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": INLINED})

#: An item may move this many times its motion in the present step until the next search, besides the minimum.
AHEAD = wp.constant(16.0)
#: The limit is the size of the smallest element; for faster items, this many times their motion in a step, and at most
#: this many elements, more than any stable step covers.
FAST = wp.constant(2.0)
FARTHEST = wp.constant(64.0)
#: In a stable step nothing that is hit goes farther than so many elements.
STABLE = wp.constant(4.0)
#: In implicit steps as much is reserved around the place where a node is expected to go as it has last strayed from
#: there, but at most so many elements: a step in which one strays farther has another search.
STRAYED = wp.constant(0.25)
#: An item that is hit moves as far as the item that hits it; this many times that motion is reserved: more where there
#: are only obstacles, beside which few nodes are, for light nodes vibrate with the length of a few steps.
HIT, HIT_BESIDE = wp.constant(2.0), wp.constant(8.0)
#: Nodes with nothing near may move this many times as far, and as many elements: few of them come near anything. In
#: self-contact they may not move more elements: so much of the body is that near.
ALONE = wp.constant(4.0)
#: Only one of so many nodes is asked for the common motion; that is summed in multiples of an element's size over this.
ASKED, PARTS = wp.constant(16), wp.constant(1048576.0)


@wp.struct
class Watch:
    """Positions of surface nodes and obstacles at the last search, and how far they may move from there [m].

    Where there are no obstacles, only motion relative to a frame counts, which moves along with the nodes that have
    something near them.
    """

    places: wp.array[wp.vec3]  # [S]
    reach: wp.array[wp.float32]  # [S]
    poses: wp.array2d[wp.transform]  # [W, O]
    reach_of: wp.array2d[wp.float32]  # [W, O]
    least: wp.array[wp.float32]  # [1]
    drift: wp.array[wp.vec3]  # [W] how far the frame has moved since the search, and moves in a step [m]
    common: wp.array[wp.vec3]
    asked: wp.array2d[wp.int64]  # [W, 4] sum of motions in the step of the search, and the number of nodes
    size: float  # size of the smallest element [m]
    alone: float  # how many times as far nodes with nothing near may move, and how many elements
    most_alone: float
    hit: float  # how many times the largest motion is reserved for anything
    skin: float  # a new search is due after this fraction of the limit; the rest is for the effect of contact on a step
    rest: float  # so much more of the limit is for it [m]
    steps: float  # for so many more steps like the present one it must suffice
    # [S] in implicit steps: how far places are expected to go in the step of the search beyond the frame, around which
    # ``reach`` is what they may stray, and how far they have strayed [m]; else empty
    ahead: wp.array[wp.vec3]
    strayed: wp.array[wp.float32]
    fastest: wp.array[wp.float32]  # [1 + W] largest motion in the step of the search, in any world and in each
    due: wp.array[wp.int32]  # [1] whether a search is due
    awake: wp.array[wp.int32]  # [1] whether steps look for forces; otherwise nothing is near (see ``end_search``)
    room: wp.array[wp.float32]  # [1] least distance between nodes and obstacles beyond what is reserved [m]
    free: wp.array[wp.float32]  # [2] how far nodes may move while contact sleeps, and obstacles beyond their reach [m]
    # [3] how much is reserved for all nodes at least, to sleep where soft surfaces are nearest [m]; the number of
    # searches until more is tried again, and the number after the next time that it was too much
    calm: wp.array[wp.float32]
    most_calm: float  # how many elements that is at most; zero if soft surfaces cannot meet
    spread: float  # largest sum of the absolute weights with which nodes bear a place
    published: wp.array[wp.int64]  # [1] number of steps done when the last run ended
    missed: wp.array[wp.int32]  # [1] how often an item moved too far
    searches: wp.array[wp.int32]  # [1]


@wp.func
def stays(gone: float, next_step: float, reach: float, watch: Watch):
    """Whether an item that has moved this far can make another step before the next search; false for values that are
    not finite.
    """
    return gone + watch.steps * next_step <= watch.skin * reach - watch.rest


@wp.func
def wake(watch: Watch):
    """Ask for a search."""
    watch.due[0] = 1
    watch.awake[0] = 1


@wp.func
def reserved(step: float, fastest: float, farther: float, hit: float, watch: Watch):
    """How far an item may move, given its motion in the present step and the largest one in its world; ``farther``: so
    many times as far; ``hit``: how many times the largest motion if it is hit."""
    farthest = wp.max(wp.min(farther, watch.most_alone) * watch.size, FAST * step)
    ahead = wp.min(farther * AHEAD * step, farthest)
    return watch.rest + watch.least[0] + wp.min(ahead + hit * fastest, FARTHEST * watch.size)


@wp.func
def ahead_at(s: int, ahead: wp.array[wp.vec3]):
    """How far a place is expected to go in an implicit step, zero in explicit ones [m]."""
    if ahead.shape[0] == 0:
        return wp.vec3()
    return ahead[s]


@wp.func
def way_from_search(s: int, surface: Surface, watch: Watch):
    """The way of a place from where the last search expected it [m]."""
    return surface.x[s] - watch.places[s] - ahead_at(s, watch.ahead) - watch.drift[surface.world[s]]


@wp.func
def common_motion(world: int, watch: Watch):
    """The mean motion of the nodes that were asked [m]."""
    count = watch.asked[world, 3]
    if count == wp.int64(0):
        return wp.vec3()
    sums = wp.vec3(float(watch.asked[world, 0]), float(watch.asked[world, 1]), float(watch.asked[world, 2]))
    return (watch.size / (PARTS * float(count))) * sums


@wp.kernel(enable_backward=False)
def watch_nodes(surface: Surface, watch: Watch):
    """Check before a step whether nodes have been moved from outside, or have begun to move faster."""
    s = wp.tid()
    if surface.node[s] < 0 or watch.awake[0] == 0:
        return
    world = surface.world[s]
    common = watch.common[world]
    gone = way_from_search(s, surface, watch) + common
    if not stays(wp.length(gone), wp.length(surface.d[s] - common), watch.reach[s], watch):
        wake(watch)


@wp.func
def follow_node(s: int, surface: Surface, watch: Watch):
    """Check after a step whether the next one could move the node too far, or this one has."""
    world = surface.world[s]
    step = surface.d[s]
    gone = wp.length(way_from_search(s, surface, watch) + step)
    if not stays(gone, wp.length(step - watch.common[world]), watch.reach[s], watch):
        wake(watch)
        if gone > watch.reach[s] and watch.ahead.shape[0] == 0:
            wp.atomic_add(watch.missed, 0, 1)


@wp.kernel(enable_backward=False)
def follow_nodes(surface: Surface, watch: Watch):
    """Check the same for all places."""
    s = wp.tid()
    if surface.node[s] >= 0:
        follow_node(s, surface, watch)


@wp.func
def pair_of(k: int, watch: Watch):
    """The world and the obstacle of a number below that of pairs of them."""
    return k // watch.poses.shape[1], k % watch.poses.shape[1]


@wp.func
def begin_obstacle(
    world: int,
    o: int,
    motions: Motions,
    pace: Pace,
    world_starts: wp.array[wp.float64],
    offset: int,
    watches: int,
    watch: Watch,
):
    """Begin an obstacle's step; ``watches``: check whether it moves too far in it."""
    move_obstacle(world, o, motions, pace, world_starts, offset)
    if watches != 0:
        reach = motions.reach[o]
        later = motions.later[world, o]
        step = distance_between(motions.now[world, o], later, reach)
        gone = distance_between(watch.poses[world, o], later, reach)
        if not stays(gone, step, watch.reach_of[world, o] + watch.free[1], watch):
            wake(watch)


@wp.kernel(enable_backward=False)
def move_obstacles(motions: Motions, pace: Pace, world_starts: wp.array[wp.float64], offset: int, watch: Watch):
    """Begin the obstacles' step, without a search."""
    world, o = wp.tid()
    begin_obstacle(world, o, motions, pace, world_starts, offset, 0, watch)


@wp.func
def raise_world(world: int, motion: float, watch: Watch):
    """Raise the largest motion in a world to at least this one; with one world that of any world serves [m]."""
    if watch.fastest.shape[0] > 2 and motion > watch.fastest[1 + world]:
        wp.atomic_max(watch.fastest, 1 + world, motion)


@wp.func
def fastest_motion(k: int, obstacles: int, surface: Surface, motions: Motions, watch: Watch):
    """The motion in this step of a node or an obstacle with a number, whichever is faster [m]; those of their worlds
    are raised to it."""
    fastest = float(0.0)
    if k < surface.node.shape[0] and surface.node[k] >= 0:
        fastest = wp.length(surface.d[k] - common_motion(surface.world[k], watch))
        raise_world(surface.world[k], fastest, watch)
    if k < obstacles:
        world, o = pair_of(k, watch)
        motion = distance_between(motions.now[world, o], motions.later[world, o], motions.reach[o])
        raise_world(world, motion, watch)
        fastest = wp.max(fastest, motion)
    return fastest


@wp.func
def fastest_in(world: int, watch: Watch):
    """The largest motion in a world, after all have been found [m]."""
    return watch.fastest[wp.where(watch.fastest.shape[0] > 2, 1 + world, 0)]


@wp.func
def end_asking(world: int, watch: Watch):
    """Forget what was asked and found in a world for a search."""
    watch.fastest[1 + world] = 0.0
    for k in range(4):
        watch.asked[world, k] = wp.int64(0)


@wp.func
def reserve_obstacle(k: int, motions: Motions, watch: Watch):
    """Record the pose of an obstacle and how far it may move from there."""
    world, o = pair_of(k, watch)
    now = motions.now[world, o]
    watch.poses[world, o] = now
    step = distance_between(now, motions.later[world, o], motions.reach[o])
    watch.reach_of[world, o] = reserved(step, fastest_in(world, watch), 1.0, watch.hit, watch)


@wp.func
def reserve_node(s: int, farther: float, surface: Surface, watch: Watch):
    """Record the place of a node and how far it may move from there."""
    watch.places[s] = surface.x[s]
    if watch.ahead.shape[0] > 0:
        watch.ahead[s] = surface.d[s] - common_motion(surface.world[s], watch)
        watch.reach[s] = watch.least[0] + wp.min(watch.strayed[s], STRAYED * watch.size)
        return
    world = surface.world[s]
    step = wp.length(surface.d[s] - common_motion(world, watch))
    watch.reach[s] = wp.max(reserved(step, fastest_in(world, watch), farther, watch.hit, watch), watch.calm[0])


# --- what is near -----------------------------------------------------------------------------------------------------

#: Flags for what is near a node: another soft surface, an obstacle, or an obstacle at an adjacent triangle.
PAIRED, BESIDE, AROUND = wp.constant(1), wp.constant(2), wp.constant(4)
#: Any of these flags; and a flag for nodes of inverted elements.
SOMETHING, CRUSHED = wp.constant(7), wp.constant(8)
#: More room than there is [m].
FAR = wp.constant(1.0e6)


@wp.struct
class Near:
    """The result of the last search."""

    flags: wp.array[wp.int32]  # [S] what is
    nodes: wp.array[wp.int32]  # [S]
    count: wp.array[wp.int32]  # [1]
    touches: wp.array[wp.int32]  # [O T] pairs of an obstacle and a triangle: o T + t
    touch_count: wp.array[wp.int32]  # [1]


@wp.func
def mark(near: Near, s: int, flag: int):
    if (wp.atomic_or(near.flags, s, flag) & SOMETHING) == 0:
        near.nodes[wp.atomic_add(near.count, 0, 1)] = s


@wp.func
def leave_room(room: float, watch: Watch):
    """Note the distance between a node or triangle and an obstacle beyond what is reserved [m]."""
    if room < watch.room[0]:
        wp.atomic_min(watch.room, 0, room)


@wp.func
def add_motion(s: int, everywhere: bool, surface: Surface, near: Near, watch: Watch):
    """Add the motion of a node that was near another surface; of any node if there were none, or ``everywhere``."""
    if surface.node[s] < 0 or (not everywhere and near.count[0] > 0 and (near.flags[s] & PAIRED) == 0):
        return
    world = surface.world[s]
    motion = surface.d[s] / watch.size
    # False if a number is not finite.
    if wp.length(motion) <= FARTHEST:
        for axis in range(3):
            wp.atomic_add(watch.asked, world, axis, wp.int64(PARTS * motion[axis]))
        wp.atomic_add(watch.asked, world, 3, wp.int64(1))


@wp.func
def begin_search(s: int, obstacles: int, surface: Surface, motions: Motions, watch: Watch, near: Near):
    """Begin a search: record the position of a node and the pose of an obstacle, and how far they may move from there,
    and the frame of a world, each of the number ``s``."""
    if s < obstacles:
        reserve_obstacle(s, motions, watch)
    if s < watch.drift.shape[0]:
        watch.common[s] = common_motion(s, watch)
        watch.drift[s] = common_motion(s, watch)
    if s < surface.node.shape[0]:
        farther = float(1.0)
        if obstacles == 0 and (near.flags[s] & SOMETHING) == 0:
            farther = watch.alone
        reserve_node(s, farther, surface, watch)
        near.flags[s] = 0
    if s == 0:
        # Where something was near at the last search, no room is looked for.
        watch.room[0] = wp.where(near.count[0] > 0, 0.0, FAR)
        near.count[0] = 0
        near.touch_count[0] = 0
        watch.free[0] = 0.0
        watch.free[1] = 0.0


@wp.kernel(enable_backward=False)
def report_search(watch: Watch, total: wp.array[wp.int32], most: wp.array[wp.int32], report: wp.array[wp.float64]):
    """Report to the host the largest number of near pairs, how often an item moved too far, and the number of
    searches."""
    report[0] = wp.float64(wp.max(most[0], total[0]))
    report[1] = wp.float64(watch.missed[0])
    report[2] = wp.float64(watch.searches[0])


# --- sleep ------------------------------------------------------------------------------------------------------------

#: After more than a search could reserve was tried, this many searches pass before it is tried again: twice as many
#: each time, up to the second number.
PATIENCE, MOST_PATIENCE = wp.constant(8.0), wp.constant(256.0)
#: For so many elements motion is reserved first to sleep beside soft surfaces.
LEAST_CALM = wp.constant(0.5)


@wp.func
def gone_from_search(s: int, i: int, is_framed: int, part: Part, watch: Watch):
    """How far a node has moved since the last search, which was in the last step in which contact was awake."""
    gone = load_node(part.dynamics.rest, i) + load_node(part.dynamics.u, i) - part.nodes.x[s]
    if is_framed != 0:
        gone -= watch.drift[part.nodes.world[s]]
    return gone


@wp.kernel(enable_backward=False)
def rouse(
    # In
    threads: int,
    count: int,
    is_framed: int,
    obstacles: int,
    motions: Motions,
    world_starts: wp.array[wp.float64],
    part: Part,
    # In and out
    watch: Watch,
):
    """Move obstacles, and wake contact if one of them or a node of a body may move too far in this step.

    Args:
        count: Number of the body's carriers.
        is_framed: Whether only motion relative to frames counts.
        obstacles: Number of obstacles of all worlds to move.
    """
    k = wp.tid()
    while k < obstacles:
        world, o = pair_of(k, watch)
        begin_obstacle(world, o, motions, part.pace, world_starts, part.offset, 1, watch)
        k += threads
    if watch.awake[0] != 0:
        return
    dt = float(part.pace.seconds[DT])
    free = watch.free[0]
    # Before a run nodes may have been moved from outside.
    counts = part.offset > 0 or part.pace.counts[DONE] != watch.published[0]
    k = wp.tid()
    while k < count:
        s = part.start + k
        k += threads
        i = part.nodes.node[s]
        if i >= 0:
            gone = gone_from_search(s, i, is_framed, part, watch)
            step = dt * load_node(part.dynamics.v, i)
            if is_framed != 0:
                step -= watch.common[part.nodes.world[s]]
            # Most nodes pass this test, without roots; (a + b)^2 is at most 2 (a^2 + b^2).
            if not (2.0 * (wp.dot(gone, gone) + wp.dot(step, step)) <= watch.skin * watch.skin * free * free):
                far = wp.length(gone)
                if not stays(far, wp.length(step), free, watch):
                    wake(watch)
                    if counts and far > free:
                        wp.atomic_add(watch.missed, 0, 1)


@wp.kernel(enable_backward=False)
def check_sleep(is_framed: int, part: Part, watch: Watch):
    """Check after a run whether its last step has moved a node too far."""
    k = wp.tid()
    s = part.start + k
    i = part.nodes.node[s]
    if watch.awake[0] == 0 and i >= 0 and wp.length(gone_from_search(s, i, is_framed, part, watch)) > watch.free[0]:
        wp.atomic_add(watch.missed, 0, 1)
    if k == 0:
        watch.published[0] = part.pace.counts[DONE]


@wp.func
def choose_calm(is_clear: bool, needed: float, watch: Watch):
    """Choose the motion that is reserved for all nodes, of which contact needs ``needed`` to sleep. Returns whether the
    search must be repeated."""
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
