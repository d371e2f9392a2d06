"""Where obstacles are close to the places and the triangles of bodies in an implicit step; see ``implicit_rows``."""

import warp as wp

from warp_corot.kernels.stepping.pace import DT, Pace

from .bearing import Carriers, crowd_at, is_borne, is_held_at, left_at, motion_at
from .closest import Rolling, rolling_of, tilted
from .explicit_rows import CORNER, SKEWERED, near_triangle
from .implicit_rows import AGAIN, FIRST, MISSING, ImplicitRows, corner_weights, list_row
from .law import QUARTERED, Law, across, held_back, kept_gap
from .motion import Motions, Surface
from .rows import Rows
from .shapes import CAPSULE, GROUND, SPHERE, Shapes, carried, distance_to

wp.set_module_options({"enable_backward": False})

#: An obstacle may sink into triangles by this fraction of half its thickness, but not into wide triangles of own
#: surfaces. Otherwise all triangles around a ball are tangent to it, hold off the nodes, and make bodies much too
#: stiff. So nodes less than 1.26 radii apart need no rows between them.
ALLOWED = wp.constant(0.2)
#: Triangles with an edge longer than this, in halves of an obstacle's thickness, are wide: between corners that are
#: nearer each other a round obstacle sinks in by less than 0.5 % of its radius.
WIDE = wp.constant(0.2)
#: A motion of up to this fraction of half the obstacle's thickness is checked at its end. A faster one may lead through
#: the obstacle.
NEAR_END = wp.constant(0.5)
#: An obstacle must be closer to a triangle than to its corners by this many times the size of rounding errors.
CLOSER = wp.constant(4.0)
#: The point of a triangle stays if another is closer by at most this many times the law's slack, and goes no farther
#: than to where it would stay.
STAYS = wp.constant(1.0)


@wp.struct
class Found:
    """Where an obstacle is close to a place or a triangle."""

    is_near: wp.bool
    weights: wp.vec4
    gap: float
    normal: wp.vec3
    moved: wp.vec3  # how far the obstacle goes there in the step [m]
    opened: float  # how far the gap opens in the step [m]
    is_at_end: wp.bool  # whether the gap is that at the end of the step
    allowed: float  # how far the obstacle may sink in [m]
    friction: float
    rolling: Rolling
    tilt: wp.vec3  # its tilt there


@wp.func
def find_on_triangle(
    o: int, pose: wp.transform, at: wp.mat33, far: float, was: wp.vec3, side: wp.vec3, before: wp.vec3, shapes: Shapes,
    law: Law,
):  # fmt: skip
    """The point of a triangle with the corners ``at`` that is closest to an obstacle, if it is within reach and closer
    than the corners.

    The point with the shares ``before`` stays if it is hardly less close: along an edge of an obstacle all points are
    about as close, and forces that jump between them do not come to rest. On round obstacles it rolls instead.
    """
    found = Found()
    found.is_near = False
    is_near, w, gap, n = near_triangle(o, pose, at[0], at[1], at[2], far, was, side, shapes)
    if not is_near:
        return found
    most = far + wp.length(at[1] - at[0]) + wp.length(at[2] - at[0])
    point = before * at
    is_round = shapes.kind[o] == SPHERE or shapes.kind[o] == CAPSULE
    tried = int(3)
    if wp.dot(was, was) > 0.0 and wp.max(before) <= CORNER and not is_round:
        tried = 4
    # The corners, the former point, and the one where it goes. This loop is not unrolled, so that there is one distance
    # function to compile.
    k = int(0)
    while k < tried:
        there = point
        if k < 3:
            there = at[k]
        distance, out = distance_to(shapes, o, pose, there, most)
        if k < 3 and distance <= gap + CLOSER * law.tolerance:
            return found
        if k == 3:
            beyond = distance - gap
            if beyond > STAYS * law.slack:
                w = before + (1.0 - wp.sqrt(STAYS * law.slack / beyond)) * (w - before)
                point = w * at
                tried = 5
            else:
                w = before
        if k >= 3:
            gap = distance
            n = out
        k += 1
    found.is_near = True
    found.rolling = rolling_of(o, pose, w, gap, n, at[0], at[1], at[2], shapes)
    found.weights = wp.vec4(w[0], w[1], w[2], 0.0)
    found.gap = gap
    found.normal = n
    return found


