"""Boxes around triangles and edges that contain all their positions until the next search, and for the CPU a bounding
volume hierarchy over them, eight boxes wide.

A test compares a box with eight others at once, in the lanes of vector registers, and the normals of what is in them:
most of what is near something on a body is its own neighbourhood, which faces the same way and cannot touch it. After
Wald, Benthin and Boulos, Getting rid of packets: efficient SIMD single-ray traversal using multi-branching BVHs (2008).
"""

import warp as wp

from warp_corot.kernels.elements.simd8 import on_cpu
from warp_corot.kernels.modules import INLINED

from .motion import Surface
from .rows import BAND, Meeting, triangle_normal
from .watch import FAR, Watch, ahead_at

# Loops are the CPU's alone here, and compile in a third of the time if they remain loops.
wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": INLINED, "max_unroll": 1})

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
    c = surface.triangles[t]
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
    """Find the boxes of edges, and the sum of the normals of the triangles at each, which must be known."""
    k = wp.tid()
    e = surface.edges[k]
    if e[0] < 0:
        lower[k] = wp.vec3(NOWHERE, NOWHERE, NOWHERE)
        upper[k] = lower[k]
        return
    sides = surface.sides[k]
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


# --- the tree ---------------------------------------------------------------------------------------------------------

#: Boxes of a node, and the numbers that each has there: its lower and upper ends, a normal, and what is in a leaf. Of
#: an edge that is an end, the way to the other one, and how far others may be; of a triangle its three corners, the
#: directions out of its sides within its plane, and how far others may be.
LANES, ROWS = wp.constant(8), wp.constant(28)
#: Distances in lanes are rounded by less than this.
NEARLY = wp.constant(1.001)
#: The largest cosine between the normals of a node and a triangle of one body, or between those of two blunt edges,
#: that may face each other before the next search.
MAY_FACE = wp.constant(0.5)
#: Edges that bend by up to about 100 degrees, whose normals add up to at least this, touch only what they face.
BLUNT = wp.constant(1.25)


@wp.struct
class WideTree:
    """Nodes, each with the boxes of eight others; empty on CUDA.

    A body in a world has roots of its own, lanes that stand for 64 leaves. Leaf z is a lane of node z / 8 of
    ``lower_nodes``, which is a lane of node z / 64 of ``upper_nodes``, which is a lane of node z / 512 of ``roots``.
    """

    roots: wp.array[wp.float32]
    upper_nodes: wp.array[wp.float32]
    lower_nodes: wp.array[wp.float32]
    root_starts: wp.array[wp.int32]  # [worlds + 1] the lanes of roots of each world
    root_bodies: wp.array[wp.int32]
    # The triangles of leaves, and the edges: the first node of each leaf, and what is in the lanes; -1: nothing
    triangle_starts: wp.array[wp.int32]  # [leaves + 1]
    triangle_nodes: wp.array[wp.float32]
    triangles: wp.array[wp.int32]
    edge_starts: wp.array[wp.int32]  # [leaves + 1]
    edge_nodes: wp.array[wp.float32]
    edges: wp.array[wp.int32]
    found: wp.array[wp.int32]  # what a query has found


