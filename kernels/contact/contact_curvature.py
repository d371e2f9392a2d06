"""How the point of a triangle that is closest to an obstacle rolls in an implicit step; see ``obstacle_rows``.

A triangle that tilts by the gradient s of its corners' motions along the normal, and slides by t there, is closest to a
sphere elsewhere, and the force f turns it back. To second order its gap is g - s . t + D s . s / 2, where D is the
distance from the centre. The part f D q . q / 2 of the energy with q = s - t / D is convex. Without it in the matrix,
closest points and tilts alternate from solve to solve wherever f D over the square of an edge is more than the
stiffness of the body. The rest, - f t . t / 2 D, is left to the search for closest points.
"""

import warp as wp

from .shapes import CAPSULE, SPHERE, Shapes

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
