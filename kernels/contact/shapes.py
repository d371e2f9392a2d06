"""Signed distances of obstacles, negative inside, with their gradients, which point away from the obstacle.

Each obstacle has its own frame: a half-space is the region below z = 0, the axes of capsules and cylinders are z, and
all finite shapes are centred at the origin. A pose maps the frame to the world.

Besides, the closest points of triangles: to a point, to a segment, and to any obstacle.

In an implicit step the closest point rolls around a round obstacle; see ``implicit_location``. A triangle that tilts
by the gradient s of its corners' motions along the normal, and slides by t there, is closest to a sphere elsewhere, and
the force f turns it back. To second order its gap is g - s . t + D s . s / 2, where D is the distance from the centre.
The part f D q . q / 2 of the energy with q = s - t / D is convex. Without it in the matrix, closest points and tilts
alternate from solve to solve wherever f D over the square of an edge is more than the stiffness of the body. The rest,
- f t . t / 2 D, is left to the search for closest points.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

GROUND, SPHERE, CAPSULE, BOX, CYLINDER, MESH, GRID = (wp.constant(k) for k in range(7))

#: A vector shorter than this fraction of the obstacle's size has no reliable direction.
TINY = wp.constant(1e-9)
#: Radius of the edges of boxes and cylinders, as a fraction of half their smallest thickness: near a sharp edge the way
#: out would change from step to step.
ROUNDING = wp.constant(0.05)
#: Meshes are rounded by a skin of this thickness, relative to their depth.
SKIN = wp.constant(0.02)


@wp.struct
class Shapes:
    """The obstacles of a simulation, one entry each."""

    kind: wp.array[wp.int32]
    # Sphere: radius; capsule, cylinder: radius and half the length; box: half the edges; mesh: how deep inside
    # points are looked for; grid: spacing [m].
    size: wp.array[wp.vec3]
    source: wp.array[wp.uint64]  # the mesh
    # Grids: the first sample and how many along each axis, the place of the first one, and the distances of all [m].
    first: wp.array[wp.int32]
    count: wp.array[wp.vec3i]
    lower: wp.array[wp.vec3]
    values: wp.array[wp.float32]
    friction: wp.array[wp.float32]
    thickness: wp.array[wp.float32]  # half the smallest thickness [m]


@wp.func
def box_distance(p: wp.vec3, half: wp.vec3):
    q = wp.vec3(wp.abs(p[0]) - half[0], wp.abs(p[1]) - half[1], wp.abs(p[2]) - half[2])
    beyond = wp.vec3(wp.max(q[0], 0.0), wp.max(q[1], 0.0), wp.max(q[2], 0.0))
    side = wp.vec3(wp.sign(p[0]), wp.sign(p[1]), wp.sign(p[2]))
    length = wp.length(beyond)
    if length > 0.0:
        return length, wp.cw_mul(beyond, side) / length
    if q[0] >= q[1] and q[0] >= q[2]:
        return q[0], wp.vec3(side[0], 0.0, 0.0)
    if q[1] >= q[2]:
        return q[1], wp.vec3(0.0, side[1], 0.0)
    return q[2], wp.vec3(0.0, 0.0, side[2])


@wp.func
def round_distance(d: wp.vec3, radius: float):
    """Distance and gradient at offset d from the centre of a round shape."""
    length = wp.length(d)
    normal = wp.vec3(0.0, 0.0, 1.0)
    if length > TINY * radius:
        normal = d / length
    return length - radius, normal


@wp.func
def cylinder_distance(p: wp.vec3, radius: float, half: float):
    across = wp.vec3(p[0], p[1], 0.0)
    length = wp.length(across)
    outward = wp.vec3(1.0, 0.0, 0.0)
    if length > TINY * radius:
        outward = across / length
    along = wp.vec3(0.0, 0.0, wp.sign(p[2]))
    a = length - radius
    b = wp.abs(p[2]) - half
    if a > 0.0 and b > 0.0:
        far = wp.sqrt(a * a + b * b)
        return far, (a * outward + b * along) / far
    if a > b:
        return a, outward
    return b, along


@wp.func
def mesh_distance(mesh: wp.uint64, p: wp.vec3, depth: float, farthest: float):
    most = wp.max(depth, farthest)
    query = wp.mesh_query_point_sign_normal(mesh, p, most)
    if not query.result:
        return most, wp.vec3(0.0, 0.0, 1.0)
    d = p - wp.mesh_eval_position(mesh, query.face, query.u, query.v)
    length = wp.length(d)
    normal = wp.mesh_eval_face_normal(mesh, query.face)
    # Very near the centre, rounding errors dominate the direction of d.
    if length > 1.0e-3 * depth:
        normal = query.sign * d / length
    return query.sign * length, normal


@wp.func
def grid_value(shapes: Shapes, first: int, count: wp.vec3i, i: int, j: int, k: int):
    return shapes.values[first + (i * count[1] + j) * count[2] + k]


@wp.func
def grid_distance(shapes: Shapes, o: int, p: wp.vec3):
    """Trilinear interpolation between the samples; outside the grid, the value at the nearest point of the grid plus
    the distance to it.
    """
    first = shapes.first[o]
    count = shapes.count[o]
    spacing = shapes.size[o]
    c = wp.cw_div(p - shapes.lower[o], spacing)
    inside = wp.vec3(
        wp.clamp(c[0], 0.0, float(count[0] - 1)),
        wp.clamp(c[1], 0.0, float(count[1] - 1)),
        wp.clamp(c[2], 0.0, float(count[2] - 1)),
    )
    i = wp.min(int(inside[0]), count[0] - 2)
    j = wp.min(int(inside[1]), count[1] - 2)
    k = wp.min(int(inside[2]), count[2] - 2)
    a = inside - wp.vec3(float(i), float(j), float(k))
    x0 = wp.vec4()
    x1 = wp.vec4()
    for n in range(4):
        x0[n] = grid_value(shapes, first, count, i, j + n // 2, k + n % 2)
        x1[n] = grid_value(shapes, first, count, i + 1, j + n // 2, k + n % 2)
    along = x1 - x0
    y = x0 + a[0] * along
    low = y[0] + a[2] * (y[1] - y[0])
    high = y[2] + a[2] * (y[3] - y[2])
    slope = (1.0 - a[1]) * ((1.0 - a[2]) * along[0] + a[2] * along[1])
    slope += a[1] * ((1.0 - a[2]) * along[2] + a[2] * along[3])
    gradient = wp.vec3(slope, high - low, (1.0 - a[1]) * (y[1] - y[0]) + a[1] * (y[3] - y[2]))
    normal = wp.cw_div(gradient, spacing)
    distance = low + a[1] * (high - low)
    beyond = wp.cw_mul(c - inside, spacing)
    away = wp.length(beyond)
    if away > 0.0:
        normal = beyond / away
        distance = wp.max(distance, 0.0) + away
    length = wp.length(normal)
    if length > 0.0:
        normal = normal / length
    return distance, normal


@wp.func
def local_distance(shapes: Shapes, o: int, p: wp.vec3, most: float):
    """Distance [m] and its gradient at a point in the obstacle's frame. A distance beyond ``most`` is only known to be
    larger than it.
    """
    kind = shapes.kind[o]
    size = shapes.size[o]
    if kind == GROUND:
        return p[2], wp.vec3(0.0, 0.0, 1.0)
    if kind == SPHERE:
        distance, normal = round_distance(p, size[0])
        return distance, normal
    if kind == CAPSULE:
        on_axis = wp.vec3(0.0, 0.0, wp.clamp(p[2], -size[1], size[1]))
        distance, normal = round_distance(p - on_axis, size[0])
        return distance, normal
    if kind == BOX:
        r = ROUNDING * wp.min(size)
        distance, normal = box_distance(p, size - wp.vec3(r, r, r))
        return distance - r, normal
    if kind == CYLINDER:
        r = ROUNDING * wp.min(size[0], size[1])
        distance, normal = cylinder_distance(p, size[0] - r, size[1] - r)
        return distance - r, normal
    if kind == MESH:
        distance, normal = mesh_distance(shapes.source[o], p, size[0], most + SKIN * size[0])
        return distance - SKIN * size[0], normal
    distance, normal = grid_distance(shapes, o, p)
    return distance, normal


@wp.func
def distance_to(shapes: Shapes, o: int, pose: wp.transform, x: wp.vec3, most: float):
    """Distance [m] and its gradient at a point in the world."""
    p = wp.quat_rotate_inv(wp.transform_get_rotation(pose), x - wp.transform_get_translation(pose))
    distance, normal = local_distance(shapes, o, p, most)
    return distance, wp.quat_rotate(wp.transform_get_rotation(pose), normal)


@wp.func
def sure_distance(shapes: Shapes, o: int, distance: float):
    """The least that a positive distance may be in truth: outside a grid, ``grid_distance`` adds up two sides of a
    triangle whose angle is at least a right one."""
    return wp.where(shapes.kind[o] == GRID, 0.5 * distance, distance)


@wp.func
def carried(now: wp.transform, later: wp.transform, x: wp.vec3):
    """The motion of a point that is carried along by a change of pose; exactly zero if the pose stays the same."""
    arm = x - wp.transform_get_translation(now)
    before = wp.transform_get_rotation(now)
    turned = wp.quat_rotate(wp.transform_get_rotation(later), wp.quat_rotate_inv(before, arm))
    still = wp.quat_rotate(before, wp.quat_rotate_inv(before, arm))
    moved = wp.transform_get_translation(later) - wp.transform_get_translation(now)
    return moved + turned - still


# --- closest points ---------------------------------------------------------------------------------------------------

#: In the search for the deepest point of a triangle: number of moves towards a corner, and of halvings of each move.
TURNS = wp.constant(8)
HALVINGS = wp.constant(6)
#: The search ends if the deepest point is at most this fraction of the triangle's size deeper.
CLOSE_ENOUGH = wp.constant(1.0e-4)


@wp.func
def on_triangle(p: wp.vec3, a: wp.vec3, b: wp.vec3, c: wp.vec3):
    """Barycentric coordinates of the point of a triangle that is closest to p (Ericson, Real-Time Collision Detection,
    5.1.5).
    """
    ab = b - a
    ac = c - a
    ap = p - a
    d1 = wp.dot(ab, ap)
    d2 = wp.dot(ac, ap)
    if d1 <= 0.0 and d2 <= 0.0:
        return wp.vec3(1.0, 0.0, 0.0)
    bp = p - b
    d3 = wp.dot(ab, bp)
    d4 = wp.dot(ac, bp)
    if d3 >= 0.0 and d4 <= d3:
        return wp.vec3(0.0, 1.0, 0.0)
    vc = d1 * d4 - d3 * d2
    if vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        v = d1 / (d1 - d3)
        return wp.vec3(1.0 - v, v, 0.0)
    cp = p - c
    d5 = wp.dot(ab, cp)
    d6 = wp.dot(ac, cp)
    if d6 >= 0.0 and d5 <= d6:
        return wp.vec3(0.0, 0.0, 1.0)
    vb = d5 * d2 - d1 * d6
    if vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        w = d2 / (d2 - d6)
        return wp.vec3(1.0 - w, 0.0, w)
    va = d3 * d6 - d5 * d4
    if va <= 0.0 and d4 - d3 >= 0.0 and d5 - d6 >= 0.0:
        w = (d4 - d3) / ((d4 - d3) + (d5 - d6))
        return wp.vec3(0.0, 1.0 - w, w)
    total = 1.0 / (va + vb + vc)
    return wp.vec3(1.0 - (vb + vc) * total, vb * total, vc * total)


@wp.func
def on_segments(p: wp.vec3, q: wp.vec3, a: wp.vec3, b: wp.vec3):
    """Weights of q and b in the closest points of the segments pq and ab (Ericson, 5.1.9)."""
    d1 = q - p
    d2 = b - a
    r = p - a
    e = wp.dot(d1, d1)
    f = wp.dot(d2, d2)
    g = wp.dot(d2, r)
    c = wp.dot(d1, r)
    h = wp.dot(d1, d2)
    s = float(0.0)
    t = float(0.0)
    square = e * f - h * h
    if square > 1.0e-7 * e * f:
        s = wp.clamp((h * g - c * f) / square, 0.0, 1.0)
    if f > 0.0:
        t = (h * s + g) / f
    if t < 0.0:
        t = 0.0
        if e > 0.0:
            s = wp.clamp(-c / e, 0.0, 1.0)
    elif t > 1.0:
        t = 1.0
        if e > 0.0:
            s = wp.clamp((h - c) / e, 0.0, 1.0)
    return s, t


@wp.func
def point_of(w: wp.vec3, a: wp.vec3, b: wp.vec3, c: wp.vec3):
    return w[0] * a + w[1] * b + w[2] * c


@wp.func
def crossing(p: wp.vec3, q: wp.vec3, a: wp.vec3, b: wp.vec3, c: wp.vec3):
    """The weight of q at the point where pq passes through a triangle, or -1, and that point's barycentric
    coordinates.
    """
    normal = wp.cross(b - a, c - a)
    area = wp.dot(normal, normal)
    low = wp.dot(p - a, normal)
    high = wp.dot(q - a, normal)
    if low * high > 0.0 or low == high or area == 0.0:
        return -1.0, wp.vec3()
    t = low / (low - high)
    x = p + t * (q - p)
    w = wp.vec3(
        wp.dot(wp.cross(b - x, c - x), normal),
        wp.dot(wp.cross(c - x, a - x), normal),
        wp.dot(wp.cross(a - x, b - x), normal),
    )
    if wp.min(w) < 0.0:
        return -1.0, wp.vec3()
    return t, w / area


@wp.func
def candidate(k: int, p: wp.vec3, q: wp.vec3, a: wp.vec3, b: wp.vec3, c: wp.vec3):
    """Barycentric coordinates of the point of a triangle that is closest to candidate k (p, q, or the segment pq for
    each edge), and the distance of this point from pq.
    """
    if k == 0:
        w = on_triangle(p, a, b, c)
        return w, wp.length(point_of(w, a, b, c) - p)
    if k == 1:
        w = on_triangle(q, a, b, c)
        return w, wp.length(point_of(w, a, b, c) - q)
    first = a
    second = b
    if k == 3:
        first = b
        second = c
    if k == 4:
        first = c
        second = a
    s, r = on_segments(p, q, first, second)
    far = wp.length(p + s * (q - p) - first - r * (second - first))
    w = wp.vec3(1.0 - r, r, 0.0)
    if k == 3:
        w = wp.vec3(0.0, 1.0 - r, r)
    if k == 4:
        w = wp.vec3(r, 0.0, 1.0 - r)
    return w, far


@wp.func
def segment_to_triangle(p: wp.vec3, q: wp.vec3, a: wp.vec3, b: wp.vec3, c: wp.vec3, blur: float):
    """The weight of q and the barycentric coordinates of the closest points of a segment and a triangle.

    Points whose distances differ by less than about ``blur`` [m], as on a segment that is parallel to the triangle, are
    averaged; otherwise the closest point would jump from step to step.
    """
    t, w = crossing(p, q, a, b, c)
    if t >= 0.0:
        return t, w
    least = float(3.0e38)
    w = wp.vec3()
    total = float(0.0)
    k = int(0)
    # This loop is not unrolled; earlier results lose weight when a closer point is found.
    while k < 5:
        place, far = candidate(k, p, q, a, b, c)
        if far < least:
            shrunk = wp.exp(-(least - far) / blur)
            w = shrunk * w
            total = shrunk * total
            least = far
        weight = wp.exp(-(far - least) / blur)
        w += weight * place
        total += weight
        k += 1
    w = w / total
    way = q - p
    square = wp.length_sq(way)
    along = float(0.0)
    if square > 0.0:
        along = wp.clamp(wp.dot(point_of(w, a, b, c) - p, way) / square, 0.0, 1.0)
    return along, w


@wp.func
def deepest_on_triangle(
    shapes: Shapes, o: int, pose: wp.transform, most: float, far: float, a: wp.vec3, b: wp.vec3, c: wp.vec3
):
    """Barycentric coordinates of the point of a triangle that is deepest in an obstacle, or closest to it.

    This is Frank and Wolfe's method: move towards the corner in whose direction the distance falls most steeply, as far
    as it falls. It converges for convex obstacles, and often ends at that corner. The distance to a convex obstacle is
    nowhere less than that corner's by the gradient (the method's duality gap): it ends early if that is no improvement,
    or farther away than ``far``.
    """
    w = wp.vec3(1.0, 1.0, 1.0) / 3.0
    corners = wp.matrix_from_rows(a, b, c)
    little = CLOSE_ENOUGH * wp.max(wp.length(b - a), wp.length(c - a))
    is_convex = shapes.kind[o] != MESH and shapes.kind[o] != GRID
    # These loops are not unrolled: they would contain the distance function 64 times, which takes minutes to compile.
    turns = int(0)
    while turns < TURNS:
        turns += 1
        x = point_of(w, a, b, c)
        distance, n = distance_to(shapes, o, pose, x, most)
        falls = corners * n
        k = int(0)
        if falls[1] < falls[k]:
            k = 1
        if falls[2] < falls[k]:
            k = 2
        corner = wp.vec3()
        corner[k] = 1.0
        way = corner - w
        low = float(0.0)
        high = float(1.0)
        # Try the corner itself first.
        middle = float(1.0)
        halvings = int(0)
        gains = wp.dot(n, x) - falls[k]
        if w[k] == 1.0 or (is_convex and (gains <= little or distance - gains > far)):
            middle = 0.0
            halvings = HALVINGS + 1
            turns = TURNS + 0
        while halvings <= HALVINGS:
            halvings += 1
            _there, m = distance_to(shapes, o, pose, point_of(w + middle * way, a, b, c), most)
            if wp.dot(m, point_of(way, a, b, c)) < 0.0:
                low = middle
            else:
                high = middle
            if low == 1.0:
                halvings = HALVINGS + 1
            middle = 0.5 * (low + high)
        w = w + middle * way
        if low == 1.0:
            w = corner
    return w


# --- rolling ----------------------------------------------------------------------------------------------------------

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
