"""Where rows are in an implicit step: obstacles at places and at triangles, and pairs of soft surfaces; and what meets
or parts before a step; see ``implicit_rows``."""

import warp as wp

from warp_corot.kernels.modules import WITHOUT_COPIES, unique_kernel
from warp_corot.kernels.stepping.pace import DT, Pace

from .bearing import Carriers, crowd_at, gone_at, is_borne, is_held_at, left_at, motion_at
from .explicit_rows import CORNER, SKEWERED, Rigid, near_triangle
from .implicit_rows import AGAIN, FIRST, MISSING, REPEATED, ImplicitRows, corner_weights, list_row, opened_by
from .law import QUARTERED, Law, across, held_back, kept_gap, least_gap
from .locate import locate_facing
from .motion import Surface
from .rows import Rows, row_count
from .shapes import CAPSULE, GROUND, SPHERE, Rolling, Shapes, carried, distance_to, rolling_of, tilted
from .watch import Watch, wake

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
#: A pair that has begun to push so often in a step is no longer located again.
OFTEN = wp.constant(3)
#: From this many solves in a step on, a gap that is found within this part of the law's tolerance of where motions put
#: it stays there: solves that need so many are kept from their end by rounding.
LATE, ROUNDED = wp.constant(12), wp.constant(0.125)
#: The most searches in a step after the first one.
SEARCHES = wp.constant(8)
#: What is left in each solve of how far a place has strayed before.
FADING = wp.constant(0.7)


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
def is_as_asked(r: int, along: float, law: Law, rows: ImplicitRows):
    """Whether a row that was listed has its gap where that must come to, after its sides have gone by ``along`` [m]."""
    return wp.abs(rows.gap[r] + along - rows.opened[r] - rows.target[r]) <= law.slack


@wp.func
def list_located(r: int, was: wp.vec3, is_passed: wp.bool, rows: ImplicitRows):
    """List a row that has been located; the force ``was`` becomes its multiplier. It counts among those that share
    nodes if it pushes, or if its gap is less than that must come to."""
    n = rows.normal[r]
    push = wp.max(wp.dot(was, n), 0.0)
    rows.multiplier[r] = push * n + held_back(across(was, n), push, rows.friction[r])
    list_row(r, rows)
    if push > 0.0 or is_passed:
        k = int(0)
        while k < 4:
            if rows.weights[r][k] != 0.0:
                crowd_at(int(r >= rows.first_pair), rows.places[r][k], rows.weights[r][k], rows.carriers)
            k += 1
    return push


@wp.func
def take_row(
    r: int, which: int, found: Found, e: wp.vec3, places: wp.vec4i, law: Law, dt: float, rows: ImplicitRows,
    changed: wp.array[wp.int32],
):  # fmt: skip
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
    if was_listed and is_as_asked(r, wp.dot(rows.normal[r], e), law, rows):
        was = rows.multiplier[r]
    if was_listed and r < rows.first_triangle and found.is_at_end and rows.solves[0] >= LATE:
        # Positions are rounded, and stiff rows make forces of that: what is known from motions is more exact.
        known = rows.gap[r] + wp.dot(rows.normal[r], e) - rows.opened[r]
        if wp.abs(found.gap - known) <= ROUNDED * law.tolerance:
            found.gap = known
    opened = wp.where(found.is_at_end, found.opened, 0.0)
    target = rows.target[r]
    if not was_listed:
        # Where held nodes bear most of the point, it may stay as deep as the obstacle's motion leads.
        there = found.gap - opened - wp.dot(n, found.moved)
        allowed = found.allowed + left_at(places, found.weights, there, n, rows.carriers.surface)
        target = -allowed
        if which == FIRST:
            target = kept_gap(found.gap + allowed, pushed, law, dt) - allowed
    is_passed = found.gap + found.opened - opened < target - law.tolerance
    if which == MISSING:
        if not is_passed:
            return
        changed[0] = 1
    rows.places[r] = places
    rows.weights[r] = found.weights
    rows.normal[r] = n
    rows.gap[r] = found.gap
    rows.friction[r] = found.friction
    rows.moved[r] = found.moved
    rows.opened[r] = opened
    rows.target[r] = target
    push = list_located(r, was, is_passed, rows)
    rows.force[r] = rows.multiplier[r]
    if r >= rows.first_triangle:
        t = r - rows.first_triangle
        rows.rolling[t] = found.rolling
        rows.tilt[t] = found.tilt
        rows.moment[t] = wp.vec3()
        rows.bend[t] = push * found.rolling.distance


