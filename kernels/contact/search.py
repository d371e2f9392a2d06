"""Which nodes and triangles, and which edges, come near one another before it is looked at again."""

import warp as wp

from .closest import on_segments, on_triangle, point_of
from .motion import Surface
from .pairs import BAND, Meeting, Rows, triangle_normal

wp.set_module_options({"enable_backward": False})

#: How far a node may go until pairs are looked for again, over what it goes if it goes on as now.
AHEAD = wp.constant(2.0)
#: The sine of the angle from which on an edge is sharp.
SHARP = wp.constant(0.15)
#: Where boxes of nothing are [m].
NOWHERE = wp.constant(1.0e6)


@wp.kernel(enable_backward=False)
def reserve_motion(steps: int, least: float, surface: Surface, reach: wp.array[wp.float32]):
    """How far nodes may go in so many steps."""
    s = wp.tid()
    reach[s] = least + AHEAD * float(steps) * wp.length(surface.d[s])


@wp.func
def triangle_size(surface: Surface, c: wp.vec3i):
    a = surface.x[c[0]]
    return wp.sqrt(wp.length(wp.cross(surface.x[c[1]] - a, surface.x[c[2]] - a)))


@wp.func
def triangle_reach(surface: Surface, meeting: Meeting, c: wp.vec3i):
    return wp.max(meeting.reach[c[0]], wp.max(meeting.reach[c[1]], meeting.reach[c[2]]))


@wp.func
def edge_reach(meeting: Meeting, e: wp.vec2i):
    return wp.max(meeting.reach[e[0]], meeting.reach[e[1]])


@wp.kernel(enable_backward=False)
def box_triangles(surface: Surface, meeting: Meeting, lower: wp.array[wp.vec3], upper: wp.array[wp.vec3]):
    t = wp.tid()
    c = meeting.triangles[t]
    if c[0] < 0:
        lower[t] = wp.vec3(NOWHERE, NOWHERE, NOWHERE)
        upper[t] = lower[t]
        return
    a = surface.x[c[0]]
    b = surface.x[c[1]]
    e = surface.x[c[2]]
    far = triangle_reach(surface, meeting, c) + BAND * triangle_size(surface, c)
    beyond = wp.vec3(far, far, far)
    lower[t] = wp.min(a, wp.min(b, e)) - beyond
    upper[t] = wp.max(a, wp.max(b, e)) + beyond


@wp.kernel(enable_backward=False)
def box_edges(surface: Surface, meeting: Meeting, lower: wp.array[wp.vec3], upper: wp.array[wp.vec3]):
    k = wp.tid()
    e = meeting.edges[k]
    if e[0] < 0:
        lower[k] = wp.vec3(NOWHERE, NOWHERE, NOWHERE)
        upper[k] = lower[k]
        return
    a = surface.x[e[0]]
    b = surface.x[e[1]]
    far = edge_reach(meeting, e) + BAND * wp.length(b - a)
    beyond = wp.vec3(far, far, far)
    lower[k] = wp.min(a, b) - beyond
    upper[k] = wp.max(a, b) + beyond


@wp.func
def bend(surface: Surface, meeting: Meeting, k: int):
    """The sine by which the surface turns at an edge: positive where it stands out."""
    sides = meeting.sides[k]
    first = triangle_normal(surface, meeting.triangles[sides[0]])
    second = triangle_normal(surface, meeting.triangles[sides[1]])
    e = meeting.edges[k]
    c = meeting.triangles[sides[1]]
    middle = (surface.x[c[0]] + surface.x[c[1]] + surface.x[c[2]]) / 3.0
    turn = wp.length(wp.cross(first, second))
    if wp.dot(first, second) < 0.0:
        turn = 1.0
    if wp.dot(first, middle - surface.x[e[0]]) > 0.0:
        return -turn
    return turn


@wp.func
def is_sharp(surface: Surface, meeting: Meeting, k: int):
    if meeting.edges[k][0] < 0:
        return False
    return bend(surface, meeting, k) > SHARP


@wp.func
def may_meet(s: int, r: int, surface: Surface, meeting: Meeting):
    if surface.world[s] != surface.world[r]:
        return False
    return meeting.meets_itself != 0 or meeting.body[s] != meeting.body[r]


@wp.func
def node_is_near(s: int, t: int, surface: Surface, meeting: Meeting):
    c = meeting.triangles[t]
    if c[0] < 0 or c[0] == s or c[1] == s or c[2] == s:
        return False
    if not may_meet(s, c[0], surface, meeting):
        return False
    a = surface.x[c[0]]
    b = surface.x[c[1]]
    e = surface.x[c[2]]
    x = surface.x[s]
    far = wp.length(x - point_of(on_triangle(x, a, b, e), a, b, e))
    return far <= meeting.reach[s] + triangle_reach(surface, meeting, c) + BAND * triangle_size(surface, c)


