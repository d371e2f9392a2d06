"""Contact of places with obstacles."""

import warp as wp

from .law import LOST, Law, allowed, held_back, settled
from .motion import Motions, Surface
from .shapes import Shapes, carried, distance_to

wp.set_module_options({"enable_backward": False})

#: Gaps of more than so many times the motion of their places and obstacles do not close in a step.
FORESEEN = wp.constant(4.0)
#: Whether a contact acts: it cannot in this step; no; yes, since the last iteration, so that its weight is in the sums
#: of one buffer only; yes; no, since the last iteration. See ``mass_split``.
OUT, WAITS, BEGINS, ACTS, ENDS = (wp.constant(k) for k in range(-1, 4))


@wp.struct
class Rigid:
    """Rigid obstacles, the surfaces that they touch, and what is between them at places, [O, S]."""

    shapes: Shapes
    motions: Motions
    law: Law
    surface: Surface
    forces: wp.array2d[wp.vec3]  # of obstacles on places [N]
    anchors: wp.array2d[wp.vec4]  # in the obstacle's frame; the fourth number is 1 if the place sticks
    away: wp.array2d[wp.vec4]  # the direction out of the obstacle, and the gap [m]
    # motion of the obstacle's point in this step, and of that back to the anchor [m]
    moved: wp.array2d[wp.vec3]
    more: wp.array2d[wp.vec3]  # changes of forces in the last iteration [N]
    acts: wp.array2d[wp.int32]  # see ``mass_split``
    allowance: wp.array2d[wp.float32]  # how deep the place may be [m]; see ``law.allowed``


@wp.func
def across(a: wp.vec3, normal: wp.vec3):
    return a - wp.dot(a, normal) * normal


@wp.func
def forget_place(s: int, o: int, acted: int, was: wp.vec3, rigid: Rigid):
    """Leave a place without contact in this step. Most that something is near are so already, and are only read."""
    if acted != OUT or wp.dot(was, was) > 0.0:
        rigid.forces[o, s] = wp.vec3()
        rigid.more[o, s] = wp.vec3()
        rigid.acts[o, s] = OUT
    return False


@wp.func
def begin_place(s: int, o: int, dt: float, rigid: Rigid):
    """Find where an obstacle is in this step, and the force with which it begins: that of the last step.

    A sticking place is held at an anchor, a point in the obstacle's frame whose fourth number is 1. Returns whether
    there may be a force.
    """
    was = rigid.forces[o, s]
    acted = rigid.acts[o, s]
    if rigid.surface.yielding[s] == 0.0:
        return forget_place(s, o, acted, was, rigid)
    world = rigid.surface.world[s]
    now = rigid.motions.now[world, o]
    x = rigid.surface.x[s]
    moved = carried(now, rigid.motions.later[world, o], x)
    far = FORESEEN * (wp.length(rigid.surface.d[s]) + wp.length(moved)) + rigid.law.tolerance
    pushed = wp.dot(was, was) > 0.0
    gap, n = distance_to(rigid.shapes, o, now, x, wp.where(pushed, 1.0, far))
    allowance = rigid.allowance[o, s]
    if allowance != 0.0:
        allowance = allowed(allowance, gap)
        rigid.allowance[o, s] = allowance
        gap += allowance
    if gap > far and not pushed:
        return forget_place(s, o, acted, was, rigid)
    anchor = rigid.anchors[o, s]
    if anchor[3] > 0.0:
        held = wp.transform_point(now, wp.vec3(anchor[0], anchor[1], anchor[2]))
        moved -= settled(rigid.law, dt) * across(x - held, n)
    rigid.acts[o, s] = WAITS
    rigid.away[o, s] = wp.vec4(n[0], n[1], n[2], gap)
    rigid.moved[o, s] = moved
    rigid.more[o, s] = wp.vec3()
    push = wp.max(wp.dot(was, n), 0.0)
    force = wp.vec3()
    if push > 0.0:
        force = push * n + held_back(across(was, n), push, rigid.shapes.friction[o])
    rigid.forces[o, s] = force
    return True


@wp.func
def anchor(s: int, rigid: Rigid):
    """Set an anchor if the node begins to stick, drag it along with a slipping node, remove it without contact. At the
    end of a step a part of the allowance is lost."""
    if rigid.surface.yielding[s] == 0.0:
        return
    world = rigid.surface.world[s]
    end = rigid.surface.x[s] + rigid.surface.d[s]
    for o in range(rigid.forces.shape[0]):
        if rigid.allowance[o, s] > 0.0:
            rigid.allowance[o, s] = (1.0 - LOST) * rigid.allowance[o, s]
        force = rigid.forces[o, s]
        if wp.dot(force, force) == 0.0:
            rigid.anchors[o, s] = wp.vec4()
        else:
            pose = rigid.motions.later[world, o]
            found = rigid.away[o, s]
            n = wp.vec3(found[0], found[1], found[2])
            normal_force = wp.dot(force, n)
            slips = wp.length(across(force, n)) >= 0.9999 * rigid.shapes.friction[o] * normal_force
            if slips or rigid.anchors[o, s][3] == 0.0:
                p = wp.quat_rotate_inv(wp.transform_get_rotation(pose), end - wp.transform_get_translation(pose))
                rigid.anchors[o, s] = wp.vec4(p[0], p[1], p[2], 1.0)
