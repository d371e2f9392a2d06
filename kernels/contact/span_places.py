"""Where obstacles are close to the triangles of a body and to its places between nodes; see ``spans``."""

import warp as wp

from warp_corot.kernels.stepping.pace import DT, Pace

from .active import NEAR_END
from .carriers import Carriers, crowd_at, ease_at, is_held_at, motion_at
from .law import Law, held_back
from .motion import Motions, Surface
from .nearest_span import Found, find_span, tilted
from .shapes import GROUND, Shapes, carried, distance_to
from .spans import Spans, list_span, span_at
from .springs import QUARTERED, kept_gap
from .supports import left_at_triangle, loose_at_triangle, loose_part
from .touches import SKEWERED, Touches
from .vertices import across

wp.set_module_options({"enable_backward": False})

#: Which spans are found: all at the beginning of the step, all again if that is due, or those that are missing.
FIRST, AGAIN, MISSING = (wp.constant(k) for k in range(3))
#: An obstacle may sink into triangles by this fraction of half its thickness, but not into wide triangles of own
#: surfaces. Otherwise all triangles around a ball are tangent to it, hold off the nodes, and make bodies much too
#: stiff. So nodes less than 1.26 radii apart need no spans.
ALLOWED = wp.constant(0.2)
#: Triangles with an edge longer than this, in halves of an obstacle's thickness, are wide: between corners that are
#: nearer each other a round obstacle sinks in by less than 0.5 % of its radius.
WIDE = wp.constant(0.2)


@wp.func
def is_done(which: int, spans: Spans):
    """Whether nothing is to be found: contacts are not located again before the next solve, or no step is to end."""
    return (which == AGAIN and spans.due[0] == 0) or (which == MISSING and spans.goes[0] != 0)


@wp.func
def halfway(o: int, t: int, found: Found, e: wp.mat33, touches: Touches, spans: Spans):
    """A span halfway between where it was and where it is found after motions e of the corners.

    Forces turn with the normal, and may come and go between two normals from one time that spans are found to the next.
    """
    n = touches.normal[o, t]
    gone = wp.dot(n, touches.shares[o, t] * e - touches.moved[o, t])
    found.gap = 0.5 * (found.gap + touches.gap[o, t] + gone - spans.base[o, t])
    found.shares = 0.5 * (found.shares + touches.shares[o, t])
    found.normal = wp.normalize(found.normal + n)
    return found


@wp.func
def take_span(
    o: int,
    t: int,
    which: int,
    found: Found,
    e: wp.vec3,
    corners: wp.vec3i,
    law: Law,
    pace: Pace,
    surface: Surface,
    carriers: Carriers,
    touches: Touches,
    spans: Spans,
    changed: wp.array[wp.int32],
):
    """List a span where an obstacle is near; its force becomes its multiplier."""
    was = touches.force[o, t]
    was_listed = spans.listed[o, t] != 0 and which != FIRST
    pushed = wp.dot(was, was) > 0.0
    spans.listed[o, t] = 0
    touches.force[o, t] = wp.vec3()
    touches.acts[o, t] = 0
    if not found.is_near:
        spans.most[o, t] = 0.0
        return
    n = found.normal
    if was_listed:
        short = touches.gap[o, t] + wp.dot(touches.normal[o, t], e) - spans.base[o, t] - spans.target[o, t]
        if wp.abs(short) <= law.slack:
            was = spans.multiplier[o, t]
    base = wp.where(found.is_at_end, found.opened, 0.0)
    target = spans.target[o, t]
    if not was_listed:
        # Where held nodes bear most of the point, it may stay as deep as the obstacle's motion leads.
        there = found.gap - base - wp.dot(n, found.moved)
        allowed = found.allowed + left_at_triangle(found.shares, corners, there, n, surface.yielding, surface)
        target = -allowed
        if which == FIRST:
            target = kept_gap(found.gap + allowed, pushed, law, float(pace.seconds[DT])) - allowed
    is_passed = found.gap + found.opened - base < target - law.tolerance
    if which == MISSING:
        if not is_passed:
            return
        changed[0] = 1
    push = wp.max(wp.dot(was, n), 0.0)
    touches.shares[o, t] = found.shares
    touches.normal[o, t] = n
    touches.gap[o, t] = found.gap
    touches.friction[o, t] = found.friction
    touches.moved[o, t] = found.moved
    spans.listed[o, t] = 1
    spans.base[o, t] = base
    spans.target[o, t] = target
    spans.rolling[o, t] = found.rolling
    spans.tilt[o, t] = found.tilt
    spans.moment[o, t] = wp.vec3()
    spans.bend[o, t] = push * found.rolling.distance
    spans.multiplier[o, t] = push * n + held_back(across(was, n), push, found.friction)
    touches.force[o, t] = spans.multiplier[o, t]
    list_span(o, t, spans)
    if push > 0.0 or is_passed:
        for k in range(3):
            if found.shares[k] != 0.0:
                crowd_at(corners[k], found.shares[k], surface, carriers)


