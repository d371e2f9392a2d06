"""Obstacles at triangles, and at places that nodes bear, in an implicit step: springs with multipliers.

A span is an obstacle at a point of an item: one that is closer to a triangle than to its corners, or to a place between
nodes, which counts as a triangle whose corners are all there. See ``springs`` for its force, with a stiffness like that
of the corners. Each time the step has been solved for, points and normals are found again, and forces become the
multipliers; before the step ends, spans that are missing are added.
"""

import warp as wp

from warp_corot.kernels.implicit.assembled import Couplings, begin_coupling, end_coupling, root_columns
from warp_corot.kernels.implicit.line_search import TRIED

from .carriers import Carriers, couple_at, motion_at, push_at
from .motion import Surface
from .nearest_span import Rolling, share_of_moment, tilted
from .springs import bound_of, spring_state
from .touches import Touches

wp.set_module_options({"enable_backward": False})


@wp.struct
class Spans:
    """Obstacles at items in an implicit step, [O, T], besides what ``Touches`` has."""

    listed: wp.array2d[wp.int32]  # whether it may push
    base: wp.array2d[wp.float32]  # how much it has opened where it is found [m]
    target: wp.array2d[wp.float32]  # the least gap at the end [m]
    stiffness: wp.array2d[wp.float32]  # k [N/m]
    multiplier: wp.array2d[wp.vec3]  # [N]
    most: wp.array2d[wp.float32]  # most of friction [N]
    derivative: wp.array2d[wp.mat33]  # [N/m]
    rolling: wp.array2d[Rolling]  # how the closest point moves
    bend: wp.array2d[wp.float32]  # stiffness against tilts [N m]
    tilt: wp.array2d[wp.vec3]  # where it is found
    moment: wp.array2d[wp.vec3]  # against tilting [N m]
    count: wp.array[wp.int32]  # [1] how many are listed, of all items
    list: wp.array[wp.int32]  # [O * T] those of these items, as o * T + t
    length: wp.array[wp.int32]  # [1] how many
    due: wp.array[wp.int32]  # [1] whether all are to be found again
    goes: wp.array[wp.int32]  # [1] whether another solve follows anyway
    solves: wp.array[wp.int32]  # [1] how many linear solves the step has had so far
    stiff: float  # the stiffness of a span over that of its point
    are_borne: int  # whether nodes bear the corners


@wp.func
def list_span(o: int, t: int, spans: Spans):
    spans.list[wp.atomic_add(spans.length, 0, 1)] = o * spans.listed.shape[1] + t
    wp.atomic_add(spans.count, 0, 1)


@wp.func
def span_at(k: int, spans: Spans):
    """The k-th listed span: its obstacle and its item."""
    items = spans.listed.shape[1]
    return spans.list[k] / items, spans.list[k] % items


@wp.func
def motion_of(w: wp.vec3, corners: wp.vec3i, surface: Surface, carriers: Carriers, d: wp.array[wp.vec4]):
    """The motion of an item's point [m]."""
    e = wp.vec3()
    for k in range(3):
        if w[k] != 0.0:
            e += w[k] * motion_at(corners[k], surface, carriers, d)
    return e


@wp.func
def tilt_of(
    o: int,
    t: int,
    corners: wp.vec3i,
    surface: Surface,
    carriers: Carriers,
    d: wp.array[wp.vec4],
    touches: Touches,
    spans: Spans,
):
    """The tilt of a triangle after motions d."""
    e = wp.mat33()
    for k in range(3):
        e[k] = motion_at(corners[k], surface, carriers, d)
    return tilted(spans.rolling[o, t], touches.shares[o, t], touches.normal[o, t], e)


