"""Obstacles at the edges and the interiors of triangles in an implicit step: springs with multipliers; see ``joined``.

Where an obstacle is closer to a triangle than to its corners, p = max(l - k (g - t), 0) pushes the triangle's point: g
is its gap at the end of the step, t where it must come to, k a stiffness like that of the corners, l a multiplier.
Friction is the same across the normal, bounded by Coulomb's law. Each time the step has been solved for, points and
normals are found again, and forces become the multipliers; in between, spans that are missing are added.
"""

import warp as wp

from warp_corot.kernels.elements.elements import add_force, load_node, store_node
from warp_corot.kernels.implicit.conjugate_gradients import had_much_to_do
from warp_corot.kernels.implicit.line_search import TRIED
from warp_corot.kernels.stepping.pace import DT, Pace

from .active import NEAR_END
from .active import STIFF as STIFF_NODES
from .law import Law, held_back
from .motion import Motions, Surface
from .shapes import CAPSULE, GROUND, Shapes, carried, distance_to
from .touches import CORNER, SKEWERED, Touches, nearest
from .vertices import across

wp.set_module_options({"enable_backward": False})

#: Which spans are found: all at the beginning of the step, all again if that is due, or those that are missing.
FIRST, AGAIN, MISSING = (wp.constant(k) for k in range(3))
#: The stiffness of a span over that of its point.
STIFF = wp.constant(32.0)
#: An obstacle may sink into triangles by this fraction of half its thickness. Otherwise all triangles around a ball are
#: tangent to it, hold off the nodes, and make bodies much too stiff. So nodes less than 1.26 radii apart need no spans.
ALLOWED = wp.constant(0.2)
#: An obstacle must be closer to a triangle than to its corners by this many times the size of rounding errors.
CLOSER = wp.constant(4.0)


@wp.struct
class Spans:
    """Obstacles at triangles in an implicit step, [O, T], besides what ``Touches`` has."""

    listed: wp.array2d[wp.int32]  # whether it may push
    base: wp.array2d[wp.float32]  # how much it has opened where it is found [m]
    target: wp.array2d[wp.float32]  # the least gap at the end [m]
    stiffness: wp.array2d[wp.float32]  # k [N/m]
    multiplier: wp.array2d[wp.vec3]  # [N]
    most: wp.array2d[wp.float32]  # most of friction [N]
    derivative: wp.array2d[wp.mat33]  # [N/m]
    crowd: wp.array[wp.float32]  # [S] the sum of shares in spans that push
    count: wp.array[wp.int32]  # [1] how many are listed
    due: wp.array[wp.int32]  # [1] whether all are to be found again


@wp.func
def motion_of(w: wp.vec3, corners: wp.vec3i, surface: Surface, d: wp.array[wp.vec4]):
    """The motion of a triangle's point [m]."""
    e = wp.vec3()
    for k in range(3):
        e += w[k] * load_node(d, surface.node[corners[k]])
    return e


@wp.func
def least_gap(gap: float, law: Law, dt: float):
    """Where a gap must be at the end of the step; overlaps open slowly."""
    if gap > -law.tolerance:
        return 0.0
    return gap + wp.min(-law.settling * gap, law.recovery * dt)


@wp.struct
class Found:
    """Where an obstacle is close to a triangle."""

    is_near: wp.bool
    shares: wp.vec3
    gap: float
    normal: wp.vec3