@wp.func
def locate_at(
    k: int, which: int, rigid: Rigid, dt: float, d: wp.array[wp.vec4], rows: ImplicitRows, changed: wp.array[wp.int32]
):
    """Find obstacles at a place, or at a triangle, whose numbers follow, at the beginning of the step or after motions
    d; forces become multipliers.

    If a motion is fast, its path may lead through the obstacle, so the row stays where the step begins.
    """
    shapes = rigid.shapes
    law = rigid.law
    surface = rows.carriers.surface
    is_place = k < surface.node.shape[0]
    first = int(k)
    stride = surface.node.shape[0]
    corners = wp.vec3i(k, -1, -1)
    if not is_place:
        first = rows.first_triangle + k - stride
        corners = surface.triangles[k - stride]
        stride = surface.triangles.shape[0]
    if which == FIRST:
        for o in range(shapes.kind.shape[0]):
            rows.listed[first + o * stride] = 0
    if corners[0] < 0 or (is_place and (surface.node[k] < 0 or is_held_at(k, rows.carriers))):
        return
    world = surface.world[corners[0]]
    way = float(0.0)
    x = wp.mat33()
    e = wp.mat33()
    for m in range(3):
        if corners[m] >= 0:
            e[m] = motion_at(corners[m], rows.carriers, d)
            x[m] = surface.x[corners[m]]
            way = wp.max(way, wp.length(e[m]))
    middle = wp.where(is_place, x[0], (x[0] + x[1] + x[2]) / 3.0)
    longest = wp.max(wp.length(x[0] - x[1]), wp.max(wp.length(x[1] - x[2]), wp.length(x[2] - x[0])))
    for o in range(shapes.kind.shape[0]):
        r = first + o * stride
        if which == FIRST:
            rows.force[r] = rigid.rows.force[r]
            rows.normal[r] = rigid.rows.normal[r]
            rows.weights[r] = rigid.rows.weights[r]
        if (not is_place and shapes.kind[o] == GROUND) or (which == MISSING and rows.listed[r] != 0):
            continue
        now = rigid.motions.now[world, o]
        later = rigid.motions.later[world, o]
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
        take_row(r, which, found, slip, places, law, dt, rows, changed)


@unique_kernel(cpu_compiler_flags=WITHOUT_COPIES)
def locate_obstacles(
    # In
    threads: int,
    which: int,
    rigid: Rigid,
    pace: Pace,
    d: wp.array[wp.vec4],
    going: wp.array[wp.int32],
    # In and out
    rows: ImplicitRows,
    # Out
    changed: wp.array[wp.int32],
):
    """Find obstacles at all places, and at triangles if there are rows for them; missing ones only if no solve is
    ``going`` to follow, and none if contacts are not located again before the next solve."""
    k = wp.tid()
    count = rows.carriers.surface.node.shape[0]
    if rows.first_pair > rows.first_triangle:
        count += rows.carriers.surface.triangles.shape[0]
    if (which == AGAIN and rows.due[0] == 0) or (which == MISSING and going[0] != 0):
        count = 0
    while k < count:
        locate_at(k, which, rigid, float(pace.seconds[DT]), d, rows, changed)
        k += threads


# --- pairs -----------------------------------------------------------------------------------------------------------


@unique_kernel()
def find_strays(
    # In
    d: wp.array[wp.vec4],
    carriers: Carriers,
    searches: wp.array[wp.int32],
    rounds: wp.array[wp.int32],
    most: int,
    # Out
    watch: Watch,
    again: wp.array[wp.int32],
):
    """Ask for another search along the way of motions d if places have strayed beyond their reach, where pairs may be
    missing, unless the step has had its ``most`` solves."""
    s = wp.tid()
    surface = carriers.surface
    if surface.node[s] < 0:
        return
    motion = motion_at(s, carriers, d) + gone_at(s, carriers)
    surface.d[s] = motion
    way = surface.x[s] + motion - watch.places[s]
    far = wp.length(way - watch.ahead[s] - watch.drift[surface.world[s]])
    watch.strayed[s] = wp.max(far, FADING * watch.strayed[s])
    if far > watch.reach[s]:
        if searches[0] < SEARCHES and rounds[0] < most:
            again[0] = 1
            wake(watch)
        else:
            wp.atomic_add(watch.missed, 0, 1)