@wp.func
def locate_span(
    t: int,
    which: int,
    shapes: Shapes,
    thickness: wp.array[wp.float32],
    motions: Motions,
    law: Law,
    pace: Pace,
    surface: Surface,
    triangles: wp.array[wp.vec3i],
    d: wp.array[wp.vec4],
    carriers: Carriers,
    touches: Touches,
    spans: Spans,
    changed: wp.array[wp.int32],
):
    """Find spans of a body's triangles at the beginning of the step, or after motions d; forces become multipliers.

    If a motion is fast, its path may lead through the obstacle, so the span stays where the step begins.
    """
    corners = triangles[t]
    if corners[0] < 0:
        return
    world = surface.world[corners[0]]
    way = float(0.0)
    x = wp.mat33()
    e = wp.mat33()
    for k in range(3):
        e[k] = motion_at(corners[k], surface, carriers, d)
        x[k] = surface.x[corners[k]]
        way = wp.max(way, wp.length(e[k]))
    for o in range(touches.force.shape[0]):
        if shapes.kind[o] == GROUND or (which == MISSING and spans.listed[o, t] != 0):
            continue
        was = touches.force[o, t]
        now = motions.now[world, o]
        later = motions.later[world, o]
        is_at_end = which != FIRST and way <= NEAR_END * thickness[o]
        pose = now
        at = x
        if is_at_end:
            pose = later
            at = x + e
        middle = (x[0] + x[1] + x[2]) / 3.0
        far = 2.0 * way + wp.length(carried(now, later, middle)) + 2.0 * law.tolerance
        found = find_span(
            o, pose, at[0], at[1], at[2], far, was, touches.normal[o, t], touches.shares[o, t], shapes, law
        )
        is_late = which == AGAIN and spans.solves[0] >= QUARTERED
        if is_late and is_at_end and found.is_near and spans.listed[o, t] != 0:
            found = halfway(o, t, found, e, touches, spans)
        found.moved = carried(now, later, found.shares * x)
        found.opened = wp.dot(found.normal, found.shares * e - found.moved)
        found.is_at_end = is_at_end
        if not is_at_end:
            found.rolling.distance = 0.0
        if found.is_near and found.rolling.distance > 0.0:
            found.tilt = tilted(found.rolling, found.shares, found.normal, e)
        found.allowed = ALLOWED * thickness[o]
        longest = wp.max(wp.length(x[0] - x[1]), wp.max(wp.length(x[1] - x[2]), wp.length(x[2] - x[0])))
        if spans.are_borne != 0 and longest > WIDE * thickness[o]:
            found.allowed = 0.0
        found.friction = shapes.friction[o]
        if found.gap < -SKEWERED * thickness[o] - found.allowed:
            found.friction = 0.0
        take_span(
            o,
            t,
            which,
            found,
            found.shares * e - found.moved,
            corners,
            law,
            pace,
            surface,
            carriers,
            touches,
            spans,
            changed,
        )


@wp.kernel(enable_backward=False)
def locate_spans(
    # In
    threads: int,
    start: int,
    count: int,
    which: int,
    shapes: Shapes,
    thickness: wp.array[wp.float32],
    motions: Motions,
    law: Law,
    pace: Pace,
    surface: Surface,
    triangles: wp.array[wp.vec3i],
    d: wp.array[wp.vec4],
    # In and out
    carriers: Carriers,
    touches: Touches,
    spans: Spans,
    # Out
    changed: wp.array[wp.int32],
):
    k = wp.tid()
    while k < count and not is_done(which, spans):
        given = start + k
        locate_span(
            given,
            which,
            shapes,
            thickness,
            motions,
            law,
            pace,
            surface,
            triangles,
            d,
            carriers,
            touches,
            spans,
            changed,
        )
        k += threads


