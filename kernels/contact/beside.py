"""Surface nodes and triangles that are near obstacles."""

import warp as wp

from .near import AROUND, BESIDE, Near, leave_room, mark
from .shapes import GROUND, distance_to, sure_distance
from .touches import Touches
from .vertices import Rigid
from .watch import FARTHEST, Watch

wp.set_module_options({"enable_backward": False})


@wp.func
def horizon(watch: Watch):
    """How far beyond what is reserved a search looks for obstacles [m]: not where others are nearer already."""
    return wp.min(watch.room[0], FARTHEST * watch.size)


@wp.kernel(enable_backward=False)
def find_nodes_beside(
    # In
    watch: Watch,
    # Out
    near: Near,
    rigid: Rigid,
):
    """Mark nodes that may touch an obstacle before the next search. Obstacles exert no forces on other nodes."""
    s = wp.tid()
    if watch.due[0] == 0:
        return
    if rigid.surface.node[s] >= 0:
        world = rigid.surface.world[s]
        for o in range(rigid.forces.shape[0]):
            far = watch.reach[s] + watch.reach_of[world, o] + rigid.law.tolerance
            gap, _normal = distance_to(
                rigid.shapes, o, rigid.motions.now[world, o], rigid.surface.x[s], far + horizon(watch)
            )
            if gap <= far:
                mark(near, s, BESIDE)
                return
            leave_room(sure_distance(rigid.shapes, o, gap) - far, watch)
    for o in range(rigid.forces.shape[0]):
        rigid.forces[o, s] = wp.vec3()
        rigid.anchors[o, s] = wp.vec4()


@wp.kernel(enable_backward=False)
def find_triangles_beside(
    # In
    watch: Watch,
    rigid: Rigid,
    triangles: wp.array[wp.vec3i],
    # Out
    near: Near,
    touches: Touches,
):
    """List triangles that may touch an obstacle before the next search. Obstacles exert no forces on other
    triangles.
    """
    o, t = wp.tid()
    if watch.due[0] == 0:
        return
    corners = triangles[t]
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
            near.touches[wp.atomic_add(near.touch_count, 0, 1)] = o * triangles.shape[0] + t
            for k in range(3):
                mark(near, corners[k], AROUND)
            return
    touches.shares[o, t] = wp.vec3()
    touches.force[o, t] = wp.vec3()
    touches.acts[o, t] = 0