@wp.func
def push_corners(
    o: int,
    t: int,
    m: wp.vec3,
    corners: wp.vec3i,
    surface: Surface,
    carriers: Carriers,
    touches: Touches,
    spans: Spans,
    y: wp.array[wp.vec4],
):
    """Add the forces of a moment against tilting."""
    for k in range(3):
        force = share_of_moment(k, m, spans.rolling[o, t], touches.shares[o, t], touches.normal[o, t])
        push_at(corners[k], force, surface, carriers, y)


@wp.kernel(enable_backward=False)
def judge_spans(
    # In
    locates: wp.array[wp.int32],
    changed: wp.array[wp.int32],
    count: wp.array[wp.int32],
    rounds: wp.array[wp.int32],
    most: int,
    # In and out
    due: wp.array[wp.int32],
    solves: wp.array[wp.int32],
    going: wp.array[wp.int32],
):
    """Find all spans again before the next solve if contacts are to be located. The step is solved for only if spans
    had just been found again, or there are none.
    """
    solves[0] = rounds[0]
    if changed[0] != 0 or (due[0] == 0 and count[0] > 0):
        going[0] = 1
    due[0] = locates[0]
    if going[0] == 0 or rounds[0] >= most:
        solves[0] = 0


@wp.func
def span_state(o: int, t: int, e: wp.vec3, most: float, touches: Touches, spans: Spans):
    """A span after a motion e relative to the obstacle, with friction of at most ``most``; its force is that on the
    triangle."""
    n = touches.normal[o, t]
    short = touches.gap[o, t] + wp.dot(n, e) - spans.base[o, t] - spans.target[o, t]
    return spring_state(short, e, spans.stiffness[o, t], spans.multiplier[o, t], n, most)


@wp.kernel(enable_backward=False)
def update_spans(
    # In
    threads: int,
    is_solved: int,
    surface: Surface,
    triangles: wp.array[wp.vec3i],
    carriers: Carriers,
    d: wp.array[wp.vec4],
    # In and out
    touches: Touches,
    spans: Spans,
):
    """Forces and derivatives after motions d, with the friction that the push there allows.

    ``is_solved`` says that a solve has ended with d, which is when bounds of friction change.
    """
    k = wp.tid()
    while k < spans.length[0]:
        o, t = span_at(k, spans)
        touches.acts[o, t] = 0
        touches.force[o, t] = wp.vec3()
        if spans.bend[o, t] > 0.0:
            tilt = tilt_of(o, t, triangles[t], surface, carriers, d, touches, spans)
            spans.moment[o, t] = spans.bend[o, t] * (spans.tilt[o, t] - tilt)
        e = motion_of(touches.shares[o, t], triangles[t], surface, carriers, d) - touches.moved[o, t]
        push = span_state(o, t, e, 0.0, touches, spans).push
        most = bound_of(spans.most[o, t], push, touches.friction[o, t], is_solved != 0, spans.solves[0])
        spans.most[o, t] = most
        if push > 0.0:
            made = span_state(o, t, e, most, touches, spans)
            touches.acts[o, t] = 1
            touches.force[o, t] = made.force
            spans.derivative[o, t] = made.derivative
        k += threads


@wp.func
def add_to_corners(
    w: wp.vec3, force: wp.vec3, corners: wp.vec3i, surface: Surface, carriers: Carriers, y: wp.array[wp.vec4]
):
    for k in range(3):
        if w[k] != 0.0:
            push_at(corners[k], w[k] * force, surface, carriers, y)


@wp.kernel(enable_backward=False)
def add_span_forces(
    threads: int,
    surface: Surface,
    triangles: wp.array[wp.vec3i],
    carriers: Carriers,
    touches: Touches,
    spans: Spans,
    y: wp.array[wp.vec4],
):
    """Add the forces of spans on nodes that are free [N]."""
    k = wp.tid()
    while k < spans.length[0]:
        o, t = span_at(k, spans)
        if spans.bend[o, t] > 0.0:
            push_corners(o, t, spans.moment[o, t], triangles[t], surface, carriers, touches, spans, y)
        if touches.acts[o, t] != 0:
            add_to_corners(touches.shares[o, t], touches.force[o, t], triangles[t], surface, carriers, y)
        k += threads