@wp.func
def locate_point(
    s: int,
    which: int,
    shapes: Shapes,
    thickness: wp.array[wp.float32],
    motions: Motions,
    law: Law,
    pace: Pace,
    surface: Surface,
    points: wp.array[wp.vec3i],
    d: wp.array[wp.vec4],
    carriers: Carriers,
    touches: Touches,
    spans: Spans,
    changed: wp.array[wp.int32],
):
    """The same at a body's places that nodes bear; nothing sinks in there."""
    if points[s][0] < 0 or is_held_at(s, surface, carriers):
        return
    world = surface.world[s]
    x = surface.x[s]
    e = motion_at(s, surface, carriers, d)
    way = wp.length(e)
    for o in range(touches.force.shape[0]):
        if which == MISSING and spans.listed[o, s] != 0:
            continue
        now = motions.now[world, o]
        later = motions.later[world, o]
        found = Found()
        found.is_at_end = which != FIRST and way <= NEAR_END * thickness[o]
        pose = now
        at = x
        if found.is_at_end:
            pose = later
            at = x + e
        found.moved = carried(now, later, x)
        far = 2.0 * way + wp.length(found.moved) + 2.0 * law.tolerance
        if wp.length_sq(touches.force[o, s]) > 0.0:
            # What a small gap has left of the last force still pushes.
            far += 4.0 * law.slack
        gap, n = distance_to(shapes, o, pose, at, far)
        found.is_near = gap <= far
        found.shares = wp.vec3(1.0, 0.0, 0.0)
        found.gap = gap
        found.normal = n
        found.opened = wp.dot(n, e - found.moved)
        found.allowed = 0.0
        found.friction = shapes.friction[o]
        take_span(o, s, which, found, e - found.moved, points[s], law, pace, surface, carriers, touches, spans, changed)


@wp.kernel(enable_backward=False)
def locate_points(
    # In
    threads: int,
    start: int,
    count: int,
    which: int,
    shapes: Shapes,
    thickness: wp.array[wp.float32],
    motions: Motions,
    law: Law,
    pace: Pace,
    surface: Surface,
    points: wp.array[wp.vec3i],
    d: wp.array[wp.vec4],
    # In and out
    carriers: Carriers,
    touches: Touches,
    spans: Spans,
    # Out
    changed: wp.array[wp.int32],
):
    k = wp.tid()
    while k < count and not is_done(which, spans):
        given = start + k
        locate_point(
            given, which, shapes, thickness, motions, law, pace, surface, points, d, carriers, touches, spans, changed
        )
        k += threads


@wp.kernel(enable_backward=False)
def empty_spans(start: int, which: int, carriers: Carriers, spans: Spans, own: Spans):
    """Begin to find spans of a body whose carriers begin at ``start``, of its first and its last items."""
    c = wp.tid()
    if which == FIRST or spans.due[0] != 0:
        carriers.crowd[start + c] = 0.0
        if c == 0:
            spans.count[0] = 0
            spans.length[0] = 0
            own.length[0] = 0
            spans.due[0] = 1


@wp.kernel(enable_backward=False)
def stiffen_spans(
    # In
    threads: int,
    surface: Surface,
    triangles: wp.array[wp.vec3i],
    carriers: Carriers,
    touches: Touches,
    # In and out
    spans: Spans,
):
    """Stiffness of spans: those that share nodes share it. A span whose corners are all held does nothing.

    Where most of them are, it is no stiffer than where half are: it would amplify rounding.
    """
    k = wp.tid()
    while k < spans.length[0]:
        o, t = span_at(k, spans)
        w = touches.shares[o, t]
        yielding = float(0.0)
        for corner in range(3):
            if w[corner] != 0.0:
                yielding += ease_at(triangles[t][corner], w[corner], surface, carriers)
        spans.stiffness[o, t] = 0.0
        if yielding > 0.0:
            loose = loose_at_triangle(w, triangles[t], surface.yielding, surface)
            spans.stiffness[o, t] = loose_part(loose) * spans.stiff / yielding
        k += threads
