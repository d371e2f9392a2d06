"""Signed functions of bodies at many points: negative inside, in metres.

Each kernel evaluates one kind of domain, with one thread for each point; sets of domains combine the results.
"""

import warp as wp

from warp_corot.kernels.modules import unique_kernel

from .windings import Lines, winding_number

# As in ``measuring``.
wp.set_module_options({"enable_backward": False, "max_unroll": 1})

#: Search radius for the closest triangle [m]: unlimited.
FAR = 1.0e15

#: The most triangles through which a segment is followed, and how far beyond each it goes on, as a share of its length.
MOST_PASSED = wp.constant(8)
PASSED = wp.constant(1.0e-4)


@wp.func
def box_distance(p: wp.vec3, lower: wp.vec3, upper: wp.vec3):
    """Signed distance to an axis-aligned box."""
    beyond = wp.max(lower - p, p - upper)
    return wp.length(wp.max(beyond, wp.vec3(0.0))) + wp.min(wp.max(beyond), 0.0)


#: Kinds of shapes: between two corners; around a centre and an axis; around a segment, which is a point for a ball.
BOX = wp.constant(0)
TORUS = wp.constant(1)
CAPSULE = wp.constant(2)


@unique_kernel()
def evaluate_shape(
    # In
    points: wp.array[wp.vec3],
    kind: int,
    a: wp.vec3,
    b: wp.vec3,
    major: float,
    minor: float,
    # Out
    phi: wp.array[wp.float32],
):
    i = wp.tid()
    p = points[i] - a
    if kind == BOX:
        phi[i] = box_distance(points[i], a, b)
    elif kind == TORUS:
        height = wp.dot(p, b)
        phi[i] = wp.length(wp.vec2(wp.length(p - height * b) - major, height)) - minor
    else:
        along = b - a
        share = wp.dot(p, along) / wp.max(wp.dot(along, along), 1.0e-37)
        phi[i] = wp.length(p - along * wp.clamp(share, 0.0, 1.0)) - minor


@unique_kernel()
def clip_to_box(
    # In
    points: wp.array[wp.vec3],
    lower: wp.vec3,
    upper: wp.vec3,
    slope: float,
    # In and out
    phi: wp.array[wp.float32],
):
    """Cut off everything outside a box, with a wall of the given slope."""
    i = wp.tid()
    phi[i] = wp.max(phi[i], slope * box_distance(points[i], lower, upper))


def sampler(function: wp.Function) -> wp.Kernel:
    """A kernel that evaluates a user's device function vec3 -> float."""

    @unique_kernel()
    def evaluate_function(
        # In
        points: wp.array[wp.vec3],
        # Out
        phi: wp.array[wp.float32],
    ):
        i = wp.tid()
        phi[i] = function(points[i])

    return evaluate_function


@wp.kernel(enable_backward=False)
def evaluate_surface(
    # In
    points: wp.array[wp.vec3],
    mesh: wp.uint64,
    indices: wp.array[wp.int32],
    lines: Lines,
    # Out
    phi: wp.array[wp.float32],
):
    """Distance to the closest triangle, negative where the winding number is above one half."""
    i = wp.tid()
    p = points[i]
    found = wp.mesh_query_point_no_sign(mesh, p, FAR)
    away = wp.length(p - wp.mesh_eval_position(mesh, found.face, found.u, found.v))
    phi[i] = wp.where(winding_number(mesh, indices, lines, p) > 0, -away, away)


@unique_kernel()
def evaluate_voxels(
    # In
    points: wp.array[wp.vec3],
    to_voxel: wp.mat33,
    shift: wp.vec3,
    spacing: wp.vec3,
    values: wp.array3d[wp.float32],
    # Out
    phi: wp.array[wp.float32],
):
    """Trilinear between voxel centres; outside the volume sqrt(v^2 + d^2), with the distance d to its closest point c
    and the value v > 0 there. v changes only along directions in which d does not, so the function is no steeper than v
    and d; and it does not exceed the distance to any point q of the body, since c - q points away from p."""
    i = wp.tid()
    x = to_voxel * points[i] + shift
    top = wp.vec3(float(values.shape[0] - 1), float(values.shape[1] - 1), float(values.shape[2] - 1))
    c = wp.min(wp.max(x, wp.vec3(0.0)), top)
    a = wp.min(int(c[0]), values.shape[0] - 2)
    b = wp.min(int(c[1]), values.shape[1] - 2)
    g = wp.min(int(c[2]), values.shape[2] - 2)
    u = c[0] - float(a)
    v = c[1] - float(b)
    w = c[2] - float(g)
    near = wp.lerp(
        wp.lerp(values[a, b, g], values[a + 1, b, g], u), wp.lerp(values[a, b + 1, g], values[a + 1, b + 1, g], u), v
    )
    far = wp.lerp(
        wp.lerp(values[a, b, g + 1], values[a + 1, b, g + 1], u),
        wp.lerp(values[a, b + 1, g + 1], values[a + 1, b + 1, g + 1], u),
        v,
    )
    value = wp.lerp(near, far, w)
    beyond = wp.length(wp.cw_mul(x - c, spacing))
    if beyond > 0.0:
        value = wp.length(wp.vec2(value, beyond))
    phi[i] = value


