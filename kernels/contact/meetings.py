"""What meets or parts before an implicit step: nodes, places between nodes and pairs; see ``active`` and ``joined``."""

import warp as wp

from warp_corot.kernels.elements.elements import load_node
from warp_corot.kernels.stepping.pace import DT, Pace

from .active import APART
from .carriers import mark_carriers
from .law import Law
from .locate import locate_facing
from .motion import Motions, Surface
from .rows import Meeting, Rows, row_count
from .shapes import Shapes, carried, distance_to

wp.set_module_options({"enable_backward": False})

#: Each obstacle has a bit in the number for those that a node touches.
BITS = wp.constant(31)


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
            meets = meets or gap_ahead(o, world, x, step, shapes, motions, law) < 0.0
    if meets or touched != met[i]:
        begins[0] = 1
    met[i] = touched


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
        elif gap_ahead(o, world, x, step, shapes, motions, law) < -law.tolerance:
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


#: What a node of a soft surface has touched is a number of two bits: whether it touched something in the last step, and
#: whether that has changed since the step before.
NOW, CHANGED = wp.constant(1), wp.constant(2)


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
def find_row_meetings(
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
            w = rows.shares[row]
            closing = wp.vec3()
            for k in range(4):
                closing += w[k] * surface.d[p[k]]
            along = wp.dot(closing, rows.normal[row])
            if along < -law.tolerance and rows.gap[row] + along < -law.tolerance:
                begins[0] = 1
        row += threads


@wp.kernel(enable_backward=False)
def mark_acting(threads: int, surface: Surface, rows: Rows, marked: wp.array[wp.int32]):
    """Mark the carriers of the places of pairs that push."""
    row = wp.tid()
    while row < row_count(rows):
        if rows.acts[row] != 0:
            p = rows.places[row]
            k = int(0)
            while k < 4:
                mark_carriers(p[k], surface, marked)
                k += 1
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
    changed = int(0)
    if now != (touched[i] & NOW):
        changed = CHANGED
    touched[i] = now | changed