@wp.func
def is_done(which: int, going: wp.array[wp.int32], rows: ImplicitRows):
    """Whether nothing is to be found: contacts are not located again before the next solve, or no step is to end."""
    return (which == AGAIN and rows.due[0] == 0) or (which == MISSING and going[0] != 0)


@wp.func
def halfway(r: int, found: Found, e: wp.mat33, rows: ImplicitRows):
    """A row halfway between where it was and where it is found after motions e of the corners.

    Forces turn with the normal, and may come and go between two normals from one time that rows are located to the
    next.
    """
    n = rows.normal[r]
    gone = wp.dot(n, corner_weights(r, rows) * e - rows.moved[r])
    found.gap = 0.5 * (found.gap + rows.gap[r] + gone - rows.opened[r])
    found.weights = 0.5 * (found.weights + rows.weights[r])
    found.normal = wp.normalize(found.normal + n)
    return found


@wp.func
def take_row(
    r: int,
    which: int,
    found: Found,
    e: wp.vec3,
    places: wp.vec4i,
    law: Law,
    pace: Pace,
    surface: Surface,
    carriers: Carriers,
    rows: ImplicitRows,
    changed: wp.array[wp.int32],
):
    """List a row where an obstacle is near, after a motion e relative to it; its force becomes its multiplier."""
    was = rows.force[r]
    was_listed = rows.listed[r] != 0 and which != FIRST
    pushed = wp.dot(was, was) > 0.0
    rows.listed[r] = 0
    rows.force[r] = wp.vec3()
    if not found.is_near:
        rows.most[r] = 0.0
        return
    n = found.normal
    if was_listed:
        short = rows.gap[r] + wp.dot(rows.normal[r], e) - rows.opened[r] - rows.target[r]
        if wp.abs(short) <= law.slack:
            was = rows.multiplier[r]
    opened = wp.where(found.is_at_end, found.opened, 0.0)
    target = rows.target[r]
    if not was_listed:
        # Where held nodes bear most of the point, it may stay as deep as the obstacle's motion leads.
        there = found.gap - opened - wp.dot(n, found.moved)
        allowed = found.allowed + left_at(places, found.weights, there, n, surface)
        target = -allowed
        if which == FIRST:
            target = kept_gap(found.gap + allowed, pushed, law, float(pace.seconds[DT])) - allowed
    is_passed = found.gap + found.opened - opened < target - law.tolerance
    if which == MISSING:
        if not is_passed:
            return
        changed[0] = 1
    push = wp.max(wp.dot(was, n), 0.0)
    rows.places[r] = places
    rows.weights[r] = found.weights
    rows.normal[r] = n
    rows.gap[r] = found.gap
    rows.friction[r] = found.friction
    rows.moved[r] = found.moved
    rows.opened[r] = opened
    rows.target[r] = target
    if r >= rows.first_triangle:
        t = r - rows.first_triangle
        rows.rolling[t] = found.rolling
        rows.tilt[t] = found.tilt
        rows.moment[t] = wp.vec3()
        rows.bend[t] = push * found.rolling.distance
    rows.multiplier[r] = push * n + held_back(across(was, n), push, found.friction)
    rows.force[r] = rows.multiplier[r]
    list_row(r, rows)
    if push > 0.0 or is_passed:
        for k in range(3):
            if found.weights[k] != 0.0:
                crowd_at(0, places[k], found.weights[k], surface, carriers)


