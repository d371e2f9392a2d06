"""What meets or parts before an implicit step: obstacles and pairs; see ``implicit_rows``."""

import warp as wp

from warp_corot.kernels.elements.elements import load_node
from warp_corot.kernels.stepping.pace import DT, Pace

from .bearing import Carriers, is_held_at
from .law import Law
from .locate import locate_facing
from .motion import Motions, Surface
from .rows import Meeting, Rows, row_count
from .shapes import Shapes, carried, distance_to

wp.set_module_options({"enable_backward": False})

#: What a node has touched is a number of bits: those of ``implicit_rows.mark_acting`` after the last step, and whether
#: these have changed since the step before.
CHANGED = wp.constant(1 << 30)


@wp.func
def gap_ahead(o: int, world: int, x: wp.vec3, step: wp.vec3, shapes: Shapes, motions: Motions, law: Law):
    """The gap between a point and an obstacle at the end of a step [m], if the point goes by ``step`` [m]; where it is
    too far to meet the obstacle, how far."""
    now = motions.now[world, o]
    moved = carried(now, motions.later[world, o], x)
    relative = step - moved
    far = 2.0 * wp.length(relative) + wp.length(moved) + 2.0 * law.tolerance
    gap, n = distance_to(shapes, o, now, x, far)
    after, _end = distance_to(shapes, o, motions.later[world, o], x + step, far)
    if gap > far:
        return gap
    return wp.min(gap + wp.dot(n, relative), after)


@wp.kernel(enable_backward=False)
def find_onsets(
    # In
    shapes: Shapes,
    motions: Motions,
    law: Law,
    surface: Surface,
    carriers: Carriers,
    forces: wp.array2d[wp.vec3],
    # Out
    begins: wp.array[wp.int32],
):
    """Whether a place will meet an obstacle, which did not push it in the last step, at the velocities of its nodes."""
    s = wp.tid()
    if surface.node[s] < 0 or is_held_at(s, surface, carriers):
        return
    world = surface.world[s]
    for o in range(forces.shape[0]):
        ahead = gap_ahead(o, world, surface.x[s], surface.d[s], shapes, motions, law)
        if wp.length_sq(forces[o, s]) == 0.0 and ahead < -law.tolerance:
            begins[0] = 1


@wp.kernel(enable_backward=False)
def foresee_places(
    # In
    start: int,
    rest: wp.array[wp.vec4],
    u: wp.array[wp.vec4],
    v: wp.array[wp.vec4],
    pace: Pace,
    touched: wp.array[wp.int32],
    # Out
    surface: Surface,
    begins: wp.array[wp.int32],
):
    """Where a body's carriers are, and how far their velocities lead; whether what they touch has changed."""
    s = start + wp.tid()
    i = surface.node[s]
    if i < 0:
        return
    home = load_node(rest, i)
    surface.rest[s] = home
    surface.x[s] = home + load_node(u, i)
    surface.d[s] = float(pace.seconds[DT]) * load_node(v, i)
    if (touched[i] & CHANGED) != 0:
        begins[0] = 1


@wp.kernel(enable_backward=False)
def find_pair_onsets(
    # In
    threads: int,
    law: Law,
    surface: Surface,
    meeting: Meeting,
    # In and out
    rows: Rows,
    # Out
    begins: wp.array[wp.int32],
):
    """Whether a pair that did not act in the last step will meet at the velocities of its nodes."""
    row = wp.tid()
    while row < row_count(rows):
        force = rows.force[row]
        if wp.dot(force, force) == 0.0 and locate_facing(row, surface, meeting, rows):
            p = rows.places[row]
            w = rows.weights[row]
            closing = wp.vec3()
            for k in range(4):
                closing += w[k] * surface.d[p[k]]
            along = wp.dot(closing, rows.normal[row])
            if along < -law.tolerance and rows.gap[row] + along < -law.tolerance:
                begins[0] = 1
        row += threads


@wp.kernel(enable_backward=False)
def note_touched(
    # In
    start: int,
    offset: int,
    surface: Surface,
    # In and out
    marked: wp.array[wp.int32],
    touched: wp.array[wp.int32],
):
    """What the carriers of a body, from ``offset`` on, have touched in the step; none is marked afterwards."""
    s = start + wp.tid()
    i = surface.node[s]
    now = marked[offset + s]
    marked[offset + s] = 0
    if i < 0:
        return
    touched[i] = now | wp.where(now != (touched[i] & (CHANGED - 1)), CHANGED, 0)
