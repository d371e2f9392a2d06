"""Boxes around triangles and edges that contain all their positions until the next search."""

import warp as wp

from .motion import Surface
from .rows import BAND, Meeting, triangle_normal
from .watch import ahead_at

wp.set_module_options({"enable_backward": False})

#: Coordinate of empty boxes [m].
NOWHERE = wp.constant(1.0e6)


@wp.func
def triangle_size(surface: Surface, c: wp.vec3i):
    a = surface.x[c[0]]
    return wp.sqrt(wp.length(wp.cross(surface.x[c[1]] - a, surface.x[c[2]] - a)))


@wp.func
def triangle_reach(surface: Surface, meeting: Meeting, c: wp.vec3i):
    return wp.max(meeting.reach[c[0]], wp.max(meeting.reach[c[1]], meeting.reach[c[2]]))


@wp.func
def lower_end(s: int, surface: Surface, meeting: Meeting):
    """The least coordinates on the way that a place is expected to take."""
    x = surface.x[s]
    return wp.min(x, x + ahead_at(s, meeting.ahead))


@wp.func
def upper_end(s: int, surface: Surface, meeting: Meeting):
    x = surface.x[s]
    return wp.max(x, x + ahead_at(s, meeting.ahead))


@wp.func
def edge_reach(meeting: Meeting, e: wp.vec2i):
    return wp.max(meeting.reach[e[0]], meeting.reach[e[1]])


@wp.func
def triangle_start(c: wp.vec3i, surface: Surface, meeting: Meeting):
    first = wp.min(lower_end(c[0], surface, meeting), lower_end(c[1], surface, meeting))
    return wp.min(first, lower_end(c[2], surface, meeting))


@wp.func
def triangle_end(c: wp.vec3i, surface: Surface, meeting: Meeting):
    first = wp.max(upper_end(c[0], surface, meeting), upper_end(c[1], surface, meeting))
    return wp.max(first, upper_end(c[2], surface, meeting))


@wp.kernel(enable_backward=False)
def box_triangles(surface: Surface, meeting: Meeting, lower: wp.array[wp.vec3], upper: wp.array[wp.vec3]):
    """Find the boxes of triangles, and their normals."""
    t = wp.tid()
    c = meeting.triangles[t]
    if c[0] < 0:
        lower[t] = wp.vec3(NOWHERE, NOWHERE, NOWHERE)
        upper[t] = lower[t]
        return
    meeting.normals[t] = triangle_normal(surface, c)
    far = triangle_reach(surface, meeting, c) + BAND * triangle_size(surface, c)
    beyond = wp.vec3(far, far, far)
    lower[t] = triangle_start(c, surface, meeting) - beyond
    upper[t] = triangle_end(c, surface, meeting) + beyond


@wp.kernel(enable_backward=False)
def box_edges(surface: Surface, meeting: Meeting, lower: wp.array[wp.vec3], upper: wp.array[wp.vec3]):
    """Find the boxes of edges, after those of triangles, and the sums of the normals at each."""
    k = wp.tid()
    e = meeting.edges[k]
    if e[0] < 0:
        lower[k] = wp.vec3(NOWHERE, NOWHERE, NOWHERE)
        upper[k] = lower[k]
        return
    sides = meeting.sides[k]
    meeting.outs[k] = meeting.normals[sides[0]] + meeting.normals[sides[1]]
    a = surface.x[e[0]]
    b = surface.x[e[1]]
    far = edge_reach(meeting, e) + BAND * wp.length(b - a)
    beyond = wp.vec3(far, far, far)
    lower[k] = wp.min(lower_end(e[0], surface, meeting), lower_end(e[1], surface, meeting)) - beyond
    upper[k] = wp.max(upper_end(e[0], surface, meeting), upper_end(e[1], surface, meeting)) + beyond


@wp.kernel(enable_backward=False)
def find_roots(tree: wp.uint64, roots: wp.array[wp.int32]):
    """Find the root of each group of a tree."""
    g = wp.tid()
    roots[g] = wp.bvh_get_group_root(tree, g)


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    unsigned bits = __float_as_uint(value);
    bool adds = true;
#if __CUDA_ARCH__ >= 800
    bits = __reduce_max_sync(0xffffffffu, bits);
    adds = (threadIdx.x & 31) == 0;
#endif
    if (adds && bits != 0) atomicMax(reinterpret_cast<unsigned*>(&wp::index(most, 0)), bits);
#else
    if (value > wp::index(most, 0)) wp::index(most, 0) = value;
#endif
""")
def raise_by_warp(most: wp.array[wp.float32], value: float):
    """Raise a number to at least a value, neither of which is negative. All threads of a warp must call it."""
    ...
