"""The closest points of nodes and triangles, and of edges and edges."""

import warp as wp

from .bearing import is_borne
from .explicit_rows import FORESEEN, WAITS, begin_row
from .law import Law
from .motion import Surface
from .rows import BAND, BAND_AT_REST, BAND_OF_NEIGHBOURS, Rows, triangle_normal
from .shapes import on_segments, on_triangle, point_of

wp.set_module_options({"enable_backward": False})

#: The largest cosine between the normals of two surfaces that face each other.
FACING = wp.constant(-0.5)
#: A node's surface faces a triangle if the cosine between the outward normals of both is below minus this.
ACROSS = wp.constant(0.1)
#: Triangles whose height is less than this fraction of the longest side are slivers.
SLIVER = wp.constant(0.1)
#: A node this far outside a triangle's border, relative to the triangle's size, still counts as being at the triangle.
BORDER = wp.constant(0.02)
#: Motion is rounded by less than this.
ROUNDED = wp.constant(1.0001)
#: Fraction of an edge at each end that is left to its nodes; and the least sine of the angle between edges that are not
#: parallel.
ENDS = wp.constant(1.0e-3)
PARALLEL = wp.constant(0.05)


@wp.func
def firm_normal(surface: Surface, c: wp.vec3i):
    """The normal of a triangle, shorter the more of a sliver that is: some slivers at rims of own surfaces are turned
    over."""
    a = surface.x[c[0]]
    b = surface.x[c[1]] - a
    d = surface.x[c[2]] - a
    n = wp.cross(b, d)
    longest = wp.max(wp.max(wp.length_sq(b), wp.length_sq(d)), wp.length_sq(d - b))
    return n / wp.max(wp.length(n), SLIVER * longest)


@wp.func
def edge_normal(surface: Surface, e: int):
    sides = surface.sides[e]
    first = triangle_normal(surface, surface.triangles[sides[0]])
    second = triangle_normal(surface, surface.triangles[sides[1]])
    return wp.normalize(first + second)


@wp.func
def deepest(size: float, is_self: bool, apart: wp.vec3):
    band = BAND * size
    if is_self:
        band = wp.min(band, BAND_AT_REST * wp.length(apart))
    return -band


@wp.func
def rest_normal(surface: Surface, c: wp.vec3i):
    a = surface.rest[c[0]]
    return wp.normalize(wp.cross(surface.rest[c[1]] - a, surface.rest[c[2]] - a))


@wp.func
def face_at_rest(out: wp.vec3, n: wp.vec3, apart: wp.vec3):
    """Whether two parts of a body face each other at rest, as those beside a slit do.

    Args:
        out, n: The normals at the first and at the second.
        apart: The way from the second to the first [m].
    """
    return wp.dot(out, n) < FACING * wp.length(out) * wp.length(n) and wp.dot(apart, n) >= 0.0


@wp.func
def node_faces_at_rest(s: int, c: wp.vec3i, apart: wp.vec3, surface: Surface):
    out = wp.vec3()
    for k in range(surface.corner_starts[s], surface.corner_starts[s + 1]):
        out += rest_normal(surface, surface.triangles[surface.corners[k] / 3])
    return face_at_rest(out, rest_normal(surface, c), apart)


@wp.func
def rest_edge_normal(e: int, surface: Surface):
    sides = surface.sides[e]
    first = rest_normal(surface, surface.triangles[sides[0]])
    return first + rest_normal(surface, surface.triangles[sides[1]])


@wp.func
def are_neighbours(s: int, c: wp.vec3i, surface: Surface):
    """Whether an edge of the surface leads from a node to a corner of a triangle."""
    for k in range(surface.corner_starts[s], surface.corner_starts[s + 1]):
        q = surface.triangles[surface.corners[k] / 3][(surface.corners[k] + 1) % 3]
        if q == c[0] or q == c[1] or q == c[2]:
            return True
    return False


