"""Places between nodes that meet an obstacle or part from it, before an implicit step; see ``meetings``."""

import warp as wp

from warp_corot.kernels.elements.elements import load_node
from warp_corot.kernels.stepping.pace import DT, Pace

from .law import Law
from .meetings import BITS
from .motion import Motions, Surface
from .shapes import Shapes, carried, distance_to

wp.set_module_options({"enable_backward": False})


@wp.kernel(enable_backward=False)
def find_borne_meetings(
    # In
    start: int,
    rest: wp.array[wp.vec4],
    u: wp.array[wp.vec4],
    v: wp.array[wp.vec4],
    pace: Pace,
    shapes: Shapes,
    motions: Motions,
    law: Law,
    surface: Surface,
    bearers: Surface,
    forces: wp.array2d[wp.vec3],
    # Out
    touched: wp.array[wp.int32],
    begins: wp.array[wp.int32],
):
    """The obstacles that push each place, at one of its nodes; whether a place will meet another at its velocity."""
    s = start + wp.tid()
    i = surface.node[s]
    if i < 0:
        return
    b = surface.bearing.bearers[s]
    w = surface.bearing.weights[s]
    x = wp.vec3()
    step = wp.vec3()
    for k in range(4):
        if w[k] != 0.0:
            node = bearers.node[b[k]]
            x += w[k] * (load_node(rest, node) + load_node(u, node))
            step += (w[k] * float(pace.seconds[DT])) * load_node(v, node)
    world = surface.world[s]
    for o in range(forces.shape[0]):
        force = forces[o, s]
        if wp.dot(force, force) > 0.0:
            wp.atomic_or(touched, i, wp.lshift(1, o % BITS))
        else:
            now = motions.now[world, o]
            moved = carried(now, motions.later[world, o], x)
            relative = step - moved
            far = 2.0 * wp.length(relative) + wp.length(moved) + 2.0 * law.tolerance
            gap, n = distance_to(shapes, o, now, x, far)
            after, _end = distance_to(shapes, o, motions.later[world, o], x + step, far)
            if gap <= far and wp.min(gap + wp.dot(n, relative), after) < -law.tolerance:
                begins[0] = 1


@wp.kernel(enable_backward=False)
def compare_touched(touched: wp.array[wp.int32], met: wp.array[wp.int32], begins: wp.array[wp.int32]):
    """Whether a node's places touch other obstacles than a step ago."""
    i = wp.tid()
    now = touched[i]
    touched[i] = 0
    if now != met[i]:
        begins[0] = 1
    met[i] = now
