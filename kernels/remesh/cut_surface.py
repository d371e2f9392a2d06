"""Surfaces that cut: planes, and triangles that blades sweep; what is near them, and which lines cross them."""

import warp as wp

from warp_corot.kernels.elements.elements import load_node
from warp_corot.kernels.meshing.bisection import lattice_place

from .pools import Carried, Pools, doubled

wp.set_module_options({"enable_backward": False})

#: Leaves are near a surface if it is no farther from their centroids than this many times their farthest node: so are
#: those on both sides of a cut face, and their neighbours, whose centroids are at most 1.36 times as far at rest.
#: Planes cut bodies that are deformed.
NEAR = wp.constant(wp.float64(1.4))
NEAR_DEFORMED = wp.constant(wp.float64(2.5))
#: At rest, no node of a leaf is farther from its centroid than this many times the cube root of its volume.
RADIUS = wp.constant(wp.float64(1.71))
#: Triangles that have a box in common.
BUNDLE = wp.constant(16)


@wp.struct
class Surface:
    """A plane, or triangles wound alike, at rest or in the deformed body; or the stress that faces bear."""

    is_deformed: wp.float64  # 1: where nodes are now; 0: where they are at rest
    stress: float  # above which faces tear [Pa]; zero for planes and triangles
    normal: wp.vec3d  # of the plane; without triangles
    offset: wp.float64
    count: int  # number of triangles
    points: wp.array[wp.vec3d]
    triangles: wp.array[wp.vec3i]  # those with equal corners are none
    bounds: wp.array[wp.vec3d]  # of all triangles, and of each ``BUNDLE``: the lowest and the highest corner
    # Leaves at a triangle are refined to its level; and the energy that faces which it cuts take [J].
    levels: wp.array[wp.int32]
    debt: wp.array[wp.float64]


@wp.func
def place_of(node: int, is_deformed: wp.float64, pools: Pools, carried: Carried):
    """Where a node is [m]."""
    place = lattice_place(pools.lattice[node], carried.origin, carried.spacing)
    if is_deformed != wp.float64(0.0):
        place += is_deformed * doubled(load_node(carried.u, node))
    return place


@wp.func
def centroid(tet: wp.vec4i, is_deformed: wp.float64, pools: Pools, carried: Carried):
    total = wp.vec3d()
    for n in range(4):
        total += place_of(tet[n], is_deformed, pools, carried)
    return wp.float64(0.25) * total


@wp.func
def boxes_meet(low: wp.vec3d, high: wp.vec3d, other_low: wp.vec3d, other_high: wp.vec3d, far: wp.float64):
    """Whether two boxes are within a distance of one another, or a little farther."""
    meet = bool(True)
    for axis in range(3):
        meet = meet and high[axis] >= other_low[axis] - far and low[axis] <= other_high[axis] + far
    return meet


@wp.func
def next_near(first: int, p: wp.vec3d, q: wp.vec3d, far: wp.float64, surface: Surface):
    """The next triangle, from one on, whose box is within a distance of that around two points; their number if there
    is none."""
    low = wp.min(p, q)
    high = wp.max(p, q)
    t = int(first)
    while t < surface.count:
        bundle = 2 + 2 * (t / BUNDLE)
        if t % BUNDLE == 0 and not boxes_meet(low, high, surface.bounds[bundle], surface.bounds[bundle + 1], far):
            t += BUNDLE
        else:
            corners = surface.triangles[t]
            a = surface.points[corners[0]]
            b = surface.points[corners[1]]
            c = surface.points[corners[2]]
            near = boxes_meet(low, high, wp.min(a, wp.min(b, c)), wp.max(a, wp.max(b, c)), far)
            if near and corners[0] != corners[1]:
                return t
            t += 1
    return surface.count


@wp.func
def near_triangle(t: int, x: wp.vec3d, far: wp.float64, surface: Surface):
    """Whether the plane of a triangle is within a distance of a point."""
    corners = surface.triangles[t]
    a = surface.points[corners[0]]
    normal = wp.cross(surface.points[corners[1]] - a, surface.points[corners[2]] - a)
    return wp.abs(wp.dot(normal, x - a)) <= far * wp.length(normal)


@wp.func
def is_near(x: wp.vec3d, far: wp.float64, surface: Surface):
    """Whether a surface is within a distance of a point, or a little farther."""
    if surface.count == 0:
        return wp.abs(wp.dot(surface.normal, x) - surface.offset) <= far
    t = next_near(0, x, x, far, surface)
    while t < surface.count:
        if near_triangle(t, x, far, surface):
            return True
        t = next_near(t + 1, x, x, far, surface)
    return False


@wp.func
def radius(tet: wp.vec4i, x: wp.vec3d, is_deformed: wp.float64, pools: Pools, carried: Carried):
    """The distance from its centroid to the farthest node of a leaf [m]."""
    far = wp.float64(0.0)
    for n in range(4):
        far = wp.max(far, wp.length_sq(place_of(tet[n], is_deformed, pools, carried) - x))
    return wp.sqrt(far)


@wp.func
def edge_side(p: wp.vec3d, q: wp.vec3d, a: int, b: int, surface: Surface):
    """On which side the line p-q passes an edge; exactly opposite if the edge's ends are exchanged."""
    x = surface.points[wp.min(a, b)]
    y = surface.points[wp.max(a, b)]
    side = wp.dot(q - p, wp.cross(x - p, y - p))
    return wp.where(a < b, side, -side)


@wp.func
def crossing(p: wp.vec3d, q: wp.vec3d, surface: Surface):
    """The unit normal of the surface where the line from p to q crosses it, and the triangle; zero if it does not."""
    none = wp.vec3d()
    zero = wp.float64(0.0)
    if surface.count == 0:
        p_behind = wp.dot(surface.normal, p) < surface.offset
        q_behind = wp.dot(surface.normal, q) < surface.offset
        if p_behind == q_behind:
            return none, -1
        return surface.normal, -1
    t = next_near(0, p, q, zero, surface)
    while t < surface.count:
        corners = surface.triangles[t]
        a = surface.points[corners[0]]
        normal = wp.cross(surface.points[corners[1]] - a, surface.points[corners[2]] - a)
        p_behind = wp.dot(normal, p - a) < zero
        q_behind = wp.dot(normal, q - a) < zero
        if p_behind != q_behind:
            first = edge_side(p, q, corners[0], corners[1], surface)
            second = edge_side(p, q, corners[1], corners[2], surface)
            third = edge_side(p, q, corners[2], corners[0], surface)
            least = wp.min(first, wp.min(second, third))
            most = wp.max(first, wp.max(second, third))
            if least >= zero or most <= zero:
                return wp.normalize(normal), t
        t = next_near(t + 1, p, q, zero, surface)
    return none, -1


@wp.func
def is_far(i: int, far: wp.float64, surface: Surface, pools: Pools, carried: Carried):
    """Whether one of its nodes shows that a leaf is farther from all triangles than so many times its radius."""
    if surface.count == 0:
        return False
    x = place_of(pools.leaf_tets[i][0], wp.float64(0.0), pools, carried)
    far *= RADIUS * carried.size[pools.level[pools.leaves[i]]]
    return not boxes_meet(x, x, surface.bounds[0], surface.bounds[1], far)