@wp.func
def faces(s: int, n: wp.vec3, surface: Surface):
    """Whether a surface with the normal n is one that a node may touch: one of the faces around the node, or all
    together, must face it.
    """
    out = wp.vec3()
    for k in range(surface.corner_starts[s], surface.corner_starts[s + 1]):
        each = firm_normal(surface, surface.triangles[surface.corners[k] / 3])
        if wp.dot(each, n) < FACING:
            return True
        out += each
    return wp.dot(out, n) < FACING * wp.length(out)


@wp.func
def is_nearer_to_a_side(s: int, t: int, w: wp.vec3, n: wp.vec3, depth: float, size: float, surface: Surface):
    """Whether a node that is behind a triangle has a shorter way out over a sharp side of it, where another triangle
    takes it: one that the node faces and is behind. So a bar on the rim of a block is not pushed off its side.

    Args:
        w: Barycentric coordinates of the closest point.
        n: The triangle's normal.
        depth: How far behind it the node is [m].
        size: Root of twice its area [m].
    """
    c = surface.triangles[t]
    for k in range(3):
        i = c[(k + 1) % 3]
        j = c[(k + 2) % 3]
        side = wp.length(surface.x[j] - surface.x[i])
        if depth * side > w[k] * size * size:
            for m in range(surface.corner_starts[i], surface.corner_starts[i + 1]):
                other = surface.corners[m] / 3
                d = surface.triangles[other]
                if other != t and (d[0] == j or d[1] == j or d[2] == j):
                    beside = triangle_normal(surface, d)
                    middle = (surface.x[d[0]] + surface.x[d[1]] + surface.x[d[2]]) / 3.0
                    is_sharp = wp.dot(beside, n) < -FACING and wp.dot(middle - surface.x[i], n) < 0.0
                    below = -wp.dot(surface.x[s] - surface.x[i], beside)
                    if is_sharp and below > 0.0 and below < depth and faces(s, beside, surface):
                        v = on_triangle(surface.x[s], surface.x[d[0]], surface.x[d[1]], surface.x[d[2]])
                        if wp.min(v) > 0.0:
                            return True
    return False


@wp.func
def locate_node(row: int, s: int, t: int, surface: Surface, rows: Rows):
    """A node at a triangle."""
    c = surface.triangles[t]
    a = surface.x[c[0]]
    b = surface.x[c[1]]
    e = surface.x[c[2]]
    x = surface.x[s]
    w = on_triangle(x, a, b, e)
    way = x - point_of(w, a, b, e)
    n = triangle_normal(surface, c)
    size = wp.sqrt(wp.length(wp.cross(b - a, e - a)))
    length = wp.length(way)
    gap = wp.dot(way, n)
    if wp.min(w) <= 0.0 and length > BORDER * size:
        if gap < 0.0:
            return False
        n = way / length
        gap = length
        if not faces(s, n, surface):
            return False
    # Points of own surfaces may not be at the other triangle, because several share the nodes that bear them.
    if gap < 0.0 and not is_borne(s, surface) and is_nearer_to_a_side(s, t, w, n, -gap, size, surface):
        return False
    rows.places[row] = wp.vec4i(s, c[0], c[1], c[2])
    rows.weights[row] = wp.vec4(1.0, -w[0], -w[1], -w[2])
    rows.normal[row] = n
    rows.gap[row] = gap
    is_self = surface.body[s] == surface.body[c[0]]
    apart = wp.vec3()
    if is_self:
        apart = surface.rest[s] - point_of(w, surface.rest[c[0]], surface.rest[c[1]], surface.rest[c[2]])
    if is_self and gap < -BAND_OF_NEIGHBOURS * wp.length(apart) and are_neighbours(s, c, surface):
        return False
    if gap > deepest(size, is_self, apart):
        return True
    return gap > -BAND * size and node_faces_at_rest(s, c, apart, surface)


