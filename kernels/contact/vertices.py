"""Contact of surface nodes with obstacles. Every node has its own mass, so its forces follow directly."""

import warp as wp

from .bearing import loose_share
from .law import LOST, Law, allowed, held_back, least_motion, left_to_held, settled
from .motion import Motions, Surface
from .shapes import MESH, Shapes, carried, distance_to
from .supports import left_at_place

wp.set_module_options({"enable_backward": False})

#: Number of rounds over the obstacles for a node that touches more than one.
ROUNDS = wp.constant(8)


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
    moved: wp.array2d[wp.vec3]  # motion of the obstacle's point in this step [m]
    allowance: wp.array2d[wp.float32]  # how deep the place may be [m]; see ``law.allowed``


@wp.func
def across(a: wp.vec3, normal: wp.vec3):
    return a - wp.dot(a, normal) * normal


@wp.func
def find_beside(s: int, o: int, far: float, rigid: Rigid):
    """Find where an obstacle is in this step; ``far`` is how far the place goes [m]."""
    world = rigid.surface.world[s]
    now = rigid.motions.now[world, o]
    x = rigid.surface.x[s]
    moved = carried(now, rigid.motions.later[world, o], x)
    gap, n = distance_to(rigid.shapes, o, now, x, far + rigid.law.tolerance + wp.length(moved))
    allowance = rigid.allowance[o, s]
    if allowance != 0.0:
        allowance = allowed(allowance, gap)
        rigid.allowance[o, s] = allowance
        gap += allowance
    rigid.away[o, s] = wp.vec4(n[0], n[1], n[2], gap)
    rigid.moved[o, s] = moved


@wp.func
def touch(s: int, is_first: bool, dt: float, rigid: Rigid):
    """Find the forces of all obstacles on a node.

    A sticking node is held at an anchor, a point in the obstacle's frame whose fourth number is 1.
    """
    count = rigid.forces.shape[0]
    total = wp.vec3()
    for o in range(count):
        if is_first:
            rigid.forces[o, s] = wp.vec3()
        total -= rigid.forces[o, s]
    yielding = rigid.surface.yielding[s]
    if yielding == 0.0:
        return
    world = rigid.surface.world[s]
    x = rigid.surface.x[s]
    d = rigid.surface.d[s]
    going = int(ROUNDS)
    while going > 0:
        touched = int(0)
        for o in range(count):
            far = wp.length(d)
            # Meshes look for points no farther away than asked.
            if (is_first and going == ROUNDS) or rigid.shapes.kind[o] == MESH:
                find_beside(s, o, far, rigid)
            now = rigid.motions.now[world, o]
            moved = rigid.moved[o, s]
            found = rigid.away[o, s]
            n = wp.vec3(found[0], found[1], found[2])
            gap = found[3]
            far += rigid.law.tolerance + wp.length(moved)
            before = rigid.forces[o, s]
            if gap <= far or wp.dot(before, before) > 0.0:
                relative = d - moved
                normal_force = wp.max(
                    wp.dot(before, n) + (least_motion(gap, rigid.law, dt) - wp.dot(relative, n)) / yielding, 0.0
                )
                sideways = wp.vec3()
                if normal_force > 0.0:
                    touched += 1
                    slip = across(relative, n)
                    anchor = rigid.anchors[o, s]
                    if anchor[3] > 0.0:
                        held = wp.transform_point(now, wp.vec3(anchor[0], anchor[1], anchor[2]))
                        slip += settled(rigid.law, dt) * across(x - held, n)
                    sideways = held_back(across(before, n) - slip / yielding, normal_force, rigid.shapes.friction[o])
                force = normal_force * n + sideways
                d += yielding * (force - before)
                rigid.forces[o, s] = force
        going -= 1
        if touched < 2:
            going = 0
    for o in range(count):
        total += rigid.forces[o, s]
    rigid.surface.d[s] = d
    rigid.surface.f[s] = rigid.surface.f[s] + total


@wp.func
def begin_borne(s: int, rigid: Rigid):
    """Begin a step at a borne place with the forces of the last one; returns their sum."""
    total = wp.vec3()
    for o in range(rigid.forces.shape[0]):
        was = rigid.forces[o, s]
        far = wp.length(rigid.surface.d[s])
        if wp.dot(was, was) > 0.0:
            far = 1.0
        find_beside(s, o, far, rigid)
        if wp.dot(was, was) > 0.0:
            found = rigid.away[o, s]
            n = wp.vec3(found[0], found[1], found[2])
            push = wp.max(wp.dot(was, n), 0.0)
            force = push * n + held_back(across(was, n), push, rigid.shapes.friction[o])
            rigid.forces[o, s] = force
            total += force
    return total


@wp.func
def push_borne(s: int, yielding: float, dt: float, rigid: Rigid):
    """Correct the forces of obstacles on a borne place, if its ``yielding`` is positive.

    Returns:
        The change of their sum, and the number of obstacles that push.
    """
    world = rigid.surface.world[s]
    x = rigid.surface.x[s]
    d = rigid.surface.d[s]
    more = wp.vec3()
    count = float(0.0)
    for o in range(rigid.forces.shape[0]):
        far = wp.length(d)
        if rigid.shapes.kind[o] == MESH:
            find_beside(s, o, far, rigid)
        now = rigid.motions.now[world, o]
        moved = rigid.moved[o, s]
        found = rigid.away[o, s]
        n = wp.vec3(found[0], found[1], found[2])
        gap = found[3]
        far += rigid.law.tolerance + wp.length(moved)
        before = rigid.forces[o, s]
        if gap <= far or wp.dot(before, before) > 0.0:
            relative = d - moved
            wanted = least_motion(gap + left_at_place(s, gap, n, rigid.surface), rigid.law, dt) - wp.dot(relative, n)
            wanted -= left_to_held(wanted + wp.dot(d, n), loose_share(s, rigid.surface))
            if wanted > 0.0 or wp.dot(before, n) > 0.0:
                count += 1.0
                if yielding > 0.0:
                    normal_force = wp.max(wp.dot(before, n) + wanted / yielding, 0.0)
                    slip = across(relative, n)
                    anchor = rigid.anchors[o, s]
                    if anchor[3] > 0.0:
                        held = wp.transform_point(now, wp.vec3(anchor[0], anchor[1], anchor[2]))
                        slip += settled(rigid.law, dt) * across(x - held, n)
                    sideways = held_back(across(before, n) - slip / yielding, normal_force, rigid.shapes.friction[o])
                    force = normal_force * n + sideways
                    rigid.forces[o, s] = force
                    more += force - before
    return more, count


@wp.func
def anchor(s: int, rigid: Rigid):
    """Set an anchor if the node begins to stick, drag it along with a slipping node, remove it without contact. At the
    end of a step a part of the allowance is lost."""
    if rigid.surface.yielding[s] == 0.0:
        return
    world = rigid.surface.world[s]
    x = rigid.surface.x[s]
    end = x + rigid.surface.d[s]
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
            if rigid.shapes.kind[o] == MESH:
                _gap, n = distance_to(rigid.shapes, o, rigid.motions.now[world, o], x, 1.0)
            normal_force = wp.dot(force, n)
            slips = wp.length(across(force, n)) >= 0.9999 * rigid.shapes.friction[o] * normal_force
            if slips or rigid.anchors[o, s][3] == 0.0:
                p = wp.quat_rotate_inv(wp.transform_get_rotation(pose), end - wp.transform_get_translation(pose))
                rigid.anchors[o, s] = wp.vec4(p[0], p[1], p[2], 1.0)