@wp.func
def locate(
    k: int, which: int, law: Law, dt: float, d: wp.array[wp.vec4], located: Surface, pairs: Rows, rows: ImplicitRows
):
    r = rows.first_pair + k
    was = rows.force[r]
    was_listed = rows.listed[r] != 0
    if which != AGAIN:
        was = pairs.force[k]
        rows.target[r] = 0.0
    pushed = wp.dot(was, was) > 0.0
    if which == FIRST:
        pairs.acts[k] = int(pushed)
    elif which == REPEATED:
        pushed = pairs.acts[k] != 0
    elif pushed and was_listed:
        along = wp.dot(rows.normal[r], opened_by(r, d, rows) - rows.moved[r])
        if is_as_asked(r, along, law, rows):
            was = rows.multiplier[r]
    stays = bool(False)
    if which != AGAIN:
        rows.pushed[k] = 0
        rows.begun[k] = 0
    else:
        if pushed and rows.pushed[k] == 0:
            rows.begun[k] = rows.begun[k] + 1
        rows.pushed[k] = int(pushed)
        stays = rows.begun[k] >= OFTEN
    is_near = stays or locate_facing(k, located, pairs)
    rows.listed[r] = 0
    # For pairs that are located again before the first solve.
    rows.force[r] = wp.where(which != AGAIN, was, wp.vec3())
    p = pairs.places[k]
    w = pairs.weights[k]
    is_free = bool(False)
    given = wp.vec3()
    if is_near:
        m = int(0)
        while m < 4:
            is_free = is_free or not is_held_at(p[m], rows.carriers)
            given += w[m] * gone_at(p[m], rows.carriers)
            m += 1
    if not is_free:
        rows.most[r] = 0.0
        return
    n = pairs.normal[k]
    rows.places[r] = p
    rows.weights[r] = w
    rows.normal[r] = n
    rows.gap[r] = pairs.gap[k]
    rows.friction[r] = pairs.friction[k]
    rows.moved[r] = -given
    slip = opened_by(r, d, rows) + given
    if not stays:
        allowed = left_at(p, w, rows.gap[r], n, located)
        if which != AGAIN:
            rows.opened[r] = wp.dot(n, given)
            rows.target[r] = kept_gap(rows.gap[r] + allowed, pushed, law, dt) - allowed
        else:
            rows.opened[r] = wp.dot(n, slip)
            # What began deeper than the two have gone sideways in the step began as an overlap.
            began = rows.gap[r] - rows.opened[r] + wp.length(across(slip, n)) + allowed
            rows.target[r] = wp.min(rows.target[r], least_gap(began, law, dt) - allowed)
    list_located(r, was, rows.gap[r] + wp.dot(n, slip) - rows.opened[r] < rows.target[r], rows)


@unique_kernel(cpu_compiler_flags=WITHOUT_COPIES)
def locate_pairs(
    # In
    threads: int,
    which: int,
    law: Law,
    pace: Pace,
    d: wp.array[wp.vec4],
    located: Surface,
    # Out
    pairs: Rows,
    rows: ImplicitRows,
):
    """Where each pair is closest; its forces become its multipliers."""
    k = wp.tid()
    dt = float(pace.seconds[DT])
    while k < row_count(pairs) and (which == FIRST or rows.locates[0] != 0):
        locate(k, which, law, dt, d, located, pairs, rows)
        k += threads


# --- what meets before a step ----------------------------------------------------------------------------------------


@wp.func
def gap_ahead(o: int, world: int, x: wp.vec3, step: wp.vec3, rigid: Rigid):
    """The gap between a point and an obstacle at the end of a step [m], if the point goes by ``step`` [m]; where it is
    too far to meet the obstacle, how far."""
    now = rigid.motions.now[world, o]
    later = rigid.motions.later[world, o]
    moved = carried(now, later, x)
    relative = step - moved
    far = 2.0 * wp.length(relative) + wp.length(moved) + 2.0 * rigid.law.tolerance
    gap, n = distance_to(rigid.shapes, o, now, x, far)
    after, _end = distance_to(rigid.shapes, o, later, x + step, far)
    if gap > far:
        return gap
    return wp.min(gap + wp.dot(n, relative), after)


@unique_kernel()
def find_onsets(rigid: Rigid, carriers: Carriers, begins: wp.array[wp.int32]):
    """Whether a place will meet an obstacle, which did not push it in the last step, at the velocities of its nodes."""
    s = wp.tid()
    surface = rigid.surface
    if surface.node[s] < 0 or is_held_at(s, carriers):
        return
    for o in range(rigid.shapes.kind.shape[0]):
        ahead = gap_ahead(o, surface.world[s], surface.x[s], surface.d[s], rigid)
        force = rigid.rows.force[o * surface.node.shape[0] + s]
        if wp.length_sq(force) == 0.0 and ahead < -rigid.law.tolerance:
            begins[0] = 1


@unique_kernel()
def find_pair_onsets(threads: int, law: Law, surface: Surface, rows: Rows, begins: wp.array[wp.int32]):
    """Whether a pair that did not act in the last step will meet at the velocities of its nodes."""
    row = wp.tid()
    while row < row_count(rows):
        force = rows.force[row]
        if wp.dot(force, force) == 0.0 and locate_facing(row, surface, rows):
            p = rows.places[row]
            w = rows.weights[row]
            closing = wp.vec3()
            for k in range(4):
                closing += w[k] * surface.d[p[k]]
            along = wp.dot(closing, rows.normal[row])
            if along < -law.tolerance and rows.gap[row] + along < -law.tolerance:
                begins[0] = 1
        row += threads
