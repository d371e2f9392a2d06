"""The surface nodes near other surfaces or obstacles: steps visit only these."""

import warp as wp

from .motion import Surface
from .watch import Watch, reserved

wp.set_module_options({"enable_backward": False})

#: Flags for what is near a node: another soft surface, an obstacle, or an obstacle at an adjacent triangle.
PAIRED, BESIDE, AROUND = wp.constant(1), wp.constant(2), wp.constant(4)
#: Any of these flags; and a flag for nodes of inverted elements.
SOMETHING, CRUSHED = wp.constant(7), wp.constant(8)


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


@wp.kernel(enable_backward=False)
def reserve_nodes(surface: Surface, watch: Watch, near: Near):
    """Begin a search: record the positions of nodes and how far they may move from there."""
    s = wp.tid()
    if watch.due[0] == 0:
        return
    watch.places[s] = surface.x[s]
    watch.reach[s] = reserved(wp.length(surface.d[s]), watch)
    near.flags[s] = 0
    if s == 0:
        near.count[0] = 0
        near.touch_count[0] = 0
