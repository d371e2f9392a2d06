"""Soft surfaces against one another: nodes against triangles, and edges against edges.

A row is one such pair: four nodes with a share each, positive on the one side and negative on the other, so that the
sum of shares times places is the way from the second side to the first. Rows are solved as ``triangles`` does it.
"""

import warp as wp

from warp_corot.kernels.stepping.pace import DT, Pace

from .closest import on_segments, on_triangle, point_of
from .law import Law, held_back, least_motion
from .motion import Surface
from .near import PAIRED, Near
from .vertices import across

wp.set_module_options({"enable_backward": False})

#: Overlaps up to this share of a triangle's or an edge's size are pushed apart; what is deeper is another part of the
#: body. Of a body with itself also this share of the way between the two at rest.
BAND = wp.constant(0.25)
#: So far from a triangle's border, as a share of its size, a node still is at the triangle.
BORDER = wp.constant(0.02)
#: The ends of edges where nodes are looked at instead, as a share; and the sine between edges that are not parallel.
ENDS = wp.constant(1.0e-3)
PARALLEL = wp.constant(0.05)


@wp.struct
class Meeting:
    """What may meet: triangles and edges of the surface, and which body they are of."""

    body: wp.array[wp.int32]  # [S]
    triangles: wp.array[wp.vec3i]  # [T]
    opposite: wp.array[wp.int32]  # [T] the fourth nodes of their tetrahedra, -1 inside the body
    edges: wp.array[wp.vec2i]  # [E] places, -1 where there is none
    sides: wp.array[wp.vec2i]  # [E] their two triangles
    reach: wp.array[wp.float32]  # [S] how far a node may go until pairs are looked for again [m]
    meets_itself: int
    friction: float


@wp.struct
class Rows:
    """Pairs that are near, [P], sorted by the first of the two, a node or an edge of S + E, and then by the other."""

    total: wp.array[wp.int32]  # [1] how many there are, or were if there were room
    starts: wp.array[wp.int32]  # [S + E]
    counts: wp.array[wp.int32]  # [S + E]
    owner: wp.array[wp.int32]  # the node, or S and the edge; -1 for none
    other: wp.array[wp.int32]  # the triangle, or the edge
    places: wp.array[wp.vec4i]
    shares: wp.array[wp.vec4]
    normal: wp.array[wp.vec3]  # from the second to the first
    gap: wp.array[wp.float32]
    acts: wp.array[wp.int32]
    force: wp.array[wp.vec3]  # on the first [N]
    more: wp.array[wp.vec3]


@wp.func
def row_count(rows: Rows):
    return wp.min(rows.total[0], rows.owner.shape[0])


@wp.func
def triangle_normal(surface: Surface, c: wp.vec3i):
    a = surface.x[c[0]]
    return wp.normalize(wp.cross(surface.x[c[1]] - a, surface.x[c[2]] - a))


@wp.func
def edge_normal(surface: Surface, meeting: Meeting, e: int):
    sides = meeting.sides[e]
    first = triangle_normal(surface, meeting.triangles[sides[0]])
    second = triangle_normal(surface, meeting.triangles[sides[1]])
    return wp.normalize(first + second)


@wp.func
def deepest(size: float, is_self: bool, apart: wp.vec3):
    band = BAND * size
    if is_self:
        band = wp.min(band, BAND * wp.length(apart))
    return -band


@wp.func
def locate_node(row: int, s: int, t: int, surface: Surface, meeting: Meeting, rows: Rows):
    """A node at a triangle."""
    c = meeting.triangles[t]
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
    apart = surface.rest[s] - point_of(w, surface.rest[c[0]], surface.rest[c[1]], surface.rest[c[2]])
    rows.places[row] = wp.vec4i(s, c[0], c[1], c[2])
    rows.shares[row] = wp.vec4(1.0, -w[0], -w[1], -w[2])
    rows.normal[row] = n
    rows.gap[row] = gap
    return gap > deepest(size, meeting.body[s] == meeting.body[c[0]], apart)


@wp.func
def locate_edge(row: int, first: int, second: int, surface: Surface, meeting: Meeting, rows: Rows):
    """Two edges that cross."""
    f = meeting.edges[first]
    g = meeting.edges[second]
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
    out_of_first = edge_normal(surface, meeting, first)
    out_of_second = edge_normal(surface, meeting, second)
    if wp.dot(n, out_of_second - out_of_first) < 0.0:
        n = -n
    # Out of the second, into the first: others face one another somewhere else.
    if wp.dot(n, out_of_second) < 0.1 or wp.dot(n, out_of_first) > -0.1:
        return False
    gap = wp.dot(n, p + s * (q - p) - a - t * (b - a))
    apart = surface.rest[f[0]] + s * (surface.rest[f[1]] - surface.rest[f[0]])
    apart -= surface.rest[g[0]] + t * (surface.rest[g[1]] - surface.rest[g[0]])
    rows.places[row] = wp.vec4i(f[0], f[1], g[0], g[1])
    rows.shares[row] = wp.vec4(1.0 - s, s, -(1.0 - t), -t)
    rows.normal[row] = n
    rows.gap[row] = gap
    return gap > deepest(size, meeting.body[f[0]] == meeting.body[g[0]], apart)