@wp.func
def locate_edge(row: int, first: int, second: int, surface: Surface, rows: Rows):
    """Two edges that cross."""
    f = surface.edges[first]
    g = surface.edges[second]
    p = surface.x[f[0]]
    q = surface.x[f[1]]
    a = surface.x[g[0]]
    b = surface.x[g[1]]
    s, t = on_segments(p, q, a, b)
    if wp.min(s, t) < ENDS or wp.max(s, t) > 1.0 - ENDS:
        return False
    n = wp.cross(q - p, b - a)
    size = wp.min(wp.length(q - p), wp.length(b - a))
    length = wp.length(n)
    if length < PARALLEL * wp.length(q - p) * wp.length(b - a):
        return False
    n = n / length
    out_of_first = edge_normal(surface, first)
    out_of_second = edge_normal(surface, second)
    if wp.dot(n, out_of_second - out_of_first) < 0.0:
        n = -n
    # The normal points out of the second body and into the first; other pairs face each other elsewhere.
    if wp.dot(n, out_of_second) < 0.1 or wp.dot(n, out_of_first) > -0.1:
        return False
    gap = wp.dot(n, p + s * (q - p) - a - t * (b - a))
    # The shorter way out is over an end, where its node touches a triangle.
    to_ends = wp.min(wp.min(s, 1.0 - s) * wp.length(q - p), wp.min(t, 1.0 - t) * wp.length(b - a))
    if gap < -to_ends:
        return False
    is_self = surface.body[f[0]] == surface.body[g[0]]
    apart = wp.vec3()
    if is_self:
        apart = surface.rest[f[0]] + s * (surface.rest[f[1]] - surface.rest[f[0]])
        apart -= surface.rest[g[0]] + t * (surface.rest[g[1]] - surface.rest[g[0]])
    rows.places[row] = wp.vec4i(f[0], f[1], g[0], g[1])
    rows.weights[row] = wp.vec4(1.0 - s, s, -(1.0 - t), -t)
    rows.normal[row] = n
    rows.gap[row] = gap
    if gap > deepest(size, is_self, apart):
        return True
    if gap <= -BAND * size:
        return False
    out = rest_edge_normal(first, surface)
    return face_at_rest(out, rest_edge_normal(second, surface), apart)


#: The largest cosine between the way to a node beyond a triangle's border and the next triangle.
LEANING = wp.constant(0.1)


@wp.func
def is_faced(row: int, s: int, surface: Surface, rows: Rows):
    """Whether the normal of a node at a triangle points into the node's body: otherwise the two face each other
    elsewhere. At a rim, where two faces meet, a node need not be above both.
    """
    out = wp.vec3()
    for k in range(surface.corner_starts[s], surface.corner_starts[s + 1]):
        out += firm_normal(surface, surface.triangles[surface.corners[k] / 3])
    return wp.dot(out, rows.normal[row]) <= -ACROSS * wp.length(out)


@wp.func
def leans_over(row: int, surface: Surface, rows: Rows):
    """Whether the way from the border of a triangle to a node leads over a neighbour of the triangle.

    Then the neighbour is closer, and its own pair counts. A plane across that way would hold back what slides over both
    triangles.
    """
    t = rows.other[row]
    c = surface.triangles[t]
    share = rows.weights[row]
    first = int(-1)
    last = int(-1)
    corners = int(0)
    point = wp.vec3()
    for i in range(3):
        if share[i + 1] < 0.0:
            corners += 1
            last = c[i]
            point -= share[i + 1] * surface.x[c[i]]
            if first < 0:
                first = c[i]
    if corners == 3 or first < 0:
        return False
    n = rows.normal[row]
    for k in range(surface.corner_starts[first], surface.corner_starts[first + 1]):
        at = surface.corners[k] % 3
        other = surface.corners[k] / 3
        e = surface.triangles[other]
        q = e[(at + 1) % 3]
        if corners == 2:
            r = e[(at + 2) % 3]
            if other == t or (q != last and r != last):
                continue
            if q == last:
                q = r
        inward = surface.x[q] - point
        along = wp.dot(n, inward)
        if along > 0.0 and along * along > LEANING * LEANING * wp.length_sq(inward):
            return True
    return False


