"""Winding numbers of closed surfaces around points in float32, exact except for the rounding of float64.

A line runs from the point out of the surface's box. A triangle that it meets counts 1 where the line leaves the
enclosed space and -1 where it enters it. The line is almost parallel to an axis, so it passes few boxes of the
surface's tree. It is slightly inclined because drawn shapes have edges parallel to the axes, and a line through an edge
could meet both of its triangles or neither. Both triangles of an edge compute the same value for the side on which the
line passes it.

Also distances of points to a surface, and parts of it that cross each other."""

import warp as wp

from warp_corot.kernels.modules import unique_kernel

# Warp would unroll loops of up to 16 rounds, and compile each round's search by itself.
wp.set_module_options({"enable_backward": False, "max_unroll": 1})

#: Inclination of lines: metres along the two other axes for each metre along their axis. A box around a line is wider
#: by this share of its length and this share of the point's largest coordinate.
ASLANT = wp.constant(wp.vec2d(1.2371e-5, 0.7193e-5))
WIDER = wp.constant(1.3e-5)
ROUNDING = wp.constant(1.0e-6)


@wp.struct
class Lines:
    """The axis of lines, and the lowest and highest coordinate of the surface along it [m]."""

    axis: int
    low: float
    high: float


@wp.func
def along_line(x: wp.vec3, axis: int):
    """A point in coordinates in which lines are parallel to the third axis."""
    height = wp.float64(x[axis])
    first = wp.float64(x[(axis + 1) % 3]) - ASLANT[0] * height
    second = wp.float64(x[(axis + 2) % 3]) - ASLANT[1] * height
    return wp.vec3d(first, second, height)


@wp.func
def passes_left(a: wp.vec3d, b: wp.vec3d, i: int, j: int, p: wp.vec3d):
    """Whether an edge from node i at a to node j at b has the line through p on its left."""
    start = a
    end = b
    if i > j:
        start = b
        end = a
    left = (end[0] - start[0]) * (p[1] - start[1]) - (end[1] - start[1]) * (p[0] - start[0]) > wp.float64(0.0)
    return left != (i > j)


@wp.func
def meets(mesh: wp.uint64, indices: wp.array[wp.int32], face: int, axis: int, p: wp.vec3d):
    """The height at which the line through p meets a triangle; and 1 if the line, on its way up, leaves the enclosed
    space there, -1 if it enters it, 0 if it does not meet the triangle."""
    i = indices[3 * face]
    j = indices[3 * face + 1]
    k = indices[3 * face + 2]
    a = along_line(wp.mesh_get_point(mesh, 3 * face), axis)
    b = along_line(wp.mesh_get_point(mesh, 3 * face + 1), axis)
    c = along_line(wp.mesh_get_point(mesh, 3 * face + 2), axis)
    left = passes_left(a, b, i, j, p)
    normal = wp.cross(b - a, c - a)
    if passes_left(b, c, j, k, p) != left or passes_left(c, a, k, i, p) != left or normal[2] == wp.float64(0.0):
        return wp.float64(0.0), 0
    height = a[2] - (normal[0] * (p[0] - a[0]) + normal[1] * (p[1] - a[1])) / normal[2]
    return height, wp.where(left, 1, -1)


@wp.func
def winding_number(mesh: wp.uint64, indices: wp.array[wp.int32], lines: Lines, point: wp.vec3):
    """The winding number of a closed surface around a point: in how many layers of the body the point lies."""
    axis = lines.axis
    up = lines.high - point[axis] <= point[axis] - lines.low
    end = wp.where(up, lines.high, lines.low)
    aside = WIDER * wp.abs(end - point[axis]) + ROUNDING * wp.max(wp.abs(point))
    low = point - wp.vec3(aside)
    high = point + wp.vec3(aside)
    if up:
        high[axis] = end
    else:
        low[axis] = end
    p = along_line(point, axis)
    count = int(0)
    face = int(0)
    query = wp.mesh_query_aabb(mesh, low, high)
    while wp.mesh_query_aabb_next(query, face):
        height, leaves = meets(mesh, indices, face, axis, p)
        if (height > p[2]) == up and height != p[2]:
            count += wp.where(up, leaves, -leaves)
    return count


