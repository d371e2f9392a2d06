"""The surface nodes that something is near: steps visit these alone."""

import warp as wp

from .motion import Surface
from .watch import Watch, reserved

wp.set_module_options({"enable_backward": False})

#: What is near a node: another soft surface, an obstacle, or an obstacle at a triangle around it.
PAIRED, BESIDE, AROUND = wp.constant(1), wp.constant(2), wp.constant(4)
#: Any of these; and that the node is of an element that is turned inside out.
SOMETHING, CRUSHED = wp.constant(7), wp.constant(8)


@wp.struct
class Near:
    """What the last search has found."""

    flags: wp.array[wp.int32]  # [S] what is
    nodes: wp.array[wp.int32]  # [S]
    count: wp.array[wp.int32]  # [1]
    touches: wp.array[wp.int32]  # [O T] obstacles at triangles: o T + t
    touch_count: wp.array[wp.int32]  # [1]


@wp.func
def mark(near: Near, s: int, flag: int):
    if (wp.atomic_or(near.flags, s, flag) & SOMETHING) == 0:
        near.nodes[wp.atomic_add(near.count, 0, 1)] = s


@wp.kernel(enable_backward=False)
def reserve_nodes(surface: Surface, watch: Watch, near: Near):
    """Begin a search: note where nodes are, and how far they may go from there."""
    s = wp.tid()
    if watch.due[0] == 0:
        return
    watch.places[s] = surface.x[s]
    watch.reach[s] = reserved(wp.length(surface.d[s]), watch)
    near.flags[s] = 0
    if s == 0:
        near.count[0] = 0
        near.touch_count[0] = 0