@wp.func
def locate_facing(row: int, surface: Surface, rows: Rows) -> bool:
    """The closest points of a pair; whether it may touch."""
    nodes = surface.node.shape[0]
    owner = rows.owner[row]
    if owner >= nodes:
        return locate_edge(row, owner - nodes, rows.other[row], surface, rows)
    if owner < 0 or not locate_node(row, owner, rows.other[row], surface, rows):
        return False
    if not is_faced(row, owner, surface, rows):
        return False
    # Within a body, such pairs hold back parts of it that close on one another at rims.
    if surface.body[owner] == surface.body[surface.triangles[rows.other[row]][0]]:
        return True
    return not leans_over(row, surface, rows)


# --- pairs of an explicit step ----------------------------------------------------------------------------------------


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    const unsigned those = __ballot_sync(0xffffffffu, is_live != 0);
    if (those == 0) return;
    const int lane = threadIdx.x & 31, first = __ffs(those) - 1;
    int start = 0;
    if (lane == first) start = atomicAdd(&wp::index(count, 0), __popc(those));
    start = __shfl_sync(0xffffffffu, start, first);
    if (is_live != 0) wp::index(live, start + __popc(those & ((1u << lane) - 1u))) = row;
#else
    if (is_live != 0) wp::index(live, __atomic_fetch_add(&wp::index(count, 0), 1, __ATOMIC_RELAXED)) = row;
#endif
""")
def list_by_warp(live: wp.array[wp.int32], count: wp.array[wp.int32], row: int, is_live: int):
    """Add a row to a list, or not. All threads of a warp must call it: they ask for their places together."""
    ...


@wp.func
def is_apart(row: int, law: Law, surface: Surface, searched: wp.array[wp.vec3], rows: Rows):
    """Whether a pair without a force cannot touch in this step: the relative motion of its places has not used up the
    distance that was between them at the last search."""
    owner = rows.owner[row]
    if rows.acts[row] > WAITS or owner < 0:
        return owner < 0
    p = rows.places[row]
    first = wp.where(owner < surface.node.shape[0], 1, 2)
    most = float(0.0)
    for k in range(2):
        for m in range(1, 4):
            if k < first and m >= first:
                gone = surface.x[p[k]] - searched[p[k]] - surface.x[p[m]] + searched[p[m]]
                most = wp.max(most, wp.length(gone) + FORESEEN * wp.length(surface.d[p[k]] - surface.d[p[m]]))
    return ROUNDED * most + law.closing < rows.away[row]


@wp.func
def may_push(row: int, law: Law, surface: Surface, rows: Rows):
    """Whether a pair that has just been located may push in this step, whatever pushes its places."""
    w = rows.weights[row]
    if w[0] <= 0.0:
        return False
    force = rows.force[row]
    if wp.dot(force, force) > 0.0:
        return True
    gap = rows.gap[row]
    if gap <= law.closing:
        return True
    p = rows.places[row]
    most = float(0.0)
    for k in range(4):
        for m in range(4):
            if w[k] > 0.0 and w[m] < 0.0:
                most = wp.max(most, wp.length(surface.d[p[k]] - surface.d[p[m]]))
    return gap <= FORESEEN * most + law.closing


@wp.func
def locate_row(row: int, law: Law, surface: Surface, rows: Rows):
    """Find where a pair is closest, and the force with which it begins. Returns whether it may push in this step."""
    nodes = surface.node.shape[0]
    owner = rows.owner[row]
    is_near = bool(False)
    if owner >= nodes:
        is_near = locate_edge(row, owner - nodes, rows.other[row], surface, rows)
    elif owner >= 0:
        is_near = locate_node(row, owner, rows.other[row], surface, rows)
    if not is_near:
        rows.weights[row] = wp.vec4()
        rows.force[row] = wp.vec3()
        rows.more[row] = wp.vec3()
        rows.acts[row] = WAITS
        return False
    # All of it: if each step lost a part, surfaces would sink in until the overlap replaces that part, and would creep.
    begin_row(row, rows.force[row], 1.0, rows)
    return may_push(row, law, surface, rows)
