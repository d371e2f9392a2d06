"""How far things have gone since it was last looked for what is near, and whether it is time to look again."""

import warp as wp

from .motion import Motions, Surface, distance_between

wp.set_module_options({"enable_backward": False})

#: How far a thing may go until the next search: so many times as far as it goes in the present step, besides the least.
AHEAD = wp.constant(16.0)
#: No farther than a smallest element or, of things that are faster than that, than so many times as far as they go in
#: a step; and no farther than so many elements, which nothing passes in a stable step.
FAST = wp.constant(2.0)
FARTHEST = wp.constant(64.0)
#: What is hit goes as far as what hits it; so many times as far is reserved.
HIT = wp.constant(2.0)
#: The share of it after which it is looked again. The rest is for what contact does to a step.
SKIN = wp.constant(0.5)


@wp.struct
class Watch:
    """Where surface nodes and obstacles were at the last search, and how far from there they may go [m]."""

    places: wp.array[wp.vec3]  # [S]
    reach: wp.array[wp.float32]  # [S]
    poses: wp.array2d[wp.transform]  # [W, O]
    reach_of: wp.array2d[wp.float32]  # [W, O]
    least: wp.array[wp.float32]  # [1]
    size: float  # of the smallest element
    fastest: wp.array[wp.float32]  # [1] how far anything goes in the step of the search
    due: wp.array[wp.int32]  # [1] whether to look again
    missed: wp.array[wp.int32]  # [1] how often something went too far
    searches: wp.array[wp.int32]  # [1]


@wp.func
def stays(gone: float, next_step: float, reach: float):
    """Whether what has gone so far can make another step before it is looked again; false for what is not finite."""
    return gone + next_step <= SKIN * reach


@wp.func
def reserved(step: float, watch: Watch):
    """How far something may go that goes so far in the present step."""
    ahead = wp.min(AHEAD * step, wp.max(watch.size, FAST * step)) + HIT * watch.fastest[0]
    return watch.least[0] + wp.min(ahead, FARTHEST * watch.size)


@wp.kernel(enable_backward=False)
def watch_nodes(surface: Surface, watch: Watch):
    """Before a step: whether nodes have been put elsewhere, or have begun to move faster."""
    s = wp.tid()
    if surface.node[s] < 0:
        return
    if not stays(wp.length(surface.x[s] - watch.places[s]), wp.length(surface.d[s]), watch.reach[s]):
        watch.due[0] = 1


@wp.kernel(enable_backward=False)
def follow_nodes(surface: Surface, watch: Watch):
    """After a step: whether the next one could take nodes too far, or this one has."""
    s = wp.tid()
    if surface.node[s] < 0:
        return
    step = surface.d[s]
    gone = wp.length(surface.x[s] + step - watch.places[s])
    if not stays(gone, wp.length(step), watch.reach[s]):
        watch.due[0] = 1
        if gone > watch.reach[s]:
            wp.atomic_add(watch.missed, 0, 1)


@wp.kernel(enable_backward=False)
def watch_obstacles(motions: Motions, watch: Watch):
    """Whether obstacles go too far in this step."""
    world, o = wp.tid()
    reach = motions.reach[o]
    later = motions.later[world, o]
    step = distance_between(motions.now[world, o], later, reach)
    if not stays(distance_between(watch.poses[world, o], later, reach), step, watch.reach_of[world, o]):
        watch.due[0] = 1


@wp.kernel(enable_backward=False)
def find_fastest_node(surface: Surface, watch: Watch):
    """How far the fastest node goes in this step."""
    s = wp.tid()
    if watch.due[0] == 0 or surface.node[s] < 0:
        return
    step = wp.length(surface.d[s])
    if step > watch.fastest[0]:
        wp.atomic_max(watch.fastest, 0, step)


@wp.kernel(enable_backward=False)
def find_fastest_obstacle(motions: Motions, watch: Watch):
    """How far the fastest obstacle goes in this step, if that is more."""
    world, o = wp.tid()
    if watch.due[0] == 0:
        return
    step = distance_between(motions.now[world, o], motions.later[world, o], motions.reach[o])
    if step > watch.fastest[0]:
        wp.atomic_max(watch.fastest, 0, step)


@wp.kernel(enable_backward=False)
def reserve_obstacles(motions: Motions, watch: Watch):
    """Note where obstacles are, and how far they may go from there."""
    world, o = wp.tid()
    if watch.due[0] == 0:
        return
    now = motions.now[world, o]
    watch.poses[world, o] = now
    step = distance_between(now, motions.later[world, o], motions.reach[o])
    watch.reach_of[world, o] = reserved(step, watch)


@wp.kernel(enable_backward=False)
def end_search(watch: Watch):
    """What is near is known."""
    if watch.due[0] != 0:
        watch.due[0] = 0
        watch.fastest[0] = 0.0
        watch.searches[0] = watch.searches[0] + 1


@wp.kernel(enable_backward=False)
def report_search(watch: Watch, most: wp.array[wp.int32], report: wp.array[wp.float64]):
    """Tell the host how many pairs were near at most, how often something went too far, and how often was looked."""
    report[0] = wp.float64(most[0])
    report[1] = wp.float64(watch.missed[0])
    report[2] = wp.float64(watch.searches[0])
