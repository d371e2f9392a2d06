"""Contact of places with obstacles."""

import warp as wp

from .law import LOST, Law, allowed, held_back, settled
from .motion import Motions, Surface
from .rows import Rows
from .shapes import Shapes, carried, distance_to

wp.set_module_options({"enable_backward": False})

#: Gaps of more than so many times the motion of their places and obstacles do not close in a step.
FORESEEN = wp.constant(4.0)
#: Whether a contact acts: it cannot in this step; no; yes, since the last iteration, so that its weight is in the sums
#: of one buffer only; yes; no, since the last iteration. See ``mass_split``.
OUT, WAITS, BEGINS, ACTS, ENDS = (wp.constant(k) for k in range(-1, 4))


@wp.struct
class Rigid:
    """Rigid obstacles, the surfaces that they touch, and what is between them."""

    shapes: Shapes
    motions: Motions
    law: Law
    surface: Surface
    rows: Rows
    first_triangle: int  # the first row of a triangle, O S
    anchors: wp.array[wp.vec4]  # [O S] in the obstacle's frame; the fourth number is 1 if the place sticks
    allowance: wp.array[wp.float32]  # [R] how deep the place or triangle may be [m]; see ``law.allowed``
    # [T] fraction of the last step's normal force on a triangle that is left beside corners that touch
    warmth: wp.array[wp.float32]


@wp.func
def across(a: wp.vec3, normal: wp.vec3):
    return a - wp.dot(a, normal) * normal


@wp.func
def forget_place(r: int, acted: int, was: wp.vec3, rows: Rows):
    """Leave a place without contact in this step. Most that something is near are so already, and are only read."""
    if acted != OUT or wp.dot(was, was) > 0.0:
        rows.force[r] = wp.vec3()
        rows.more[r] = wp.vec3()
        rows.acts[r] = OUT
    return False


@wp.func
def begin_place(r: int, dt: float, rigid: Rigid):
    """Find where an obstacle is in this step, and the force with which it begins: that of the last step.

    A sticking place is held at an anchor, a point in the obstacle's frame whose fourth number is 1. Returns whether
    there may be a force.
    """
    rows = rigid.rows
    o = r // rigid.surface.node.shape[0]
    s = r % rigid.surface.node.shape[0]
    was = rows.force[r]
    acted = rows.acts[r]
    if rigid.surface.yielding[s] == 0.0:
        return forget_place(r, acted, was, rows)
    world = rigid.surface.world[s]
    now = rigid.motions.now[world, o]
    x = rigid.surface.x[s]
    moved = carried(now, rigid.motions.later[world, o], x)
    far = FORESEEN * (wp.length(rigid.surface.d[s]) + wp.length(moved)) + rigid.law.tolerance
    pushed = wp.dot(was, was) > 0.0
    gap, n = distance_to(rigid.shapes, o, now, x, wp.where(pushed, 1.0, far))
    allowance = rigid.allowance[r]
    if allowance != 0.0:
        allowance = allowed(allowance, gap)
        rigid.allowance[r] = allowance
        gap += allowance
    if gap > far and not pushed:
        return forget_place(r, acted, was, rows)
    anchor = rigid.anchors[r]
    if anchor[3] > 0.0:
        held = wp.transform_point(now, wp.vec3(anchor[0], anchor[1], anchor[2]))
        moved -= settled(rigid.law, dt) * across(x - held, n)
    rows.acts[r] = WAITS
    rows.normal[r] = n
    rows.gap[r] = gap
    rows.moved[r] = moved
    rows.more[r] = wp.vec3()
    push = wp.max(wp.dot(was, n), 0.0)
    force = wp.vec3()
    if push > 0.0:
        force = push * n + held_back(across(was, n), push, rows.friction[r])
    rows.force[r] = force
    return True


@wp.func
def anchor(s: int, rigid: Rigid):
    """Set an anchor if the node begins to stick, drag it along with a slipping node, remove it without contact. At the
    end of a step a part of the allowance is lost."""
    if rigid.surface.yielding[s] == 0.0:
        return
    world = rigid.surface.world[s]
    end = rigid.surface.x[s] + rigid.surface.d[s]
    for o in range(rigid.shapes.kind.shape[0]):
        r = o * rigid.surface.node.shape[0] + s
        if rigid.allowance[r] > 0.0:
            rigid.allowance[r] = (1.0 - LOST) * rigid.allowance[r]
        force = rigid.rows.force[r]
        if wp.dot(force, force) == 0.0:
            rigid.anchors[r] = wp.vec4()
        else:
            pose = rigid.motions.later[world, o]
            n = rigid.rows.normal[r]
            normal_force = wp.dot(force, n)
            slips = wp.length(across(force, n)) >= 0.9999 * rigid.rows.friction[r] * normal_force
            if slips or rigid.anchors[r][3] == 0.0:
                p = wp.quat_rotate_inv(wp.transform_get_rotation(pose), end - wp.transform_get_translation(pose))
                rigid.anchors[r] = wp.vec4(p[0], p[1], p[2], 1.0)