@wp.kernel(enable_backward=False)
def find_windings(
    # In
    points: wp.array[wp.vec3],
    mesh: wp.uint64,
    indices: wp.array[wp.int32],
    lines: Lines,
    # Out
    windings: wp.array[wp.int32],
):
    """The winding number of a closed surface around each point."""
    i = wp.tid()
    windings[i] = winding_number(mesh, indices, lines, points[i])


@wp.kernel(enable_backward=False)
def measure_lines(
    # In
    starts: wp.array[wp.vec3],
    mesh: wp.uint64,
    indices: wp.array[wp.int32],
    lines: Lines,
    # Out
    lengths: wp.array[wp.float64],
):
    """The length of the line upwards from each point, counting only where winding numbers are above zero [m]."""
    n = wp.tid()
    start = starts[n]
    axis = lines.axis
    aside = WIDER * (lines.high - start[axis]) + ROUNDING * wp.max(wp.abs(start))
    low = start - wp.vec3(aside)
    high = start + wp.vec3(aside)
    high[axis] = lines.high
    p = along_line(start, axis)
    at = p[2]
    length = wp.float64(0.0)
    end = wp.float64(wp.inf)
    upto = wp.float64(0.0)
    while upto < end:
        # Up to the next triangle the winding number is the sum over all triangles above.
        upto = end
        winding = int(0)
        face = int(0)
        query = wp.mesh_query_aabb(mesh, low, high)
        while wp.mesh_query_aabb_next(query, face):
            height, leaves = meets(mesh, indices, face, axis, p)
            if leaves != 0 and height > at:
                winding += leaves
                upto = wp.min(upto, height)
        if upto < end:
            if winding > 0:
                length += upto - at
            at = upto
    lengths[n] = length


#: Maximum number of triangles of its own part that an edge can pass.
MOST_OWN_HITS = wp.constant(8)
#: Fraction of an edge's length that is left out at its ends, where its own triangles begin.
ENDS = wp.constant(1.0e-4)


@wp.kernel(enable_backward=False)
def find_nearest(
    # In
    points: wp.array[wp.vec3],
    mesh: wp.uint64,
    far: float,
    # Out
    faces: wp.array[wp.int32],
    distances: wp.array[wp.float32],
):
    """The triangle closest to each point and its distance; -1 and ``far`` if none is closer than that."""
    i = wp.tid()
    found = wp.mesh_query_point_no_sign(mesh, points[i], far)
    faces[i] = wp.where(found.result, found.face, -1)
    distances[i] = far
    if found.result:
        distances[i] = wp.length(wp.mesh_eval_position(mesh, found.face, found.u, found.v) - points[i])


@unique_kernel()
def find_crossed_parts(
    # In
    edges: wp.array[wp.vec2i],
    edge_parts: wp.array[wp.int32],
    points: wp.array[wp.vec3],
    mesh: wp.uint64,
    triangle_parts: wp.array[wp.int32],
    # Out
    crossed: wp.array[wp.int32],
):
    """Another part with a triangle that an edge crosses, -1 for none."""
    i = wp.tid()
    start = points[edges[i][0]]
    along = points[edges[i][1]] - start
    length = wp.length(along)
    crossed[i] = -1
    if length == 0.0:
        return
    direction = along / length
    at = ENDS * length
    end = (1.0 - ENDS) * length
    for _ in range(MOST_OWN_HITS):
        if at >= end or crossed[i] >= 0:
            return
        found = wp.mesh_query_ray(mesh, start + at * direction, direction, end - at)
        if not found.result:
            return
        if triangle_parts[found.face] != edge_parts[i]:
            crossed[i] = triangle_parts[found.face]
        at += found.t + ENDS * length