@wp.func
def find_span(
    o: int,
    pose: wp.transform,
    a: wp.vec3,
    b: wp.vec3,
    c: wp.vec3,
    far: float,
    was: wp.vec3,
    side: wp.vec3,
    shapes: Shapes,
    law: Law,
):
    """The point of a triangle that is closest to an obstacle, if that is within reach and closer than the corners."""
    found = Found()
    found.is_near = False
    middle = (a + b + c) / 3.0
    size = wp.max(wp.length(a - middle), wp.max(wp.length(b - middle), wp.length(c - middle)))
    most = size + far
    distance, _away = distance_to(shapes, o, pose, middle, most)
    if distance > most:
        return found
    w, gap, n = nearest(shapes, o, pose, most, a, b, c)
    if wp.dot(was, was) > 0.0 and wp.dot(n, side) < 0.0 and shapes.kind[o] == CAPSULE:
        # The axis has passed through since the last time.
        n = -n
        gap = -2.0 * shapes.size[o][0] - gap
    if gap > far or wp.max(w) > CORNER:
        return found
    corners = wp.matrix_from_rows(a, b, c)
    # This loop is not unrolled, so that there is one distance function to compile.
    k = int(0)
    while k < 3:
        there, _normal = distance_to(shapes, o, pose, corners[k], most)
        if there <= gap + CLOSER * law.tolerance:
            return found
        k += 1
    found.is_near = True
    found.shares = w
    found.gap = gap
    found.normal = n
    return found


@wp.kernel(enable_backward=False)
def locate_spans(
    # In
    start: int,
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
    touches: Touches,
    spans: Spans,
    # Out
    changed: wp.array[wp.int32],
):
    """Find spans of a body's triangles at the beginning of the step, or after motions d; forces become multipliers.

    If a motion is fast, its path may lead through the obstacle, so the span stays where the step begins.
    """
    t = start + wp.tid()
    corners = triangles[t]
    if corners[0] < 0 or (which == AGAIN and spans.due[0] == 0):
        return
    world = surface.world[corners[0]]
    way = float(0.0)
    for k in range(3):
        way = wp.max(way, wp.length(load_node(d, surface.node[corners[k]])))
    x = wp.matrix_from_rows(surface.x[corners[0]], surface.x[corners[1]], surface.x[corners[2]])
    for o in range(touches.force.shape[0]):
        was_listed = spans.listed[o, t] != 0 and which != FIRST
        if shapes.kind[o] == GROUND or (which == MISSING and was_listed):
            continue
        was = touches.force[o, t]
        now = motions.now[world, o]
        later = motions.later[world, o]
        at = wp.matrix_from_rows(x[0], x[1], x[2])
        pose = now
        is_at_end = which != FIRST and way <= NEAR_END * thickness[o]
        if is_at_end:
            pose = later
            for k in range(3):
                at[k] = x[k] + load_node(d, surface.node[corners[k]])
        middle = (x[0] + x[1] + x[2]) / 3.0
        far = 2.0 * way + wp.length(carried(now, later, middle)) + 2.0 * law.tolerance
        found = find_span(o, pose, at[0], at[1], at[2], far, was, touches.normal[o, t], shapes, law)
        spans.listed[o, t] = 0
        touches.force[o, t] = wp.vec3()
        touches.acts[o, t] = 0
        if not found.is_near:
            continue
        w = found.shares
        n = found.normal
        moved = carried(now, later, w * x)
        opened = wp.dot(n, motion_of(w, corners, surface, d) - moved)
        base = wp.where(is_at_end, opened, 0.0)
        allowed = ALLOWED * thickness[o]
        target = wp.where(was_listed, spans.target[o, t], -allowed)
        if which == FIRST:
            target = least_gap(found.gap + allowed, law, float(pace.seconds[DT])) - allowed
        is_passed = found.gap + opened - base < target - law.tolerance
        if which == MISSING:
            if not is_passed:
                continue
            changed[0] = 1
        friction = wp.where(found.gap < -(SKEWERED + ALLOWED) * thickness[o], 0.0, shapes.friction[o])
        push = wp.max(wp.dot(was, n), 0.0)
        touches.shares[o, t] = w
        touches.normal[o, t] = n
        touches.gap[o, t] = found.gap
        touches.friction[o, t] = friction
        touches.moved[o, t] = moved
        spans.listed[o, t] = 1
        spans.base[o, t] = base
        spans.target[o, t] = target
        spans.multiplier[o, t] = push * n + held_back(across(was, n), push, friction)
        wp.atomic_add(spans.count, 0, 1)
        if push > 0.0 or is_passed:
            for k in range(3):
                wp.atomic_add(spans.crowd, corners[k], w[k])