@wp.func
def locate_at(
    k: int,
    which: int,
    shapes: Shapes,
    motions: Motions,
    law: Law,
    pace: Pace,
    surface: Surface,
    triangles: wp.array[wp.vec3i],
    d: wp.array[wp.vec4],
    kept: Rows,
    carriers: Carriers,
    rows: ImplicitRows,
    changed: wp.array[wp.int32],
):
    """Find obstacles at a place, or at a triangle, whose numbers follow, at the beginning of the step or after motions
    d; forces become multipliers.

    If a motion is fast, its path may lead through the obstacle, so the row stays where the step begins.
    """
    is_place = k < surface.node.shape[0]
    first = int(k)
    stride = surface.node.shape[0]
    corners = wp.vec3i(k, -1, -1)
    if not is_place:
        first = rows.first_triangle + k - stride
        corners = triangles[k - stride]
        stride = triangles.shape[0]
    if which == FIRST:
        for o in range(shapes.kind.shape[0]):
            rows.listed[first + o * stride] = 0
    if corners[0] < 0 or (is_place and (surface.node[k] < 0 or is_held_at(k, surface, carriers))):
        return
    world = surface.world[corners[0]]
    way = float(0.0)
    x = wp.mat33()
    e = wp.mat33()
    for m in range(3):
        if corners[m] >= 0:
            e[m] = motion_at(corners[m], surface, carriers, d)
            x[m] = surface.x[corners[m]]
            way = wp.max(way, wp.length(e[m]))
    middle = wp.where(is_place, x[0], (x[0] + x[1] + x[2]) / 3.0)
    longest = wp.max(wp.length(x[0] - x[1]), wp.max(wp.length(x[1] - x[2]), wp.length(x[2] - x[0])))
    for o in range(shapes.kind.shape[0]):
        r = first + o * stride
        if which == FIRST:
            rows.force[r] = kept.force[r]
            rows.normal[r] = kept.normal[r]
            rows.weights[r] = kept.weights[r]
        if (not is_place and shapes.kind[o] == GROUND) or (which == MISSING and rows.listed[r] != 0):
            continue
        now = motions.now[world, o]
        later = motions.later[world, o]
        thickness = shapes.thickness[o]
        is_at_end = which != FIRST and way <= NEAR_END * thickness
        pose = now
        at = x
        if is_at_end:
            pose = later
            at = x + e
        far = 2.0 * way + wp.length(carried(now, later, middle)) + 2.0 * law.tolerance
        was = rows.force[r]
        found = Found()
        if is_place:
            if wp.length_sq(was) > 0.0:
                # What a small gap has left of the last force still pushes.
                far += 4.0 * law.slack
            gap, n = distance_to(shapes, o, pose, at[0], far)
            found.is_near = gap <= far
            found.weights = wp.vec4(1.0, 0.0, 0.0, 0.0)
            found.gap = gap
            found.normal = n
        else:
            found = find_on_triangle(o, pose, at, far, was, rows.normal[r], corner_weights(r, rows), shapes, law)
            is_late = which == AGAIN and rows.solves[0] >= QUARTERED
            if is_late and is_at_end and found.is_near and rows.listed[r] != 0:
                found = halfway(r, found, e, rows)
        w = wp.vec3(found.weights[0], found.weights[1], found.weights[2])
        found.moved = carried(now, later, w * x)
        slip = w * e - found.moved
        found.opened = wp.dot(found.normal, slip)
        found.is_at_end = is_at_end
        found.friction = shapes.friction[o]
        if not is_place:
            if not is_at_end:
                found.rolling.distance = 0.0
            elif found.is_near and found.rolling.distance > 0.0:
                found.tilt = tilted(found.rolling, w, found.normal, e)
            if not is_borne(corners[0], surface) or longest <= WIDE * thickness:
                found.allowed = ALLOWED * thickness
            if found.gap < -SKEWERED * thickness - found.allowed:
                found.friction = 0.0
        places = wp.vec4i(corners[0], corners[1], corners[2], -1)
        take_row(r, which, found, slip, places, law, pace, surface, carriers, rows, changed)


@wp.kernel(enable_backward=False)
def locate_obstacles(
    # In
    threads: int,
    which: int,
    shapes: Shapes,
    motions: Motions,
    law: Law,
    pace: Pace,
    surface: Surface,
    triangles: wp.array[wp.vec3i],
    d: wp.array[wp.vec4],
    kept: Rows,
    going: wp.array[wp.int32],
    # In and out
    carriers: Carriers,
    rows: ImplicitRows,
    # Out
    changed: wp.array[wp.int32],
):
    """Find obstacles at all places, and at triangles if there are rows for them; missing ones only if no solve is
    ``going`` to follow. ``kept``: the rows of the last step."""
    k = wp.tid()
    count = surface.node.shape[0]
    if rows.first_pair > rows.first_triangle:
        count += triangles.shape[0]
    while k < count and not is_done(which, going, rows):
        locate_at(k, which, shapes, motions, law, pace, surface, triangles, d, kept, carriers, rows, changed)
        k += threads
