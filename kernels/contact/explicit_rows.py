"""Rows of obstacles in an explicit step: at places, and at the edges and the interiors of triangles."""

import warp as wp

from .bearing import is_borne
from .law import LOST, Law, across, allowed, held_back, settled
from .motion import Motions, Surface
from .rows import Rows
from .shapes import (
    CAPSULE,
    SPHERE,
    Shapes,
    carried,
    deepest_on_triangle,
    distance_to,
    on_triangle,
    point_of,
    segment_to_triangle,
)

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


@wp.func
def forget_place(r: int, acted: int, was: wp.vec3, rows: Rows):
    """Leave a place without contact in this step. Most that something is near are so already, and are only read."""
    if acted != OUT or wp.dot(was, was) > 0.0:
        rows.force[r] = wp.vec3()
        rows.more[r] = wp.vec3()
        rows.acts[r] = OUT
    return False


@wp.func
def begin_row(r: int, was: wp.vec3, part: float, rows: Rows):
    """Begin a row that has been located with a part of the push of the last step. Friction begins with all of it:
    otherwise the slip that restores the rest would accumulate."""
    n = rows.normal[r]
    push = wp.max(wp.dot(was, n), 0.0)
    force = wp.vec3()
    if push > 0.0:
        force = (part * push) * n + held_back(across(was, n), push, rows.friction[r])
    rows.force[r] = force
    rows.more[r] = wp.vec3()
    rows.acts[r] = WAITS


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
    rows.normal[r] = n
    rows.gap[r] = gap
    rows.moved[r] = moved
    begin_row(r, was, 1.0, rows)
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


# --- at triangles -----------------------------------------------------------------------------------------------------

#: A point with a corner's weight above this counts as the corner, which has its own contact.
CORNER = wp.constant(0.999)
#: Points of a capsule whose gaps differ by less than this fraction of its radius are averaged.
BLUR = wp.constant(1.0e-3)

#: Triangles deeper in an obstacle than this fraction of its thickness are skewered and slide off without friction. At
#: half the thickness the way out points to the other side, and contacts that hold are far shallower. A fast stab stayed
#: on the tool with friction at every depth, and tools that moved at random kept a body without friction at any.
SKEWERED = wp.constant(0.25)


@wp.func
def nearest(shapes: Shapes, o: int, pose: wp.transform, most: float, far: float, a: wp.vec3, b: wp.vec3, c: wp.vec3):
    """Weights of the corners at the closest point, the gap there, and the direction out of the obstacle; any point if
    all are farther away than ``far``."""
    kind = shapes.kind[o]
    size = shapes.size[o]
    centre = wp.transform_get_translation(pose)
    if kind == SPHERE or kind == CAPSULE:
        w = wp.vec3()
        if kind == CAPSULE:
            half = wp.quat_rotate(wp.transform_get_rotation(pose), wp.vec3(0.0, 0.0, size[1]))
            along, w = segment_to_triangle(centre - half, centre + half, a, b, c, BLUR * size[0])
            centre = centre + (2.0 * along - 1.0) * half
        else:
            w = on_triangle(centre, a, b, c)
        d = point_of(w, a, b, c) - centre
        length = wp.length(d)
        if length > 1.0e-4 * size[0]:
            return w, length - size[0], d / length
        # The axis passes through the triangle: the obstacle came from outside.
        return w, -size[0], -wp.normalize(wp.cross(b - a, c - a))
    w = deepest_on_triangle(shapes, o, pose, most, far, a, b, c)
    gap, n = distance_to(shapes, o, pose, point_of(w, a, b, c), most)
    return w, gap, n


@wp.func
def near_triangle(
    o: int,
    pose: wp.transform,
    a: wp.vec3,
    b: wp.vec3,
    c: wp.vec3,
    far: float,
    was: wp.vec3,
    side: wp.vec3,
    shapes: Shapes,
):
    """Whether an obstacle comes within reach of a triangle, but not of its corners; the weights of the corners at the
    closest point, the gap there, and the direction out of the obstacle.

    Args:
        was, side: The last force and normal.
    """
    middle = (a + b + c) / 3.0
    most = far + wp.max(wp.length(a - middle), wp.max(wp.length(b - middle), wp.length(c - middle)))
    distance, n = distance_to(shapes, o, pose, middle, most)
    if distance > most:
        return False, wp.vec3(), distance, n
    w, gap, out = nearest(shapes, o, pose, most, far, a, b, c)
    if wp.dot(was, was) > 0.0 and wp.dot(out, side) < 0.0 and shapes.kind[o] == CAPSULE:
        # The axis has passed through since the last time.
        out = -out
        gap = -2.0 * shapes.size[o][0] - gap
    return gap <= far and wp.max(w) <= CORNER, w, gap, out


@wp.func
def find_touch(r: int, rigid: Rigid):
    """Find the point where an obstacle comes close to a triangle but not to its corners, and the force with which the
    step begins. Returns whether there is one.
    """
    rows = rigid.rows
    o = (r - rigid.first_triangle) // rigid.surface.triangles.shape[0]
    t = (r - rigid.first_triangle) % rigid.surface.triangles.shape[0]
    was = rows.force[r]
    # Most triangles that something is near have no contact: these are only read.
    if wp.length_sq(rows.weights[r]) > 0.0 or wp.dot(was, was) > 0.0:
        rows.weights[r] = wp.vec4()
        rows.force[r] = wp.vec3()
        rows.more[r] = wp.vec3()
        rows.acts[r] = 0
    corners = rigid.surface.triangles[t]
    pose = rigid.motions.now[rigid.surface.world[corners[0]], o]
    later = rigid.motions.later[rigid.surface.world[corners[0]], o]
    a = rigid.surface.x[corners[0]]
    b = rigid.surface.x[corners[1]]
    c = rigid.surface.x[corners[2]]
    far = wp.max(
        wp.length(rigid.surface.d[corners[0]]),
        wp.max(wp.length(rigid.surface.d[corners[1]]), wp.length(rigid.surface.d[corners[2]])),
    )
    far = FORESEEN * (far + wp.length(carried(pose, later, (a + b + c) / 3.0))) + rigid.law.tolerance
    is_near, w, gap, n = near_triangle(o, pose, a, b, c, far, was, rows.normal[r], rigid.shapes)
    if not is_near:
        return False
    allowance = rigid.allowance[r]
    if allowance != 0.0:
        allowance = allowed(allowance, gap)
        rigid.allowance[r] = (1.0 - LOST) * allowance
        gap += allowance
        if gap > far:
            return False
    friction = wp.where(gap < -SKEWERED * rigid.shapes.thickness[o], 0.0, rigid.shapes.friction[o])
    rows.weights[r] = wp.vec4(w[0], w[1], w[2], 0.0)
    rows.normal[r] = n
    rows.gap[r] = gap
    rows.friction[r] = friction
    rows.moved[r] = carried(pose, later, point_of(w, a, b, c))
    part = float(1.0)
    # Beside corners that touch, too, it would hold these off; and where nodes bear places, other places.
    for k in range(3):
        at = rigid.anchors[o * rigid.surface.node.shape[0] + corners[k]]
        if at[3] > 0.0 or is_borne(corners[k], rigid.surface):
            part = rigid.surface.warmth[t]
    begin_row(r, was, part, rows)
    return True