@wp.func
def opened(row: int, surface: Surface, rows: Rows):
    """How much farther the two are apart at the end of the step [m]."""
    p = rows.places[row]
    w = rows.shares[row]
    d = w[0] * surface.d[p[0]] + w[1] * surface.d[p[1]]
    return d + w[2] * surface.d[p[2]] + w[3] * surface.d[p[3]]


@wp.func
def push(row: int, force: wp.vec3, rows: Rows, added: wp.array[wp.vec3]):
    p = rows.places[row]
    w = rows.shares[row]
    for k in range(4):
        wp.atomic_add(added, p[k], w[k] * force)


@wp.func
def locate_row(row: int, surface: Surface, meeting: Meeting, rows: Rows, added: wp.array[wp.vec3]):
    nodes = meeting.body.shape[0]
    owner = rows.owner[row]
    is_near = bool(False)
    if owner >= nodes:
        is_near = locate_edge(row, owner - nodes, rows.other[row], surface, meeting, rows)
    elif owner >= 0:
        is_near = locate_node(row, owner, rows.other[row], surface, meeting, rows)
    was = rows.force[row]
    rows.force[row] = wp.vec3()
    rows.acts[row] = 0
    if not is_near:
        rows.shares[row] = wp.vec4()
        return
    n = rows.normal[row]
    # The whole of it: if a part were lost in each step, surfaces would sink in by what brings it back, and creep.
    normal_force = wp.max(wp.dot(was, n), 0.0)
    if normal_force > 0.0:
        force = normal_force * n + held_back(across(was, n), normal_force, meeting.friction)
        rows.force[row] = force
        push(row, force, rows, added)


@wp.func
def missing(row: int, law: Law, dt: float, surface: Surface, rows: Rows):
    """How much more the pair must open [m]."""
    return least_motion(rows.gap[row], law, dt) - wp.dot(opened(row, surface, rows), rows.normal[row])


@wp.func
def judge_row(row: int, law: Law, dt: float, surface: Surface, rows: Rows, crowd: wp.array[wp.float32]):
    w = rows.shares[row]
    acts = int(0)
    if w[0] > 0.0:
        force = wp.dot(rows.force[row], rows.normal[row])
        if force > 0.0 or missing(row, law, dt, surface, rows) > 0.0:
            acts = 1
            p = rows.places[row]
            for k in range(4):
                wp.atomic_add(crowd, p[k], wp.abs(w[k]))
    rows.acts[row] = acts


@wp.func
def solve_row(
    row: int,
    law: Law,
    dt: float,
    surface: Surface,
    friction: float,
    crowd: wp.array[wp.float32],
    rows: Rows,
    added: wp.array[wp.vec3],
):
    if rows.acts[row] == 0:
        return
    p = rows.places[row]
    w = rows.shares[row]
    yielding = float(0.0)
    for k in range(4):
        yielding += wp.abs(w[k]) * crowd[p[k]] * surface.yielding[p[k]]
    if yielding <= 0.0:
        return
    n = rows.normal[row]
    before = rows.force[row]
    normal_force = wp.max(wp.dot(before, n) + missing(row, law, dt, surface, rows) / yielding, 0.0)
    slip = across(opened(row, surface, rows), n)
    force = normal_force * n + held_back(across(before, n) - slip / yielding, normal_force, friction)
    rows.force[row] = force
    push(row, force - before, rows, added)


# --- all of them, however many threads there are --------------------------------------------------------------------


@wp.kernel(enable_backward=False)
def locate_rows(threads: int, surface: Surface, meeting: Meeting, rows: Rows, added: wp.array[wp.vec3]):
    """Where each pair is closest, and the force with which it begins: that of the last step."""
    row = wp.tid()
    count = row_count(rows)
    while row < count:
        locate_row(row, surface, meeting, rows, added)
        row += threads


@wp.kernel(enable_backward=False)
def judge_rows(threads: int, law: Law, pace: Pace, surface: Surface, rows: Rows, crowd: wp.array[wp.float32]):
    """Which pairs act, and the sum of their shares at each node."""
    row = wp.tid()
    count = row_count(rows)
    dt = float(pace.seconds[DT])
    while row < count:
        judge_row(row, law, dt, surface, rows, crowd)
        row += threads


@wp.kernel(enable_backward=False)
def solve_rows(
    # In
    threads: int,
    law: Law,
    pace: Pace,
    surface: Surface,
    friction: float,
    crowd: wp.array[wp.float32],
    # In and out
    rows: Rows,
    # Out
    added: wp.array[wp.vec3],
):
    """Correct the force of each pair that acts."""
    row = wp.tid()
    count = row_count(rows)
    dt = float(pace.seconds[DT])
    while row < count:
        solve_row(row, law, dt, surface, friction, crowd, rows, added)
        row += threads


@wp.kernel(enable_backward=False)
def apply_added(threads: int, near: Near, surface: Surface, added: wp.array[wp.vec3], crowd: wp.array[wp.float32]):
    """Give nodes what was added to their forces."""
    k = wp.tid()
    count = near.count[0]
    while k < count:
        s = near.nodes[k]
        k += threads
        if (near.flags[s] & PAIRED) != 0:
            crowd[s] = 0.0
            force = added[s]
            if wp.dot(force, force) > 0.0:
                surface.f[s] = surface.f[s] + force
                surface.d[s] = surface.d[s] + surface.yielding[s] * force
                added[s] = wp.vec3()