@wp.func_native(
    on_cpu(
        """
    typedef float eight __attribute__((vector_size(32), aligned(4)));
    typedef int bits __attribute__((vector_size(32)));
    const float none[3] = {0.0f, 0.0f, 0.0f}, normal[3] = {out[0], out[1], out[2]};
    const auto dot = [](const eight* a, const eight* b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; };
    const auto larger = [](eight a, eight b) { return a > b ? a : b; };
    const auto within = [&](eight a) { a = a > 0.0f ? a : 0.0f * a; return a < 1.0f ? a : 0.0f * a + 1.0f; };
    // Which of the boxes of a node overlap this one, and do not face the same way; in leaves, and are near enough.
    const auto hits = [&](const float* nodes, int node, const float* n, bool is_leaf) {
        const eight* b = reinterpret_cast<const eight*>(nodes + 8 * 28 * node);
        bits in = (b[0] <= high[0]) & (b[1] <= high[1]) & (b[2] <= high[2]);
        in &= (b[3] >= low[0]) & (b[4] >= low[1]) & (b[5] >= low[2]);
        in &= (n[0] * b[6] + n[1] * b[7] + n[2] * b[8] <= 0.5f);
        unsigned found = 0;
        if (!__builtin_reduce_or(in)) return found;
        if (is_leaf && reach >= 0.0f) {
            eight far[3];
            if (of_edges) {
                // Ericson, Real-Time Collision Detection, 5.1.9.
                const eight *p = b + 9, *e = b + 12;
                eight r[3], d[3];
                for (int k = 0; k < 3; ++k) r[k] = from_[k] - p[k], d[k] = 0.0f * r[k] + way[k];
                const eight a = dot(d, d) + 1e-30f, c = dot(d, r), g = dot(e, e) + 1e-30f, f = dot(e, r), h = dot(d, e);
                const eight slope = a * g - h * h;
                eight s = within((h * f - c * g) / larger(slope, 1e-6f * a * g)), t = (h * s + f) / g;
                t = within(t);
                s = within((h * t - c) / a);
                for (int k = 0; k < 3; ++k) far[k] = r[k] + s * d[k] - t * e[k];
                const eight most = reach + b[15];
                in &= (dot(far, far) <= most * most);
            } else {
                const eight *x = b + 9, *m = b + 18;
                eight r[3], beyond = 0.0f * b[0];
                for (int k = 0; k < 3; ++k) {
                    for (int axis = 0; axis < 3; ++axis) r[axis] = from_[axis] - x[3 * k + axis];
                    beyond = larger(beyond, dot(r, m + 3 * k));
                }
                const eight above = dot(r, b + 6), most = reach + b[27];
                in &= (above * above + beyond * beyond <= most * most);
            }
            if (!__builtin_reduce_or(in)) return found;
        }
#ifdef __AVX__
        return unsigned(__builtin_ia32_movmskps256(reinterpret_cast<eight&>(in)));
#else
        for (int k = 0; k < 8; ++k) found |= (in[k] & 1u) << k;
        return found;
#endif
    };
    const float *leaves = of_edges ? tree.edge_nodes.data : tree.triangle_nodes.data;
    const int *starts = of_edges ? tree.edge_starts.data : tree.triangle_starts.data;
    const int *items = of_edges ? tree.edges.data : tree.triangles.data;
    int *to = tree.found.data, count = 0;
    const int first = tree.root_starts.data[world], last = tree.root_starts.data[world + 1];
    for (int r = first / 8; 8 * r < last; ++r)
        for (unsigned roots = hits(tree.roots.data, r, none, false); roots; roots &= roots - 1) {
            const int root = 8 * r + __builtin_ctz(roots);
            if (root < first || root >= last) continue;
            const bool is_own = tree.root_bodies.data[root] == body;
            if (is_own && !meets_itself) continue;
            for (unsigned upper = hits(tree.upper_nodes.data, root, none, false); upper; upper &= upper - 1) {
                const int u = 8 * root + __builtin_ctz(upper);
                for (unsigned lower = hits(tree.lower_nodes.data, u, none, false); lower; lower &= lower - 1) {
                    const int leaf = 8 * u + __builtin_ctz(lower);
                    for (int node = starts[leaf]; node < starts[leaf + 1]; ++node)
                        for (unsigned in = hits(leaves, node, is_own ? normal : none, true); in; in &= in - 1)
                            to[count++] = items[8 * node + __builtin_ctz(in)];
                }
            }
        }
    return count;
""",
        otherwise="return 0;\n",
    )
)
def query_wide(
    tree: WideTree,
    of_edges: int,
    world: int,
    body: int,
    meets_itself: int,
    low: wp.vec3,
    high: wp.vec3,
    out: wp.vec3,
    reach: float,
    from_: wp.vec3,
    way: wp.vec3,
) -> int:
    """Find the triangles near a node, or the edges near an edge, of a world.

    Args:
        of_edges: Whether it finds edges.
        world, body: Those of the node or edge.
        meets_itself: Whether things of the same body count.
        low, high: The box that those of others must overlap.
        out: A normal, or zero; things of the same body whose normals have a large cosine with it do not count.
        reach: How far beyond their own reach they may be from it [m]; negative: it does not matter.
        from_, way: The node, or the beginning of the edge and the way to its end.
    """
    ...


