"""Contact results for users: wrenches on obstacles, and pressure on the bodies' triangles."""

import warp as wp

from warp_corot.kernels.stepping.sums import sum_of_lanes

from .explicit_rows import Rigid
from .mass_split import force_of, grains_of
from .motion import Motions, Surface
from .rows import Rows, row_count
from .shapes import Shapes, distance_to

wp.set_module_options({"enable_backward": False})


@wp.kernel(enable_backward=False)
def sum_wrenches(
    # In
    start: int,
    count: int,
    lanes: int,
    threads: int,
    surface: Surface,
    motions: Motions,
    forces: wp.array2d[wp.vec3],
    # In and out
    parts: wp.array3d[wp.spatial_vectord],
):
    """Add the wrenches of a body's nodes on obstacles in a fixed order: [O, W, parts], with ``lanes`` threads for each.

    Args:
        count: Number of the body's places in each world, from ``start`` on.
    """
    o, world, thread = wp.tid()
    origin = wp.transform_get_translation(motions.later[world, o])
    sums = wp.spatial_vectord()
    k = thread
    while k < count:
        s = start + world * count + k
        force = forces[o, s]
        if wp.dot(force, force) > 0.0:
            torque = wp.cross(surface.x[s] + surface.d[s] - origin, force)
            for axis in range(3):
                sums[axis] = sums[axis] - wp.float64(force[axis])
                sums[3 + axis] = sums[3 + axis] - wp.float64(torque[axis])
        k += threads
    for axis in range(6):
        sums[axis] = sum_of_lanes(sums[axis], lanes)
    if thread % lanes == 0:
        parts[o, world, thread / lanes] = parts[o, world, thread / lanes] + sums


@wp.kernel(enable_backward=False)
def fold_wrenches(parts: wp.array3d[wp.spatial_vectord], wrenches: wp.array2d[wp.spatial_vector]):
    """Sum the parts, and set them to zero."""
    o, world = wp.tid()
    sums = wp.spatial_vectord()
    for k in range(parts.shape[2]):
        sums += parts[o, world, k]
        parts[o, world, k] = wp.spatial_vectord()
    wrench = wp.spatial_vector()
    for axis in range(6):
        wrench[axis] = float(sums[axis])
    wrenches[o, world] = wrench


@wp.func
def area_vector(surface: Surface, corners: wp.vec3i):
    """Half the cross product of two edges: it points outwards, and its length is the area [m^2]."""
    a = surface.x[corners[0]]
    return 0.5 * wp.cross(surface.x[corners[1]] - a, surface.x[corners[2]] - a)


@wp.kernel(enable_backward=False)
def node_pressures(surface: Surface, pressures: wp.array[wp.vec3]):
    """Find the pressure at each node [Pa]: the force into the body, along the mean normal of the loaded triangles
    around the node, over a third of their area.
    """
    s = wp.tid()
    pressures[s] = wp.vec3()
    force = surface.f[s]
    if wp.dot(force, force) == 0.0:
        return
    outward = wp.vec3()
    for k in range(surface.corner_starts[s], surface.corner_starts[s + 1]):
        own = area_vector(surface, surface.triangles[surface.corners[k] / 3])
        outward += wp.max(-wp.dot(wp.normalize(own), force), 0.0) * own
    outward = wp.normalize(outward)
    area = float(0.0)
    for k in range(surface.corner_starts[s], surface.corner_starts[s + 1]):
        own = area_vector(surface, surface.triangles[surface.corners[k] / 3])
        facing = wp.max(wp.dot(wp.normalize(own), outward), 0.0)
        area += wp.length(own) * facing * facing / 3.0
    if area > 0.0:
        pressures[s] = (wp.max(-wp.dot(force, outward), 0.0) / area) * outward


@wp.kernel(enable_backward=False)
def triangle_pressures(first: int, surface: Surface, pressures: wp.array[wp.vec3], found: wp.array[wp.float32]):
    """Average the pressure over each triangle of a body, so that pressure times area adds up to the normal forces."""
    t = wp.tid()
    c = surface.triangles[first + t]
    pressure = float(0.0)
    if c[0] >= 0:
        normal = wp.normalize(area_vector(surface, c))
        for k in range(3):
            pressure += wp.max(wp.dot(pressures[c[k]], normal), 0.0) / 3.0
    found[t] = pressure


@wp.kernel(enable_backward=False)
def measure_gaps(
    # In
    shapes: Shapes,
    poses: wp.array2d[wp.transform],
    obstacles: wp.array[wp.int32],
    worlds: wp.array[wp.int32],
    points: wp.array2d[wp.vec3],
    most: float,
    # Out
    gaps: wp.array2d[wp.float32],
    normals: wp.array2d[wp.vec3],
):
    """Find distances [n, k] of points from an obstacle in a world for each n [m], negative inside, and the directions
    out of it. Distances beyond ``most`` are only known to be larger than it.
    """
    i, k = wp.tid()
    gap, normal = distance_to(shapes, obstacles[i], poses[worlds[i], obstacles[i]], points[i, k], most)
    gaps[i, k] = gap
    normals[i, k] = normal


@wp.kernel(enable_backward=False)
def share_touches(rigid: Rigid, totals: wp.array2d[wp.vec3]):
    """Add the forces of obstacles on nodes and the nodes' shares of the forces on triangles [N]."""
    o, s = wp.tid()
    surface = rigid.surface
    total = rigid.rows.force[o * surface.node.shape[0] + s]
    for k in range(surface.corner_starts[s], surface.corner_starts[s + 1]):
        r = rigid.first_triangle + o * surface.triangles.shape[0] + surface.corners[k] / 3
        if rigid.rows.acts[r] != 0:
            total += rigid.rows.weights[r][surface.corners[k] % 3] * rigid.rows.force[r]
    totals[o, s] = total


@wp.kernel(enable_backward=False)
def forget_rows(chosen: wp.array[wp.int32], rigid: Rigid):
    """Forget the last step's contact with obstacles in chosen worlds."""
    r = wp.tid()
    s = r % rigid.surface.node.shape[0]
    if r >= rigid.first_triangle:
        s = rigid.surface.triangles[(r - rigid.first_triangle) % rigid.surface.triangles.shape[0]][0]
    if s >= 0 and rigid.surface.node[s] >= 0 and chosen[rigid.surface.world[s]] != 0:
        rigid.rows.force[r] = wp.vec3()
        rigid.allowance[r] = 0.0
        if r < rigid.first_triangle:
            rigid.anchors[r] = wp.vec4()


@wp.kernel(enable_backward=False)
def add_pairs(grain: float, rows: Rows, forces: wp.array[wp.vec3l]):
    """Add the forces of pairs to their places."""
    row = wp.tid()
    if row < row_count(rows) and rows.acts[row] != 0:
        for k in range(4):
            if rows.weights[row][k] != 0.0:
                wp.atomic_add(forces, rows.places[row][k], grains_of(rows.weights[row][k] * rows.force[row], grain))


@wp.kernel(enable_backward=False)
def place_forces(grain: float, totals: wp.array2d[wp.vec3], forces: wp.array[wp.vec3l], surface: Surface):
    """Find the force at each place: those of pairs, which become zero, and those of obstacles."""
    s = wp.tid()
    force = force_of(forces[s], grain)
    forces[s] = wp.vec3l()
    for o in range(totals.shape[0]):
        force += totals[o, s]
    surface.f[s] = force
