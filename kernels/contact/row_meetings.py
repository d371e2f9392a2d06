"""Soft surfaces that meet or part, before an implicit step of second order; see ``joined``.

What a node has touched is a number of two bits: whether it touched something in the last step, and whether that has
changed since the step before.
"""

import warp as wp

from warp_corot.kernels.elements.elements import load_node
from warp_corot.kernels.stepping.pace import DT, Pace

from .carriers import mark_carriers
from .facing import locate_facing
from .law import Law
from .motion import Surface
from .rows import Meeting, Rows, row_count

wp.set_module_options({"enable_backward": False})

#: The two bits.
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
