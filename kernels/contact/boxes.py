"""Boxes around triangles and edges that contain all their positions until the next search."""

import warp as wp

from warp_corot.kernels.stepping.threads import least_of_lanes, same_in_lanes

from .motion import Surface
from .rows import BAND, Meeting, triangle_normal
from .watch import Watch, ahead_at

wp.set_module_options({"enable_backward": False})

#: Coordinate of empty boxes [m].
NOWHERE = wp.constant(1.0e6)
#: Number of threads of a warp.
LANES = wp.constant(32)


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
def clear_bounds(watch: Watch, lower: wp.array2d[wp.vec3], upper: wp.array2d[wp.vec3]):
    """Make the bounds of bodies, [worlds, bodies], empty."""
    world, k = wp.tid()
    if watch.due[0] != 0:
        lower[world, k] = wp.vec3(NOWHERE, NOWHERE, NOWHERE)
        upper[world, k] = -wp.vec3(NOWHERE, NOWHERE, NOWHERE)


@wp.func
def extend_bounds(
    world: int, body: int, low: wp.vec3, high: wp.vec3, lower: wp.array2d[wp.vec3], upper: wp.array2d[wp.vec3]
):
    """Extend a body's bounds; most threads see that their boxes are inside already."""
    a = lower[world, body]
    b = upper[world, body]
    if low[0] < a[0] or low[1] < a[1] or low[2] < a[2]:
        extend_down(lower, world, body, low)
    if high[0] > b[0] or high[1] > b[1] or high[2] > b[2]:
        extend_up(upper, world, body, high)


@wp.func
def longest_side(a: wp.vec3, b: wp.vec3, c: wp.vec3):
    return wp.max(wp.length(b - a), wp.max(wp.length(c - b), wp.length(a - c)))


@wp.kernel(enable_backward=False)
def bound_bodies(
    # In
    threads: int,
    watch: Watch,
    surface: Surface,
    meeting: Meeting,
    # Out
    lower: wp.array2d[wp.vec3],
    upper: wp.array2d[wp.vec3],
):
    """Extend the bounds of each body to the boxes of its triangles and of their edges. A warp takes triangles that
    follow one another, nearly always of one body."""
    lanes = wp.min(threads, LANES)
    warps = threads / lanes
    each = (meeting.triangles.shape[0] + warps - 1) / warps
    t = wp.tid() / lanes * each + wp.tid() % lanes
    end = wp.min((wp.tid() / lanes + 1) * each, meeting.triangles.shape[0])
    if watch.due[0] == 0:
        return
    low = wp.vec3(NOWHERE, NOWHERE, NOWHERE)
    high = -low
    world = int(-1)
    body = int(-1)
    while t < end:
        c = meeting.triangles[t]
        if c[0] >= 0:
            if meeting.body[c[0]] != body or surface.world[c[0]] != world:
                if body >= 0:
                    extend_bounds(world, body, low, high, lower, upper)
                body = meeting.body[c[0]]
                world = surface.world[c[0]]
                low = wp.vec3(NOWHERE, NOWHERE, NOWHERE)
                high = -low
            a = surface.x[c[0]]
            b = surface.x[c[1]]
            e = surface.x[c[2]]
            # No side and no triangle needs a larger box.
            far = triangle_reach(surface, meeting, c) + BAND * longest_side(a, b, e)
            beyond = wp.vec3(far, far, far)
            low = wp.min(low, triangle_start(c, surface, meeting) - beyond)
            high = wp.max(high, triangle_end(c, surface, meeting) + beyond)
        t += lanes
    # One thread of a warp with one body is enough.
    first = wp.tid() % LANES == 0
    if same_in_lanes(world * lower.shape[1] + body):
        low = least_of_lanes(low)
        high = -least_of_lanes(-high)
    else:
        first = True
    if first and body >= 0:
        extend_bounds(world, body, low, high, lower, upper)


@wp.func
def may_reach(world: int, k: int, low: wp.vec3, high: wp.vec3, meeting: Meeting):
    """Whether a box overlaps the bounds of body k."""
    a = meeting.lower[world, k]
    b = meeting.upper[world, k]
    is_apart = a[0] > high[0] or a[1] > high[1] or a[2] > high[2]
    return not (is_apart or b[0] < low[0] or b[1] < low[1] or b[2] < low[2])


@wp.func
def may_reach_others(s: int, low: wp.vec3, high: wp.vec3, surface: Surface, meeting: Meeting):
    """Whether the box of an item at place ``s`` overlaps the bounds of another body; always true if a body may touch
    itself.
    """
    if meeting.meets_itself != 0:
        return True
    for k in range(meeting.lower.shape[1]):
        if k != meeting.body[s] and may_reach(surface.world[s], k, low, high, meeting):
            return True
    return False


@wp.func
def root_of(of_edges: int, g: int, s: int, low: wp.vec3, high: wp.vec3, surface: Surface, meeting: Meeting):
    """The root of the boxes of group g in the world of place ``s``; -1 if the box of an item there meets none of them.

    A group is a body, or all bodies if there are many.
    """
    world = surface.world[s]
    if meeting.groups == 1:
        if not may_reach_others(s, low, high, surface, meeting):
            return -1
    elif g == meeting.body[s]:
        if meeting.meets_itself == 0:
            return -1
    elif not may_reach(world, g, low, high, meeting):
        return -1
    return meeting.roots[of_edges, world * meeting.groups + g]


@wp.kernel(enable_backward=False)
def find_roots(tree: wp.uint64, roots: wp.array[wp.int32]):
    """Find the root of each group of a tree."""
    g = wp.tid()
    roots[g] = wp.bvh_get_group_root(tree, g)


# Atomic minima and maxima that no thread waits for: Warp's own compare and swap, one thread after the other. The bits
# of numbers without a sign are in order as integers, those of numbers with one in reverse order.
@wp.func_native("""
    float* to = reinterpret_cast<float*>(&wp::index(bounds, world, body));
    for (int axis = 0; axis < 3; ++axis) {
#if defined(__CUDA_ARCH__)
        const int bits = __float_as_int(value[axis]);
        if (bits >= 0) atomicMin(reinterpret_cast<int*>(to) + axis, bits);
        else atomicMax(reinterpret_cast<unsigned*>(to) + axis, (unsigned)bits);
#else
        if (value[axis] < to[axis]) to[axis] = value[axis];
#endif
    }
""")
def extend_down(bounds: wp.array2d[wp.vec3], world: int, body: int, value: wp.vec3):
    """Lower each component of a body's bounds to at most a value."""
    ...


@wp.func_native("""
    float* to = reinterpret_cast<float*>(&wp::index(bounds, world, body));
    for (int axis = 0; axis < 3; ++axis) {
#if defined(__CUDA_ARCH__)
        const int bits = __float_as_int(value[axis]);
        if (bits >= 0) atomicMax(reinterpret_cast<int*>(to) + axis, bits);
        else atomicMin(reinterpret_cast<unsigned*>(to) + axis, (unsigned)bits);
#else
        if (value[axis] > to[axis]) to[axis] = value[axis];
#endif
    }
""")
def extend_up(bounds: wp.array2d[wp.vec3], world: int, body: int, value: wp.vec3):
    """Raise each component of a body's bounds to at least a value."""
    ...


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
