"""The surface nodes near other surfaces or obstacles: steps visit only these."""

import warp as wp

from .motion import Motions, Surface
from .watch import ALONE, FARTHEST, PARTS, Watch, common_motion, reserve_node, reserve_obstacle

wp.set_module_options({"enable_backward": False})

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
            farther = ALONE
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
def report_search(watch: Watch, most: wp.array[wp.int32], report: wp.array[wp.float64]):
    """Report to the host the largest number of near pairs, how often an item moved too far, and the number of
    searches."""
    report[0] = wp.float64(most[0])
    report[1] = wp.float64(watch.missed[0])
    report[2] = wp.float64(watch.searches[0])