@wp.kernel(enable_backward=False)
def empty_spans(start: int, which: int, spans: Spans):
    """Begin to find spans."""
    s = wp.tid()
    if which == FIRST or spans.due[0] != 0:
        spans.crowd[start + s] = 0.0
        if s == 0:
            spans.count[0] = 0


@wp.kernel(enable_backward=False)
def stiffen_spans(
    # In
    start: int,
    surface: Surface,
    node_stiffness: wp.array[wp.float32],
    triangles: wp.array[wp.vec3i],
    touches: Touches,
    # In and out
    spans: Spans,
):
    """Stiffness of spans: those that share nodes share it. A span whose corners are all held does nothing."""
    t = start + wp.tid()
    for o in range(touches.force.shape[0]):
        if spans.listed[o, t] != 0:
            w = touches.shares[o, t]
            yielding = float(0.0)
            for k in range(3):
                s = triangles[t][k]
                if surface.yielding[s] > 0.0:
                    stiffness = wp.max(node_stiffness[s] / STIFF_NODES, 1.0e-30)
                    yielding += w[k] * wp.max(spans.crowd[s], w[k]) / stiffness
            spans.stiffness[o, t] = 0.0
            if yielding > 0.0:
                spans.stiffness[o, t] = STIFF / yielding


@wp.kernel(enable_backward=False)
def judge_spans(
    # In
    scalars: wp.array2d[wp.float64],
    near: wp.float64,
    count: wp.array[wp.int32],
    changed: wp.array[wp.int32],
    rounds: wp.array[wp.int32],
    most: int,
    # In and out
    due: wp.array[wp.int32],
    going: wp.array[wp.int32],
):
    """Find all spans again before the next solve if the last one had little to do. The step is solved for only if spans
    had just been found again, or there are none.
    """
    if going[0] == 0 and due[0] == 0 and count[0] > 0 and rounds[0] < most:
        going[0] = 1
    is_near = changed[0] == 0
    for world in range(scalars.shape[0]):
        is_near = is_near and not had_much_to_do(scalars, world, near)
    due[0] = wp.where(is_near, 1, 0)


@wp.struct
class SpanState:
    """The force of a span on the triangle [N], the derivative of that [N/m], and its push along the normal [N]."""

    force: wp.vec3
    derivative: wp.mat33
    push: float


@wp.func
def span_state(o: int, t: int, e: wp.vec3, most: float, touches: Touches, spans: Spans):
    """A span after a motion e relative to the obstacle, with friction of at most ``most``."""
    made = SpanState()
    k = spans.stiffness[o, t]
    n = touches.normal[o, t]
    first = spans.multiplier[o, t]
    gap = touches.gap[o, t] + wp.dot(n, e) - spans.base[o, t]
    whole = wp.outer(n, n)
    made.push = wp.max(wp.dot(first, n) - k * (gap - spans.target[o, t]), 0.0)
    if made.push > 0.0:
        made.force = made.push * n
        made.derivative = k * whole
    if most > 0.0:
        sideways = across(first - k * e, n)
        size = wp.length(sideways)
        plane = wp.identity(3, dtype=wp.float32) - whole
        share = float(1.0)
        if size > most:
            # What slides has no stiffness in the direction in which it slides.
            share = most / size
            plane -= wp.outer(sideways, sideways) / (size * size)
        made.force += share * sideways
        made.derivative += (k * share) * plane
    return made