@wp.kernel(enable_backward=False)
def add_span_products(
    # In
    threads: int,
    surface: Surface,
    triangles: wp.array[wp.vec3i],
    carriers: Carriers,
    touches: Touches,
    spans: Spans,
    x: wp.array[wp.vec4],
    # Out
    y: wp.array[wp.vec4],
):
    """Add the derivative times x."""
    k = wp.tid()
    while k < spans.length[0]:
        o, t = span_at(k, spans)
        if spans.bend[o, t] > 0.0:
            m = spans.bend[o, t] * tilt_of(o, t, triangles[t], surface, carriers, x, touches, spans)
            push_corners(o, t, m, triangles[t], surface, carriers, touches, spans, y)
        if touches.acts[o, t] != 0:
            w = touches.shares[o, t]
            product = spans.derivative[o, t] * motion_of(w, triangles[t], surface, carriers, x)
            add_to_corners(w, product, triangles[t], surface, carriers, y)
        k += threads


@wp.func
def couple_corners(parts: wp.mat33, corners: wp.vec3i, surface: Surface, carriers: Carriers, couplings: Couplings):
    """Add c c^T to a matrix, with the rows of ``parts`` as c at an item's corners."""
    c = begin_coupling(couplings)
    if c < 0:
        return
    places = int(0)
    for k in range(3):
        if wp.length_sq(parts[k]) > 0.0:
            places = couple_at(c, places, corners[k], parts[k], surface, carriers, couplings)
    end_coupling(c, places, couplings)


@wp.kernel(enable_backward=False)
def couple_spans(
    # In
    threads: int,
    surface: Surface,
    triangles: wp.array[wp.vec3i],
    carriers: Carriers,
    touches: Touches,
    spans: Spans,
    # In and out
    couplings: Couplings,
):
    """Add the derivative to an assembled matrix."""
    i = wp.tid()
    while i < spans.length[0]:
        o, t = span_at(i, spans)
        w = touches.shares[o, t]
        if spans.bend[o, t] > 0.0:
            root = wp.sqrt(spans.bend[o, t])
            rolling = spans.rolling[o, t]
            is_along = wp.length_sq(rolling.along) > 0.0
            for axis in range(wp.where(is_along, 1, 3)):
                m = wp.vec3()
                m[axis] = root
                if is_along:
                    m = root * rolling.along
                parts = wp.mat33()
                for k in range(3):
                    parts[k] = share_of_moment(k, m, rolling, w, touches.normal[o, t])
                couple_corners(parts, triangles[t], surface, carriers, couplings)
        if touches.acts[o, t] != 0:
            roots = root_columns(spans.derivative[o, t])
            for axis in range(3):
                g = wp.vec3(roots[0, axis], roots[1, axis], roots[2, axis])
                if wp.length_sq(g) > 0.0:
                    couple_corners(wp.outer(w, g), triangles[t], surface, carriers, couplings)
        i += threads


@wp.kernel(enable_backward=False)
def add_span_slopes(
    # In
    threads: int,
    only_world: int,
    surface: Surface,
    triangles: wp.array[wp.vec3i],
    carriers: Carriers,
    touches: Touches,
    spans: Spans,
    d: wp.array[wp.vec4],
    change: wp.array[wp.vec4],
    search: wp.array2d[wp.float64],
    # Out
    slopes: wp.array[wp.float64],
):
    """Add the power of spans along a change of motions, at the share that is tried."""
    k = wp.tid()
    while k < spans.length[0]:
        o, t = span_at(k, spans)
        corners = triangles[t]
        world = wp.where(only_world != 0, 0, surface.world[corners[0]])
        w = touches.shares[o, t]
        along = motion_of(w, corners, surface, carriers, change)
        e = motion_of(w, corners, surface, carriers, d) + float(search[world, TRIED]) * along - touches.moved[o, t]
        made = span_state(o, t, e, spans.most[o, t], touches, spans)
        power = wp.dot(wp.vec3d(made.force), wp.vec3d(along))
        if spans.bend[o, t] > 0.0:
            tilts = tilt_of(o, t, corners, surface, carriers, change, touches, spans)
            tilt = tilt_of(o, t, corners, surface, carriers, d, touches, spans)
            tilt += float(search[world, TRIED]) * tilts - spans.tilt[o, t]
            power -= wp.float64(spans.bend[o, t]) * wp.dot(wp.vec3d(tilt), wp.vec3d(tilts))
        if power != wp.float64(0.0):
            wp.atomic_add(slopes, world, power)
        k += threads