@unique_kernel()
def read_voxels(
    # In
    points: wp.array[wp.vec3],
    to_voxel: wp.mat33,
    shift: wp.vec3,
    values: wp.array3d[wp.int16],
    # Out
    labels: wp.array[wp.int32],
):
    """The value of the nearest voxel."""
    i = wp.tid()
    x = to_voxel * points[i] + shift
    a = wp.clamp(int(wp.round(x[0])), 0, values.shape[0] - 1)
    b = wp.clamp(int(wp.round(x[1])), 0, values.shape[1] - 1)
    c = wp.clamp(int(wp.round(x[2])), 0, values.shape[2] - 1)
    labels[i] = int(values[a, b, c])


@unique_kernel()
def combine(
    # In
    outer: float,
    first: wp.array[wp.float32],
    inner: float,
    second: wp.array[wp.float32],
    # Out
    phi: wp.array[wp.float32],
):
    """The union of two domains for signs ``outer`` and ``inner`` of -1 and -1, the intersection for 1 and 1, the
    difference for 1 and -1."""
    i = wp.tid()
    phi[i] = outer * wp.max(outer * first[i], inner * second[i])


@unique_kernel()
def choose_labels(
    # In
    first: wp.array[wp.float32],
    second: wp.array[wp.float32],
    first_labels: wp.array[wp.int32],
    second_labels: wp.array[wp.int32],
    renumbered: wp.array[wp.int32],
    # Out
    labels: wp.array[wp.int32],
):
    """The label of the first domain that contains the point and has a label there; otherwise that of the nearer one."""
    i = wp.tid()
    a = first_labels[i]
    b = renumbered[second_labels[i]]
    if a > 0 and first[i] <= 0.0:
        labels[i] = a
    elif b > 0 and second[i] <= 0.0:
        labels[i] = b
    else:
        labels[i] = wp.where(first[i] < second[i], a, b)


@unique_kernel()
def clear_labels_outside(
    # In
    phi: wp.array[wp.float32],
    # In and out
    labels: wp.array[wp.int32],
):
    i = wp.tid()
    if phi[i] > 0.0:
        labels[i] = 0


@wp.kernel(enable_backward=False)
def evaluate_thickness(
    # In
    points: wp.array[wp.vec3],
    inward: wp.array[wp.vec3],
    reach: float,
    side: float,
    mesh: wp.uint64,
    # Out
    thickness: wp.array[wp.float32],
):
    """The distance along a direction to where a ray leaves the body (``side`` 1) or its surroundings (-1).

    ``reach`` if it is farther. A triangle with the opposite orientation is an entry: an overlapping part.
    """
    i = wp.tid()
    direction = inward[i]
    at = float(0.0)
    thickness[i] = reach
    for _ in range(4):
        if at < reach:
            found = wp.mesh_query_ray(mesh, points[i] + at * direction, direction, reach - at)
            if not found.result:
                at = reach
            elif side * wp.dot(wp.mesh_eval_face_normal(mesh, found.face), direction) > 0.0:
                thickness[i] = at + found.t
                at = reach
            else:
                at += found.t + 1.0e-4 * reach


@wp.kernel(enable_backward=False)
def find_exits(
    # In
    starts: wp.array[wp.vec3],
    along: wp.array[wp.vec3],
    mesh: wp.uint64,
    indices: wp.array[wp.int32],
    lines: Lines,
    # Out
    shares: wp.array[wp.float32],
    normals: wp.array[wp.vec3],
):
    """Where segments from inside to outside leave the body, as a share of their length, and the normal there; -1 for
    segments with more triangles than are passed."""
    i = wp.tid()
    length = wp.length(along[i])
    direction = wp.normalize(along[i])
    layers = winding_number(mesh, indices, lines, starts[i])
    at = float(0.0)
    shares[i] = -1.0
    for _ in range(MOST_PASSED):
        if layers > 0 and at < length:
            found = wp.mesh_query_ray(mesh, starts[i] + at * direction, direction, length - at)
            if found.result:
                normals[i] = wp.mesh_eval_face_normal(mesh, found.face)
                layers += wp.where(wp.dot(normals[i], direction) > 0.0, -1, 1)
                if layers == 0:
                    shares[i] = wp.min((at + found.t) / length, 1.0)
                at += found.t + PASSED * length
            else:
                at = length
