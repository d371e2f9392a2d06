"""Contact of surface nodes with obstacles. Every node has its own mass, so its forces follow directly."""

import warp as wp

from .bearing import loose_share
from .law import LOST, SETTLING, Law, allowed, held_back, least_motion, left_to_held
from .motion import Motions, Surface
from .shapes import MESH, Shapes, carried, distance_to
from .supports import left_at_place

wp.set_module_options({"enable_backward": False})

#: Number of rounds over the obstacles for a node that touches more than one.
ROUNDS = wp.constant(8)


@wp.struct
class Beside:
    """Obstacles at places, [O, S]."""

    anchors: wp.array2d[wp.vec4]  # in the obstacle's frame; the fourth number is 1 if the place sticks
    away: wp.array2d[wp.vec4]  # the direction out of the obstacle, and the gap [m]
    moved: wp.array2d[wp.vec3]  # motion of the obstacle's point in this step [m]
    allowance: wp.array2d[wp.float32]  # how deep the place may be [m]; see ``law.allowed``


@wp.func
def across(a: wp.vec3, normal: wp.vec3):
    return a - wp.dot(a, normal) * normal


@wp.func
def find_beside(
    s: int, o: int, far: float, shapes: Shapes, motions: Motions, law: Law, surface: Surface, beside: Beside
):
    """Find where an obstacle is in this step; ``far`` is how far the place goes [m]."""
    world = surface.world[s]
    now = motions.now[world, o]
    x = surface.x[s]
    moved = carried(now, motions.later[world, o], x)
    gap, n = distance_to(shapes, o, now, x, far + law.tolerance + wp.length(moved))
    allowance = beside.allowance[o, s]
    if allowance != 0.0:
        allowance = allowed(allowance, gap)
        beside.allowance[o, s] = allowance
        gap += allowance
    beside.away[o, s] = wp.vec4(n[0], n[1], n[2], gap)
    beside.moved[o, s] = moved


@wp.func
def touch(
    s: int,
    is_first: bool,
    shapes: Shapes,
    motions: Motions,
    law: Law,
    dt: float,
    beside: Beside,
    surface: Surface,
    forces: wp.array2d[wp.vec3],
):
    """Find the forces of all obstacles on a node.

    A sticking node is held at an anchor, a point in the obstacle's frame whose fourth number is 1.
    """
    count = forces.shape[0]
    total = wp.vec3()
    for o in range(count):
        if is_first:
            forces[o, s] = wp.vec3()
        total -= forces[o, s]
    yielding = surface.yielding[s]
    if yielding == 0.0:
        return
    world = surface.world[s]
    x = surface.x[s]
    d = surface.d[s]
    going = int(ROUNDS)
    while going > 0:
        touched = int(0)
        for o in range(count):
            far = wp.length(d)
            # Meshes look for points no farther away than asked.
            if (is_first and going == ROUNDS) or shapes.kind[o] == MESH:
                find_beside(s, o, far, shapes, motions, law, surface, beside)
            now = motions.now[world, o]
            moved = beside.moved[o, s]
            found = beside.away[o, s]
            n = wp.vec3(found[0], found[1], found[2])
            gap = found[3]
            far += law.tolerance + wp.length(moved)
            before = forces[o, s]
            if gap <= far or wp.dot(before, before) > 0.0:
                relative = d - moved
                normal_force = wp.max(
                    wp.dot(before, n) + (least_motion(gap, law, dt) - wp.dot(relative, n)) / yielding, 0.0
                )
                sideways = wp.vec3()
                if normal_force > 0.0:
                    touched += 1
                    slip = across(relative, n)
                    anchor = beside.anchors[o, s]
                    if anchor[3] > 0.0:
                        held = wp.transform_point(now, wp.vec3(anchor[0], anchor[1], anchor[2]))
                        slip += SETTLING * across(x - held, n)
                    sideways = held_back(across(before, n) - slip / yielding, normal_force, shapes.friction[o])
                force = normal_force * n + sideways
                d += yielding * (force - before)
                forces[o, s] = force
        going -= 1
        if touched < 2:
            going = 0
    for o in range(count):
        total += forces[o, s]
    surface.d[s] = d
    surface.f[s] = surface.f[s] + total