@wp.func
def write_row(nodes: wp.array[wp.float32], node: int, lane: int, row: int, value: wp.vec3):
    """Write three rows of a lane."""
    k = LANES * (ROWS * node + row) + lane
    for axis in range(3):
        nodes[k + LANES * axis] = value[axis]


@wp.func
def write_lane(nodes: wp.array[wp.float32], node: int, lane: int, low: wp.vec3, high: wp.vec3, normal: wp.vec3):
    write_row(nodes, node, lane, 0, low)
    write_row(nodes, node, lane, 3, high)
    write_row(nodes, node, lane, 6, normal)


@wp.kernel(enable_backward=False)
def fill_leaves(
    # In
    watch: Watch,
    surface: Surface,
    meeting: Meeting,
    lower: wp.array[wp.vec3],
    upper: wp.array[wp.vec3],
    edge_lower: wp.array[wp.vec3],
    edge_upper: wp.array[wp.vec3],
    # Out
    tree: WideTree,
):
    """Fill leaves with the boxes and normals of triangles and edges."""
    z = wp.tid()
    if watch.due[0] == 0:
        return
    low = wp.vec3(FAR, FAR, FAR)
    high = -low
    for node in range(tree.triangle_starts[z], tree.triangle_starts[z + 1]):
        for lane in range(LANES):
            t = tree.triangles[LANES * node + lane]
            if t >= 0:
                low = wp.min(low, lower[t])
                high = wp.max(high, upper[t])
                n = meeting.normals[t]
                c = surface.triangles[t]
                write_lane(tree.triangle_nodes, node, lane, lower[t], upper[t], n)
                for k in range(3):
                    x = surface.x[c[k]]
                    side = wp.normalize(wp.cross(surface.x[c[(k + 1) % 3]] - x, n))
                    write_row(tree.triangle_nodes, node, lane, 9 + 3 * k, x)
                    write_row(tree.triangle_nodes, node, lane, 18 + 3 * k, side)
                far = triangle_reach(surface, meeting, c) + BAND * triangle_size(surface, c)
                tree.triangle_nodes[LANES * (ROWS * node + 27) + lane] = NEARLY * far
    for node in range(tree.edge_starts[z], tree.edge_starts[z + 1]):
        for lane in range(LANES):
            e = tree.edges[LANES * node + lane]
            if e >= 0:
                low = wp.min(low, edge_lower[e])
                high = wp.max(high, edge_upper[e])
                out = meeting.outs[e]
                length = wp.length(out)
                # Others may touch whatever way they face.
                out = wp.where(length < BLUNT, wp.vec3(), out / length)
                write_lane(tree.edge_nodes, node, lane, edge_lower[e], edge_upper[e], out)
                a = surface.x[surface.edges[e][0]]
                way = surface.x[surface.edges[e][1]] - a
                write_row(tree.edge_nodes, node, lane, 9, a)
                write_row(tree.edge_nodes, node, lane, 12, way)
                far = edge_reach(meeting, surface.edges[e]) + BAND * wp.length(way)
                tree.edge_nodes[LANES * (ROWS * node + 15) + lane] = NEARLY * far
    write_lane(tree.lower_nodes, z / LANES, z % LANES, low, high, wp.vec3())


@wp.kernel(enable_backward=False)
def fill_nodes(watch: Watch, children: wp.array[wp.float32], nodes: wp.array[wp.float32]):
    """Fill nodes with the boxes of their children."""
    n = wp.tid()
    if watch.due[0] == 0:
        return
    low = wp.vec3(FAR, FAR, FAR)
    high = -low
    for lane in range(LANES):
        for axis in range(3):
            k = LANES * (ROWS * n + axis) + lane
            low[axis] = wp.min(low[axis], children[k])
            high[axis] = wp.max(high[axis], children[k + 3 * LANES])
    write_lane(nodes, n / LANES, n % LANES, low, high, wp.vec3())
