"""The contacts and places of ``together``, one at a time.

Each triangle and each pair adds to its places as integers, so the order of threads does not matter, and places between
nodes add to the nodes that bear them.
"""

import warp as wp

from .bearing import is_borne
from .law import Law
from .motion import Surface
from .near import BESIDE
from .pairs import SHARES, grains_of, judge_row, locate_row, solve_row
from .rows import Meeting, Rows
from .touches import Touches, find_touch
from .triangles import BEGIN, CORRECT, END, judge_touch, solve_touch
from .vertices import Rigid, anchor, begin_borne, push_borne, touch

wp.set_module_options({"enable_backward": False})


@wp.struct
class Sums:
    """What contacts add up at places, zero between steps."""

    crowd: wp.array[wp.int32]  # [S] weights of those that push, in multiples of one over SHARES
    added: wp.array[wp.vec3l]  # [S] forces, in grains


@wp.func
def force_of(grains: wp.vec3l, grain: float):
    return grain * wp.vec3(float(grains[0]), float(grains[1]), float(grains[2]))


@wp.func
def add_crowd(s: int, weight: float, surface: Surface, sums: Sums):
    """Count a contact that pushes a place with a weight, or the nodes that bear the place."""
    if is_borne(s, surface):
        b = surface.bearing.bearers[s]
        w = surface.bearing.weights[s]
        for k in range(4):
            if w[k] != 0.0:
                wp.atomic_add(surface.bearing.crowd, b[k], int(SHARES * weight * wp.abs(w[k])))
    else:
        wp.atomic_add(sums.crowd, s, int(SHARES * weight))


@wp.func
def add_force(s: int, force: wp.vec3, law: Law, turn: int, surface: Surface, sums: Sums):
    """Add a force at a place, and to the nodes that bear it."""
    wp.atomic_add(sums.added, s, grains_of(force, law.grain))
    if is_borne(s, surface):
        b = surface.bearing.bearers[s]
        w = surface.bearing.weights[s]
        for k in range(4):
            if w[k] != 0.0:
                wp.atomic_add(surface.bearing.pushed, turn, b[k], grains_of(w[k] * force, law.grain))


@wp.func
def push_corners(w: wp.vec3, force: wp.vec3, corners: wp.vec3i, law: Law, turn: int, surface: Surface, sums: Sums):
    for k in range(3):
        add_force(corners[k], w[k] * force, law, turn, surface, sums)


@wp.func
def push_row(row: int, force: wp.vec3, law: Law, turn: int, surface: Surface, rows: Rows, sums: Sums):
    p = rows.places[row]
    w = rows.shares[row]
    for k in range(4):
        add_force(p[k], w[k] * force, law, turn, surface, sums)


@wp.func
def ease_of(s: int, sums: Sums, surface: Surface):
    """``bearing.ease`` from the sums at the nodes that bear a place."""
    if not is_borne(s, surface):
        return float(sums.crowd[s]) * surface.yielding[s] / SHARES
    b = surface.bearing.bearers[s]
    w = surface.bearing.weights[s]
    total = float(0.0)
    for k in range(4):
        if w[k] != 0.0:
            total += wp.abs(w[k]) * surface.bearing.yielding[b[k]] * float(surface.bearing.crowd[b[k]])
    return total / SHARES


@wp.func
def begin_touch(o: int, t: int, rigid: Rigid, triangles: wp.array[wp.vec3i], touches: Touches, turn: int, sums: Sums):
    """Find a contact on a triangle, with the force with which it begins."""
    find_touch(o, t, rigid, triangles, touches)
    if touches.acts[o, t] != 0:
        push_corners(touches.shares[o, t], touches.force[o, t], triangles[t], rigid.law, turn, rigid.surface, sums)


@wp.func
def weigh_touch(o: int, t: int, law: Law, dt: float, surface: Surface, corners: wp.vec3i, touches: Touches, sums: Sums):
    if judge_touch(o, t, law, dt, surface, corners, surface.yielding, touches) != 0:
        w = touches.shares[o, t]
        for k in range(3):
            add_crowd(corners[k], w[k], surface, sums)


