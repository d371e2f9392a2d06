"""Contacts of obstacles with the edges and the interiors of triangles."""

import warp as wp

from .bearing import is_borne
from .closest import deepest_on_triangle, on_triangle, point_of, segment_to_triangle
from .law import LOST, allowed, held_back
from .shapes import CAPSULE, SPHERE, Shapes, carried, distance_to
from .vertices import FORESEEN, Rigid, across

wp.set_module_options({"enable_backward": False})

#: A point with a corner's weight above this counts as the corner, which has its own contact.
CORNER = wp.constant(0.999)
#: Points of a capsule whose gaps differ by less than this fraction of its radius are averaged.
BLUR = wp.constant(1.0e-3)

#: Triangles deeper in an obstacle than this fraction of its thickness are skewered and slide off without friction. At
#: half the thickness the way out points to the other side, and contacts that hold are far shallower. A fast stab stayed
#: on the tool with friction at every depth, and tools that moved at random kept a body without friction at any.
SKEWERED = wp.constant(0.25)


@wp.struct
class Touches:
    """Obstacles at triangles, [O, T]."""

    shares: wp.array2d[wp.vec3]  # weights of the corners at the contact point; zero if nothing is near
    normal: wp.array2d[wp.vec3]  # from the obstacle to the triangle
    gap: wp.array2d[wp.float32]
    friction: wp.array2d[wp.float32]
    moved: wp.array2d[wp.vec3]  # motion of the obstacle's point in this step [m]
    acts: wp.array2d[wp.int32]  # see ``mass_split``
    force: wp.array2d[wp.vec3]  # on the triangle [N]
    more: wp.array2d[wp.vec3]  # its change in the last iteration
    warmth: wp.array[wp.float32]  # [T] fraction of the last step's normal force that is left beside corners that touch
    allowance: wp.array2d[wp.float32]  # how deep the triangle may be [m]; see ``law.allowed``


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
def find_touch(o: int, t: int, rigid: Rigid, triangles: wp.array[wp.vec3i], touches: Touches):
    """Find the point where an obstacle comes close to a triangle but not to its corners, and the force with which the
    step begins. Returns whether there is one.
    """
    was = touches.force[o, t]
    side = touches.normal[o, t]
    # Most triangles that something is near have no contact: these are only read.
    if wp.length_sq(touches.shares[o, t]) > 0.0 or wp.dot(was, was) > 0.0:
        touches.shares[o, t] = wp.vec3()
        touches.force[o, t] = wp.vec3()
        touches.more[o, t] = wp.vec3()
        touches.acts[o, t] = 0
    corners = triangles[t]
    pose = rigid.motions.now[rigid.surface.world[corners[0]], o]
    later = rigid.motions.later[rigid.surface.world[corners[0]], o]
    a = rigid.surface.x[corners[0]]
    b = rigid.surface.x[corners[1]]
    c = rigid.surface.x[corners[2]]
    middle = (a + b + c) / 3.0
    size = wp.max(wp.length(a - middle), wp.max(wp.length(b - middle), wp.length(c - middle)))
    far = wp.max(
        wp.length(rigid.surface.d[corners[0]]),
        wp.max(wp.length(rigid.surface.d[corners[1]]), wp.length(rigid.surface.d[corners[2]])),
    )
    far = FORESEEN * (far + wp.length(carried(pose, later, middle))) + rigid.law.tolerance
    distance, _away = distance_to(rigid.shapes, o, pose, middle, size + far)
    if distance > size + far:
        return False
    w, gap, n = nearest(rigid.shapes, o, pose, size + far, far, a, b, c)
    if wp.dot(was, was) > 0.0 and wp.dot(n, side) < 0.0 and rigid.shapes.kind[o] == CAPSULE:
        # The axis has passed through since the last step.
        n = -n
        gap = -2.0 * rigid.shapes.size[o][0] - gap
    if gap > far or wp.max(w) > CORNER:
        return False
    allowance = touches.allowance[o, t]
    if allowance != 0.0:
        allowance = allowed(allowance, gap)
        touches.allowance[o, t] = (1.0 - LOST) * allowance
        gap += allowance
        if gap > far:
            return False
    friction = wp.where(gap < -SKEWERED * rigid.shapes.thickness[o], 0.0, rigid.shapes.friction[o])
    touches.shares[o, t] = w
    touches.normal[o, t] = n
    touches.gap[o, t] = gap
    touches.friction[o, t] = friction
    touches.moved[o, t] = carried(pose, later, point_of(w, a, b, c))
    was_push = wp.max(wp.dot(was, n), 0.0)
    push = was_push
    # Beside corners that touch, too, it would hold these off; and where nodes bear places, other places.
    for k in range(3):
        if rigid.anchors[o, corners[k]][3] > 0.0 or is_borne(corners[k], rigid.surface):
            push = touches.warmth[t] * was_push
    # Friction begins with all of it, because the slip that restores a part would accumulate.
    if push > 0.0:
        touches.force[o, t] = push * n + held_back(across(was, n), was_push, friction)
    return True
