"""The search for surface nodes and triangles that are near obstacles, and what comes before and after any search."""

import warp as wp

from warp_corot.kernels.stepping.threads import spread_thread, synchronize_grid

from .explicit_rows import Rigid
from .shapes import GROUND, distance_to, sure_distance
from .watch import (
    AROUND,
    ASKED,
    BESIDE,
    FARTHEST,
    Near,
    Watch,
    add_motion,
    begin_search,
    end_asking,
    end_search,
    fastest_motion,
    leave_room,
    mark,
)
from .wide_tree import raise_by_warp

wp.set_module_options({"enable_backward": False})

#: The phases of a search. ``BESIDE_OBSTACLES`` follows those of other kernels.
ASK, MEASURE, RESERVE, BESIDE_OBSTACLES, END = (wp.constant(k) for k in range(5))
#: Number of threads of a block on CUDA.
BLOCK = wp.constant(64)


@wp.func
def horizon(watch: Watch):
    """How far beyond what is reserved a search looks for obstacles [m]: not where others are nearer already."""
    return wp.min(watch.room[0], FARTHEST * watch.size)


@wp.func
def find_node(s: int, watch: Watch, rigid: Rigid, near: Near):
    """Mark a node that may touch an obstacle before the next search. Obstacles exert no forces on other nodes."""
    if rigid.surface.node[s] >= 0:
        world = rigid.surface.world[s]
        for o in range(rigid.shapes.kind.shape[0]):
            far = watch.reach[s] + watch.reach_of[world, o] + rigid.law.tolerance
            gap, _normal = distance_to(
                rigid.shapes, o, rigid.motions.now[world, o], rigid.surface.x[s], far + horizon(watch)
            )
            if gap <= far:
                mark(near, s, BESIDE)
                return
            leave_room(sure_distance(rigid.shapes, o, gap) - far, watch)
    for o in range(rigid.shapes.kind.shape[0]):
        rigid.rows.force[o * rigid.surface.node.shape[0] + s] = wp.vec3()
        rigid.anchors[o * rigid.surface.node.shape[0] + s] = wp.vec4()


@wp.func
def find_triangle(pair: int, watch: Watch, rigid: Rigid, near: Near):
    """List a triangle that may touch an obstacle before the next search. Obstacles exert no forces on other ones."""
    o = pair // rigid.surface.triangles.shape[0]
    corners = rigid.surface.triangles[pair % rigid.surface.triangles.shape[0]]
    if rigid.shapes.kind[o] != GROUND and corners[0] >= 0:
        world = rigid.surface.world[corners[0]]
        a = rigid.surface.x[corners[0]]
        b = rigid.surface.x[corners[1]]
        c = rigid.surface.x[corners[2]]
        middle = (a + b + c) / 3.0
        size = wp.max(wp.length(a - middle), wp.max(wp.length(b - middle), wp.length(c - middle)))
        reach = wp.max(watch.reach[corners[0]], wp.max(watch.reach[corners[1]], watch.reach[corners[2]]))
        # The centre moves, and the corners move relative to it.
        far = size + 3.0 * reach + watch.reach_of[world, o] + rigid.law.tolerance
        gap, _normal = distance_to(rigid.shapes, o, rigid.motions.now[world, o], middle, far + horizon(watch))
        if gap > far:
            leave_room(sure_distance(rigid.shapes, o, gap) - far, watch)
        else:
            near.touches[wp.atomic_add(near.touch_count, 0, 1)] = pair
            for k in range(3):
                mark(near, corners[k], AROUND)
            return
    r = rigid.first_triangle + pair
    rigid.rows.weights[r] = wp.vec4()
    rigid.rows.force[r] = wp.vec3()
    rigid.rows.more[r] = wp.vec3()
    rigid.rows.acts[r] = 0


@wp.kernel(enable_backward=False, grid_stride=False, launch_bounds=(64, 4))
def search_near(
    # In
    threads: int,
    first: int,
    last: int,
    asks: int,
    sleeps: int,
    # In and out
    rigid: Rigid,
    watch: Watch,
    near: Near,
    arrived: wp.array[wp.uint32],
):
    """Make some phases of a search, if one is due. Those for soft surfaces come before ``BESIDE``.

    Args:
        threads: The number of threads, of blocks that are all resident on CUDA.
        first, last: The phases.
        asks: Whether margins count motion relative to a frame: 0: no; 1: to that of nodes near other surfaces; 2: to
            that of all nodes.
        sleeps: Whether contact may sleep after the search.
        arrived: As for ``synchronize_grid``.
    """
    thread = wp.tid()
    if watch.due[0] == 0:
        return
    surface = rigid.surface
    places = surface.node.shape[0]
    pairs = rigid.rows.force.shape[0] - rigid.first_triangle
    poses = watch.poses.shape[0] * watch.poses.shape[1]
    start = spread_thread(thread, threads, BLOCK)
    phase = int(first)
    while phase <= last:
        if phase > first:
            synchronize_grid(arrived)
        k = int(start)
        if phase == ASK:
            while asks != 0 and k * ASKED < places:
                add_motion(k * ASKED, asks == 2, surface, near, watch)
                k += threads
        elif phase == MEASURE:
            fastest = float(0.0)
            while k < wp.max(places, poses):
                fastest = wp.max(fastest, fastest_motion(k, poses, surface, rigid.motions, watch))
                k += threads
            raise_by_warp(watch.fastest, fastest)
        elif phase == RESERVE:
            while k < wp.max(places, wp.max(poses, watch.drift.shape[0])):
                begin_search(k, poses, surface, rigid.motions, watch, near)
                k += threads
        elif phase == BESIDE_OBSTACLES:
            while k < watch.drift.shape[0]:
                end_asking(k, watch)
                k += threads
            k = start
            while rigid.shapes.kind.shape[0] > 0 and k < places + pairs:
                if k < places:
                    find_node(k, watch, rigid, near)
                else:
                    find_triangle(k - places, watch, rigid, near)
                k += threads
        elif thread == 0:
            end_search(sleeps, near, watch)
        phase += 1