@wp.func
def correct_touch(
    o: int,
    t: int,
    law: Law,
    dt: float,
    surface: Surface,
    corners: wp.vec3i,
    touches: Touches,
    turn: int,
    sums: Sums,
):
    if touches.acts[o, t] == 0:
        return
    eases = wp.vec3(ease_of(corners[0], sums, surface), ease_of(corners[1], sums, surface), 0.0)
    eases[2] = ease_of(corners[2], sums, surface)
    solve_touch(o, t, law, dt, surface, corners, eases, surface.yielding, touches)
    push_corners(touches.shares[o, t], touches.more[o, t], corners, law, turn, surface, sums)


@wp.func
def begin_row(row: int, law: Law, surface: Surface, meeting: Meeting, rows: Rows, turn: int, sums: Sums):
    force = locate_row(row, surface, meeting, rows)
    if wp.dot(force, force) > 0.0:
        push_row(row, force, law, turn, surface, rows, sums)


@wp.func
def weigh_row(row: int, law: Law, dt: float, surface: Surface, rows: Rows, sums: Sums):
    if judge_row(row, law, dt, surface, rows) != 0:
        p = rows.places[row]
        w = rows.shares[row]
        for k in range(4):
            add_crowd(p[k], wp.abs(w[k]), surface, sums)


@wp.func
def correct_row(row: int, law: Law, dt: float, surface: Surface, friction: float, rows: Rows, turn: int, sums: Sums):
    if rows.acts[row] == 0:
        return
    p = rows.places[row]
    eases = wp.vec4()
    for k in range(4):
        eases[k] = ease_of(p[k], sums, surface)
    more = solve_row(row, law, dt, surface, friction, eases, rows)
    push_row(row, more, law, turn, surface, rows, sums)


@wp.func
def press_borne(s: int, begins: bool, solves: int, dt: float, rigid: Rigid, turn: int, sums: Sums):
    """The forces of obstacles on a borne place itself: the first ones, or which push, or their corrections."""
    if begins:
        force = begin_borne(s, rigid)
        add_force(s, force, rigid.law, turn, rigid.surface, sums)
        return
    yielding = float(0.0)
    if solves != 0:
        yielding = ease_of(s, sums, rigid.surface)
    more, pushing = push_borne(s, yielding, dt, rigid)
    if solves != 0:
        add_force(s, more, rigid.law, turn, rigid.surface, sums)
    elif pushing > 0.0:
        add_crowd(s, pushing, rigid.surface, sums)


@wp.func
def move_borne(s: int, law: Law, turn: int, surface: Surface):
    """Move a borne place by what pushes its bearers, and clear these for the next pass."""
    b = surface.bearing.bearers[s]
    w = surface.bearing.weights[s]
    d = wp.vec3()
    for k in range(4):
        if w[k] != 0.0:
            d += (w[k] * surface.bearing.yielding[b[k]]) * force_of(surface.bearing.pushed[turn, b[k]], law.grain)
            surface.bearing.pushed[1 - turn, b[k]] = wp.vec3l()
            surface.bearing.crowd[b[k]] = 0
    surface.d[s] = surface.d[s] + d


@wp.func
def clear_bearers(s: int, turn: int, surface: Surface):
    b = surface.bearing.bearers[s]
    w = surface.bearing.weights[s]
    for k in range(4):
        if w[k] != 0.0:
            surface.bearing.pushed[turn, b[k]] = wp.vec3l()


@wp.func
def push_place(s: int, flags: int, parts: int, dt: float, rigid: Rigid, turn: int, sums: Sums):
    """Give a place what was added: it moves, and the contacts of a node follow."""
    grains = sums.added[s]
    if grains[0] != wp.int64(0) or grains[1] != wp.int64(0) or grains[2] != wp.int64(0):
        force = force_of(grains, rigid.law.grain)
        sums.added[s] = wp.vec3l()
        rigid.surface.f[s] = rigid.surface.f[s] + force
        if not is_borne(s, rigid.surface):
            rigid.surface.d[s] = rigid.surface.d[s] + rigid.surface.yielding[s] * force
    corrects = (parts & (BEGIN | CORRECT)) != 0
    if is_borne(s, rigid.surface):
        move_borne(s, rigid.law, turn, rigid.surface)
        corrects = False
    sums.crowd[s] = 0
    if (flags & BESIDE) != 0:
        if corrects:
            touch(s, (parts & BEGIN) != 0, dt, rigid)
        if (parts & END) != 0:
            anchor(s, rigid)
