"""Nodes that meet an obstacle or part from it, before an implicit step; see ``active``."""

import warp as wp

from warp_corot.kernels.elements.elements import load_node
from warp_corot.kernels.stepping.pace import DT, Pace

from .active import APART
from .law import Law
from .motion import Motions, Surface
from .shapes import Shapes, carried, distance_to

wp.set_module_options({"enable_backward": False})

#: Each obstacle has a bit in the number for those that a node touches.
BITS = wp.constant(31)


@wp.kernel(enable_backward=False)
def find_meetings(
    # In
    start: int,
    inverse_mass: wp.array[wp.float32],
    rest: wp.array[wp.vec4],
    u: wp.array[wp.vec4],
    v: wp.array[wp.vec4],
    pace: Pace,
    shapes: Shapes,
    motions: Motions,
    law: Law,
    surface: Surface,
    kinds: wp.array2d[wp.int32],
    # In and out
    met: wp.array[wp.int32],
    # Out
    begins: wp.array[wp.int32],
):
    """Whether a node has come to touch an obstacle or left it in the last step, or will meet one at its velocity."""
    s = start + wp.tid()
    i = surface.node[s]
    if i < 0:
        return
    x = load_node(rest, i) + load_node(u, i)
    step = float(pace.seconds[DT]) * load_node(v, i)
    world = surface.world[s]
    meets = bool(False)
    touched = int(0)
    for o in range(kinds.shape[0]):
        kind = kinds[o, s]
        if kind != APART:
            touched += wp.lshift(1, o % BITS)
        if kind == APART and inverse_mass[i] > 0.0:
            now = motions.now[world, o]
            moved = carried(now, motions.later[world, o], x)
            relative = step - moved
            far = 2.0 * wp.length(relative) + wp.length(moved) + 2.0 * law.tolerance
            gap, n = distance_to(shapes, o, now, x, far)
            after, _end = distance_to(shapes, o, motions.later[world, o], x + step, far)
            if gap <= far and wp.min(gap + wp.dot(n, relative), after) < 0.0:
                meets = True
    if meets or touched != met[i]:
        begins[0] = 1
    met[i] = touched