@wp.func
def begin_borne(
    s: int, shapes: Shapes, motions: Motions, law: Law, beside: Beside, surface: Surface, forces: wp.array2d[wp.vec3]
):
    """Begin a step at a borne place with the forces of the last one; returns their sum."""
    total = wp.vec3()
    for o in range(forces.shape[0]):
        was = forces[o, s]
        far = wp.length(surface.d[s])
        if wp.dot(was, was) > 0.0:
            far = 1.0
        find_beside(s, o, far, shapes, motions, law, surface, beside)
        if wp.dot(was, was) > 0.0:
            found = beside.away[o, s]
            n = wp.vec3(found[0], found[1], found[2])
            push = wp.max(wp.dot(was, n), 0.0)
            force = push * n + held_back(across(was, n), push, shapes.friction[o])
            forces[o, s] = force
            total += force
    return total


@wp.func
def push_borne(
    s: int,
    yielding: float,
    shapes: Shapes,
    motions: Motions,
    law: Law,
    dt: float,
    beside: Beside,
    surface: Surface,
    forces: wp.array2d[wp.vec3],
):
    """Correct the forces of obstacles on a borne place, if its ``yielding`` is positive.

    Returns:
        The change of their sum, and the number of obstacles that push.
    """
    world = surface.world[s]
    x = surface.x[s]
    d = surface.d[s]
    more = wp.vec3()
    count = float(0.0)
    for o in range(forces.shape[0]):
        far = wp.length(d)
        if shapes.kind[o] == MESH:
            find_beside(s, o, far, shapes, motions, law, surface, beside)
        now = motions.now[world, o]
        moved = beside.moved[o, s]
        found = beside.away[o, s]
        n = wp.vec3(found[0], found[1], found[2])
        gap = found[3]
        far += law.tolerance + wp.length(moved)
        before = forces[o, s]
        if gap <= far or wp.dot(before, before) > 0.0:
            relative = d - moved
            wanted = least_motion(gap + left_at_place(s, gap, n, surface), law, dt) - wp.dot(relative, n)
            wanted -= left_to_held(wanted + wp.dot(d, n), loose_share(s, surface))
            if wanted > 0.0 or wp.dot(before, n) > 0.0:
                count += 1.0
                if yielding > 0.0:
                    normal_force = wp.max(wp.dot(before, n) + wanted / yielding, 0.0)
                    slip = across(relative, n)
                    anchor = beside.anchors[o, s]
                    if anchor[3] > 0.0:
                        held = wp.transform_point(now, wp.vec3(anchor[0], anchor[1], anchor[2]))
                        slip += SETTLING * across(x - held, n)
                    sideways = held_back(across(before, n) - slip / yielding, normal_force, shapes.friction[o])
                    force = normal_force * n + sideways
                    forces[o, s] = force
                    more += force - before
    return more, count


@wp.func
def anchor(
    s: int,
    shapes: Shapes,
    motions: Motions,
    surface: Surface,
    forces: wp.array2d[wp.vec3],
    beside: Beside,
):
    """Set an anchor if the node begins to stick, drag it along with a slipping node, remove it without contact. At the
    end of a step a part of the allowance is lost."""
    if surface.yielding[s] == 0.0:
        return
    world = surface.world[s]
    x = surface.x[s]
    end = x + surface.d[s]
    for o in range(forces.shape[0]):
        if beside.allowance[o, s] > 0.0:
            beside.allowance[o, s] = (1.0 - LOST) * beside.allowance[o, s]
        force = forces[o, s]
        if wp.dot(force, force) == 0.0:
            beside.anchors[o, s] = wp.vec4()
        else:
            pose = motions.later[world, o]
            found = beside.away[o, s]
            n = wp.vec3(found[0], found[1], found[2])
            if shapes.kind[o] == MESH:
                _gap, n = distance_to(shapes, o, motions.now[world, o], x, 1.0)
            normal_force = wp.dot(force, n)
            slips = wp.length(across(force, n)) >= 0.9999 * shapes.friction[o] * normal_force
            if slips or beside.anchors[o, s][3] == 0.0:
                p = wp.quat_rotate_inv(wp.transform_get_rotation(pose), end - wp.transform_get_translation(pose))
                beside.anchors[o, s] = wp.vec4(p[0], p[1], p[2], 1.0)