@wp.kernel(enable_backward=False)
def update_spans(
    # In
    start: int,
    surface: Surface,
    triangles: wp.array[wp.vec3i],
    d: wp.array[wp.vec4],
    # In and out
    touches: Touches,
    spans: Spans,
):
    """Forces and derivatives after motions d, with the friction that the push there allows."""
    t = start + wp.tid()
    for o in range(touches.force.shape[0]):
        touches.acts[o, t] = 0
        touches.force[o, t] = wp.vec3()
        spans.most[o, t] = 0.0
        if spans.listed[o, t] != 0:
            e = motion_of(touches.shares[o, t], triangles[t], surface, d) - touches.moved[o, t]
            push = span_state(o, t, e, 0.0, touches, spans).push
            most = touches.friction[o, t] * push
            spans.most[o, t] = most
            if push > 0.0:
                made = span_state(o, t, e, most, touches, spans)
                touches.acts[o, t] = 1
                touches.force[o, t] = made.force
                spans.derivative[o, t] = made.derivative


@wp.func
def add_to_corners(w: wp.vec3, force: wp.vec3, corners: wp.vec3i, surface: Surface, y: wp.array[wp.vec4]):
    for k in range(3):
        s = corners[k]
        if surface.yielding[s] > 0.0:
            add_force(y, surface.node[s], w[k] * force)


@wp.kernel(enable_backward=False)
def add_span_forces(
    start: int, surface: Surface, triangles: wp.array[wp.vec3i], touches: Touches, y: wp.array[wp.vec4]
):
    """Add the forces of spans on nodes that are free [N]."""
    t = start + wp.tid()
    for o in range(touches.acts.shape[0]):
        if touches.acts[o, t] != 0:
            add_to_corners(touches.shares[o, t], touches.force[o, t], triangles[t], surface, y)


@wp.kernel(enable_backward=False)
def add_span_products(
    # In
    start: int,
    surface: Surface,
    triangles: wp.array[wp.vec3i],
    touches: Touches,
    spans: Spans,
    x: wp.array[wp.vec4],
    # Out
    y: wp.array[wp.vec4],
):
    """Add the derivative times x."""
    t = start + wp.tid()
    for o in range(touches.acts.shape[0]):
        if touches.acts[o, t] != 0:
            w = touches.shares[o, t]
            product = spans.derivative[o, t] * motion_of(w, triangles[t], surface, x)
            add_to_corners(w, product, triangles[t], surface, y)


@wp.kernel(enable_backward=False)
def add_span_slopes(
    # In
    start: int,
    only_world: int,
    surface: Surface,
    triangles: wp.array[wp.vec3i],
    touches: Touches,
    spans: Spans,
    d: wp.array[wp.vec4],
    change: wp.array[wp.vec4],
    search: wp.array2d[wp.float64],
    # Out
    slopes: wp.array[wp.float64],
):
    """Add the power of spans along a change of motions, at the share that is tried."""
    t = start + wp.tid()
    corners = triangles[t]
    if corners[0] < 0:
        return
    world = wp.where(only_world != 0, 0, surface.world[corners[0]])
    for o in range(touches.acts.shape[0]):
        if spans.listed[o, t] != 0:
            w = touches.shares[o, t]
            along = motion_of(w, corners, surface, change)
            e = motion_of(w, corners, surface, d) + float(search[world, TRIED]) * along - touches.moved[o, t]
            made = span_state(o, t, e, spans.most[o, t], touches, spans)
            power = wp.dot(wp.vec3d(made.force), wp.vec3d(along))
            if power != wp.float64(0.0):
                wp.atomic_add(slopes, world, power)


@wp.kernel(enable_backward=False)
def gather_spans(
    # In
    start: int,
    corner_starts: wp.array[wp.int32],
    corners: wp.array[wp.int32],
    touches: Touches,
    # Out
    surface: Surface,
    contact_forces: wp.array[wp.vec4],
):
    """Add the shares of spans' forces at a body's surface nodes to those of contact [N]."""
    s = start + wp.tid()
    i = surface.node[s]
    if i < 0:
        return
    total = surface.f[s]
    for k in range(corner_starts[s], corner_starts[s + 1]):
        t = corners[k] / 3
        for o in range(touches.acts.shape[0]):
            if touches.acts[o, t] != 0:
                total += touches.shares[o, t][corners[k] % 3] * touches.force[o, t]
    surface.f[s] = total
    store_node(contact_forces, i, total)