@wp.func
def edge_is_near(k: int, m: int, surface: Surface, meeting: Meeting):
    e = meeting.edges[k]
    f = meeting.edges[m]
    if f[0] < 0 or e[0] == f[0] or e[0] == f[1] or e[1] == f[0] or e[1] == f[1]:
        return False
    if not may_meet(e[0], f[0], surface, meeting):
        return False
    other = bend(surface, meeting, m)
    # Two sharp edges are found by the first of them.
    if other < -SHARP or (other > SHARP and m < k):
        return False
    p = surface.x[e[0]]
    q = surface.x[e[1]]
    a = surface.x[f[0]]
    b = surface.x[f[1]]
    s, t = on_segments(p, q, a, b)
    far = wp.length(p + s * (q - p) - a - t * (b - a))
    band = BAND * wp.min(wp.length(q - p), wp.length(b - a))
    return far <= edge_reach(meeting, e) + edge_reach(meeting, f) + band


@wp.kernel(enable_backward=False)
def find_pairs(
    # In
    writes: int,
    of_triangles: wp.uint64,
    of_edges: wp.uint64,
    surface: Surface,
    meeting: Meeting,
    old_starts: wp.array[wp.int32],
    old_other: wp.array[wp.int32],
    old_force: wp.array[wp.vec3],
    # Out
    counts: wp.array[wp.int32],
    rows: Rows,
):
    """Count the pairs of each node and edge; or write them, each with the force that it had before."""
    i = wp.tid()
    nodes = meeting.body.shape[0]
    count = int(0)
    if i < nodes:
        if surface.node[i] >= 0:
            reach = meeting.reach[i]
            beyond = wp.vec3(reach, reach, reach)
            query = wp.bvh_query_aabb(of_triangles, surface.x[i] - beyond, surface.x[i] + beyond)
            t = int(0)
            while wp.bvh_query_next(query, t):
                if node_is_near(i, t, surface, meeting):
                    if writes != 0:
                        write_pair(i, t, count, old_starts, old_other, old_force, rows)
                    count += 1
    else:
        k = i - nodes
        e = meeting.edges[k]
        if is_sharp(surface, meeting, k):
            a = surface.x[e[0]]
            b = surface.x[e[1]]
            reach = edge_reach(meeting, e)
            beyond = wp.vec3(reach, reach, reach)
            query = wp.bvh_query_aabb(of_edges, wp.min(a, b) - beyond, wp.max(a, b) + beyond)
            m = int(0)
            while wp.bvh_query_next(query, m):
                if edge_is_near(k, m, surface, meeting):
                    if writes != 0:
                        write_pair(i, m, count, old_starts, old_other, old_force, rows)
                    count += 1
    if writes == 0:
        counts[i] = count
        if i == 0:
            counts[counts.shape[0] - 1] = 0


@wp.func
def write_pair(
    owner: int,
    other: int,
    number: int,
    old_starts: wp.array[wp.int32],
    old_other: wp.array[wp.int32],
    old_force: wp.array[wp.vec3],
    rows: Rows,
):
    row = rows.starts[owner] + number
    if row >= rows.owner.shape[0]:
        return
    force = wp.vec3()
    for k in range(old_starts[owner], wp.min(old_starts[owner + 1], old_other.shape[0])):
        if old_other[k] == other:
            force = old_force[k]
    rows.owner[row] = owner
    rows.other[row] = other
    rows.force[row] = force


@wp.kernel(enable_backward=False)
def keep_rows(rows: Rows, old_starts: wp.array[wp.int32], old_other: wp.array[wp.int32], old_force: wp.array[wp.vec3]):
    """Keep the rows that there are beside those that are to come."""
    i = wp.tid()
    if i < rows.starts.shape[0]:
        old_starts[i] = rows.starts[i]
    if i < rows.other.shape[0]:
        old_other[i] = rows.other[i]
        old_force[i] = rows.force[i]


@wp.kernel(enable_backward=False)
def note_most(rows: Rows, most: wp.array[wp.float64]):
    """How many rows were needed, for the host."""
    most[0] = wp.max(most[0], wp.float64(rows.starts[rows.starts.shape[0] - 1]))


@wp.kernel(enable_backward=False)
def remember_places(surface: Surface, places: wp.array[wp.vec3]):
    """Where nodes are when pairs are looked for."""
    s = wp.tid()
    places[s] = surface.x[s]


@wp.kernel(enable_backward=False)
def check_reach(surface: Surface, reach: wp.array[wp.float32], places: wp.array[wp.vec3], missed: wp.array[wp.int32]):
    """Count nodes that have gone farther than pairs were looked for."""
    s = wp.tid()
    if surface.node[s] >= 0 and wp.length(surface.x[s] + surface.d[s] - places[s]) > reach[s]:
        wp.atomic_add(missed, 0, 1)


@wp.kernel(enable_backward=False)
def report_search(missed: wp.array[wp.int32], most: wp.array[wp.float64], report: wp.array[wp.float64]):
    """Tell the host how many rows were needed, and how often nodes went too far."""
    report[0] = wp.float64(most[0])
    report[1] = wp.float64(missed[0])
