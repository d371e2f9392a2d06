"""Signed distances of obstacles, negative inside, with their gradients, which point away from the obstacle.

Each obstacle has its own frame: a half-space is the region below z = 0, the axes of capsules and cylinders are z, and
all finite shapes are centred at the origin. A pose maps the frame to the world.
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