@wp.kernel(enable_backward=False)
def gather_spans(
    # In
    start: int,
    corner_starts: wp.array[wp.int32],
    corners: wp.array[wp.int32],
    touches: Touches,
    # Out
    surface: Surface,
):
    """Add the shares of the forces at triangles to those of contact at a body's places [N]."""
    s = start + wp.tid()
    if surface.node[s] < 0:
        return
    total = surface.f[s]
    for k in range(corner_starts[s], corner_starts[s + 1]):
        t = corners[k] / 3
        for o in range(touches.acts.shape[0]):
            if touches.acts[o, t] != 0:
                total += touches.shares[o, t][corners[k] % 3] * touches.force[o, t]
    surface.f[s] = total


@wp.kernel(enable_backward=False)
def end_points(start: int, carriers: Carriers, d: wp.array[wp.vec4], touches: Touches, surface: Surface):
    """Write the motions of a body's places that nodes bear, and the forces on them."""
    s = start + wp.tid()
    if surface.node[s] < 0:
        return
    total = wp.vec3()
    for o in range(touches.force.shape[0]):
        total += touches.force[o, s]
    surface.d[s] = motion_at(s, surface, carriers, d)
    surface.f[s] = total


@wp.kernel(enable_backward=False)
def find_bearers(start: int, surface: Surface, bearers: Surface, nodes: wp.array[wp.vec4i], weights: wp.array[wp.vec4]):
    """Find the nodes that bear each place of a body, and their weights; -1 where there is none."""
    k = wp.tid()
    s = start + k
    found = wp.vec4i(-1, -1, -1, -1)
    if surface.node[s] >= 0:
        b = surface.bearing.bearers[s]
        for m in range(4):
            if surface.bearing.weights[s][m] != 0.0:
                found[m] = bearers.node[b[m]]
        weights[k] = surface.bearing.weights[s]
    nodes[k] = found


@wp.kernel(enable_backward=False)
def gather_stiffness(
    # In
    start: int,
    corner_starts: wp.array[wp.int32],
    corners: wp.array[wp.int32],
    touches: Touches,
    spans: Spans,
    have_triangles: int,
    own_touches: Touches,
    own_spans: Spans,
    # Out
    stiffness: wp.array[wp.mat33],
):
    """The stiffness of spans at a body's places: their own, and the shares of those at triangles."""
    k = wp.tid()
    s = start + k
    total = wp.mat33()
    for o in range(own_touches.force.shape[0]):
        if own_touches.acts[o, s] != 0:
            total += own_spans.derivative[o, s]
    if have_triangles != 0:
        for m in range(corner_starts[s], corner_starts[s + 1]):
            t = corners[m] / 3
            for o in range(touches.acts.shape[0]):
                if touches.acts[o, t] != 0:
                    total += touches.shares[o, t][corners[m] % 3] * spans.derivative[o, t]
                    n = touches.normal[o, t]
                    if spans.bend[o, t] > 0.0:
                        slope = spans.rolling[o, t].slopes[corners[m] % 3]
                        total += (spans.bend[o, t] * wp.length_sq(slope)) * wp.outer(n, n)
    stiffness[k] = total
