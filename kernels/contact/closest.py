"""Closest points of triangles: to a point, to a segment, and to any obstacle that has a signed distance."""

import warp as wp

from .shapes import Shapes, distance_to

wp.set_module_options({"enable_backward": False})

#: Corners that the search for the deepest point of a triangle goes towards, and halvings of the way to each.
TURNS = wp.constant(8)
HALVINGS = wp.constant(6)


@wp.func
def on_triangle(p: wp.vec3, a: wp.vec3, b: wp.vec3, c: wp.vec3):
    """Shares of the corners in the point of a triangle that is closest to p (Ericson, Real-Time Collision Detection,
    5.1.5)."""
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
    """Shares of q and of b in the points of pq and ab that are closest to one another (Ericson, 5.1.9)."""
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
    """The share of q where pq goes through a triangle, -1 if it does not, and the corners' shares there."""
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
def segment_to_triangle(p: wp.vec3, q: wp.vec3, a: wp.vec3, b: wp.vec3, c: wp.vec3):
    """The share of q and those of the corners in the closest points of a segment and a triangle."""
    t, best = crossing(p, q, a, b, c)
    if t >= 0.0:
        return t, best
    best = on_triangle(p, a, b, c)
    share = float(0.0)
    least = wp.length_sq(point_of(best, a, b, c) - p)
    w = on_triangle(q, a, b, c)
    far = wp.length_sq(point_of(w, a, b, c) - q)
    if far < least:
        least, best, share = far, w, float(1.0)
    for edge in range(3):
        first = a
        second = b
        if edge == 1:
            first = b
            second = c
        elif edge == 2:
            first = c
            second = a
        s, r = on_segments(p, q, first, second)
        far = wp.length_sq(p + s * (q - p) - first - r * (second - first))
        if far < least:
            least = far
            share = s
            best = wp.vec3(1.0 - r, r, 0.0)
            if edge == 1:
                best = wp.vec3(0.0, 1.0 - r, r)
            elif edge == 2:
                best = wp.vec3(r, 0.0, 1.0 - r)
    return share, best


@wp.func
def deepest_on_triangle(shapes: Shapes, o: int, pose: wp.transform, most: float, a: wp.vec3, b: wp.vec3, c: wp.vec3):
    """The corners' shares in the point of a triangle that is deepest in an obstacle, or closest to it.

    Frank and Wolfe's method: towards the corner that the distance falls to most steeply, as far as it falls. Exact in
    the end for convex obstacles; often that corner is the end.
    """
    w = wp.vec3(1.0, 1.0, 1.0) / 3.0
    corners = wp.matrix_from_rows(a, b, c)
    # Loops that stay loops: unrolled, they would hold the distance 64 times, and take minutes to compile.
    turns = int(0)
    while turns < TURNS:
        turns += 1
        _distance, n = distance_to(shapes, o, pose, point_of(w, a, b, c), most)
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
        # The corner itself is looked at first.
        middle = float(1.0)
        halvings = int(0)
        if w[k] == 1.0:
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
