"""The point of a triangle that is closest to an obstacle in an implicit step, and how it rolls; see ``span_places``.

A triangle that tilts by the gradient s of its corners' motions along the normal, and slides by t there, is closest to a
sphere elsewhere, and the force f turns it back. To second order its gap is g - s . t + D s . s / 2, where D is the
distance from the centre. The part f D q . q / 2 of the energy with q = s - t / D is convex. Without it in the matrix,
closest points and tilts alternate from solve to solve wherever f D over the square of an edge is more than the
stiffness of the body. The rest, - f t . t / 2 D, is left to the search for closest points.
"""

import warp as wp

from .law import Law
from .shapes import CAPSULE, SPHERE, Shapes, distance_to
from .touches import CORNER, nearest

wp.set_module_options({"enable_backward": False})

#: A point with a corner's weight below this is on the opposite edge.
ON_EDGE = wp.constant(1.0e-4)


@wp.struct
class Rolling:
    """The tilt q of a triangle is the sum of ``slopes`` of its corners times their motions along n, less the motion of
    the closest point across n over ``distance``.
    """

    slopes: wp.mat33  # the gradients of the corners' shares [1/m]
    distance: float  # from the centre of the obstacle [m]; zero: it does not roll
    along: wp.vec3  # the only direction in which it rolls; zero: any


@wp.func
def rolling_of(
    o: int, pose: wp.transform, w: wp.vec3, gap: float, n: wp.vec3, a: wp.vec3, b: wp.vec3, c: wp.vec3, shapes: Shapes
):
    """How a triangle rolls around an obstacle that is closest at the shares w."""
    made = Rolling()
    made.distance = 0.0
    kind = shapes.kind[o]
    if kind != SPHERE and kind != CAPSULE:
        return made
    area = wp.cross(b - a, c - a)
    square = wp.length_sq(area)
    if square <= 0.0 or gap <= -0.9 * shapes.size[o][0]:
        return made
    made.slopes = wp.matrix_from_rows(
        wp.cross(area, c - b) / square, wp.cross(area, a - c) / square, wp.cross(area, b - a) / square
    )
    made.distance = shapes.size[o][0] + gap
    if kind == CAPSULE:
        axis = wp.quat_rotate(wp.transform_get_rotation(pose), wp.vec3(0.0, 0.0, 1.0))
        made.along = wp.normalize(wp.cross(axis, n))
    if w[0] < ON_EDGE:
        made.along = wp.normalize(c - b)
    elif w[1] < ON_EDGE:
        made.along = wp.normalize(a - c)
    elif w[2] < ON_EDGE:
        made.along = wp.normalize(b - a)
    return made


@wp.func
def tilted(rolling: Rolling, w: wp.vec3, n: wp.vec3, e: wp.mat33):
    """The tilt q after motions e of the corners, as rows."""
    up = e * n
    moved = w * e
    q = up * rolling.slopes - moved / rolling.distance
    q -= wp.dot(q, n) * n
    if wp.length_sq(rolling.along) > 0.0:
        q = wp.dot(q, rolling.along) * rolling.along
    return q


@wp.func
def share_of_moment(k: int, m: wp.vec3, rolling: Rolling, w: wp.vec3, n: wp.vec3):
    """The force on a corner of a moment m against tilts, the derivative of m . q."""
    across = m - wp.dot(m, n) * n
    return wp.dot(rolling.slopes[k], across) * n - (w[k] / rolling.distance) * across


#: An obstacle must be closer to a triangle than to its corners by this many times the size of rounding errors.
CLOSER = wp.constant(4.0)
#: The point of a triangle stays if another is closer by at most this many times the law's slack, and goes no farther
#: than to where it would stay.
STAYS = wp.constant(1.0)


@wp.struct
class Found:
    """Where an obstacle is close to an item."""

    is_near: wp.bool
    shares: wp.vec3
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
def find_span(
    o: int,
    pose: wp.transform,
    a: wp.vec3,
    b: wp.vec3,
    c: wp.vec3,
    far: float,
    was: wp.vec3,
    side: wp.vec3,
    before: wp.vec3,
    shapes: Shapes,
    law: Law,
):
    """The point of a triangle that is closest to an obstacle, if that is within reach and closer than the corners.

    The point with the shares ``before`` stays if it is hardly less close: along an edge of an obstacle all points are
    about as close, and forces that jump between them do not come to rest. On round obstacles it rolls instead.
    """
    found = Found()
    found.is_near = False
    middle = (a + b + c) / 3.0
    size = wp.max(wp.length(a - middle), wp.max(wp.length(b - middle), wp.length(c - middle)))
    most = size + far
    distance, _away = distance_to(shapes, o, pose, middle, most)
    if distance > most:
        return found
    w, gap, n = nearest(shapes, o, pose, most, far, a, b, c)
    if wp.dot(was, was) > 0.0 and wp.dot(n, side) < 0.0 and shapes.kind[o] == CAPSULE:
        # The axis has passed through since the last time.
        n = -n
        gap = -2.0 * shapes.size[o][0] - gap
    if gap > far or wp.max(w) > CORNER:
        return found
    points = wp.matrix_from_rows(a, b, c, before[0] * a + before[1] * b + before[2] * c)
    is_round = shapes.kind[o] == SPHERE or shapes.kind[o] == CAPSULE
    tried = int(3)
    if wp.dot(was, was) > 0.0 and wp.max(before) <= CORNER and not is_round:
        tried = 4
    # The corners, the former point, and the one where it goes. This loop is not unrolled, so that there is one distance
    # function to compile.
    k = int(0)
    point = points[0]
    while k < tried:
        if k < 4:
            point = points[k]
        there, away = distance_to(shapes, o, pose, point, most)
        if k < 3 and there <= gap + CLOSER * law.tolerance:
            return found
        if k == 3:
            beyond = there - gap
            if beyond > STAYS * law.slack:
                w = before + (1.0 - wp.sqrt(STAYS * law.slack / beyond)) * (w - before)
                point = w[0] * a + w[1] * b + w[2] * c
                tried = 5
            else:
                w = before
        if k >= 3:
            gap = there
            n = away
        k += 1
    found.is_near = True
    found.rolling = rolling_of(o, pose, w, gap, n, a, b, c, shapes)
    found.shares = w
    found.gap = gap
    found.normal = n
    return found
