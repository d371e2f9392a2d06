"""The search for nodes and triangles, and for edges, that may come near each other before the next search."""

import functools
from typing import Any

import warp as wp

from warp_corot.kernels.elements.elements import frame, local_gradient
from warp_corot.kernels.modules import INLINED, unique_kernel
from warp_corot.kernels.stepping.threads import lanes_with, of_first_lane, sum_before, synchronize_warp

from .bearing import share_bearers
from .locate import BORDER, ENDS, FACING, edge_normal, node_faces_at_rest
from .motion import Surface
from .rows import BAND, BAND_AT_REST, Meeting, OldRows, Rows
from .shapes import on_segments, on_triangle, point_of
from .watch import CRUSHED, PAIRED, Near, Watch, ahead_at, mark
from .wide_tree import (
    BLUNT,
    MAY_FACE,
    NEARLY,
    WideTree,
    edge_reach,
    lower_end,
    query_wide,
    triangle_reach,
    triangle_size,
    upper_end,
)

wp.set_module_options({"enable_backward": False})

#: Threads of a warp, and the number of neighbours that one keeps; if one has more, the warp finds all a second time.
LANES, KEPT = wp.constant(32), wp.constant(8)
Kept = wp.types.vector(length=8, dtype=wp.int32)

#: Edges with a larger sine of the bend are sharp.
SHARP = wp.constant(0.15)
#: The largest cosine between the normals of a node and a triangle of two bodies that may touch before the next search.
MAY_TOUCH = wp.constant(-0.3)


@wp.func
def bend(surface: Surface, meeting: Meeting, k: int):
    """The sine of the angle by which the surface bends at an edge, positive if the edge is convex."""
    sides = surface.sides[k]
    first = meeting.normals[sides[0]]
    second = meeting.normals[sides[1]]
    e = surface.edges[k]
    c = surface.triangles[sides[1]]
    middle = (surface.x[c[0]] + surface.x[c[1]] + surface.x[c[2]]) / 3.0
    turn = wp.length(wp.cross(first, second))
    if wp.dot(first, second) < 0.0:
        turn = 1.0
    if wp.dot(first, middle - surface.x[e[0]]) > 0.0:
        return -turn
    return turn


@wp.func
def may_meet(s: int, r: int, surface: Surface, meeting: Meeting):
    """Whether two places are in one world, and in two bodies or in one that touches itself."""
    return surface.world[s] == surface.world[r] and (meeting.meets_itself != 0 or surface.body[s] != surface.body[r])


@wp.func
def node_normal(s: int, surface: Surface, meeting: Meeting):
    """The direction of the sum of the normals around a node."""
    out = wp.vec3()
    for k in range(surface.corner_starts[s], surface.corner_starts[s + 1]):
        out += meeting.normals[surface.corners[k] / 3]
    return wp.normalize(out)


@wp.func
def may_face(s: int, out: wp.vec3, n: wp.vec3, surface: Surface, meeting: Meeting):
    """Whether a node with the normal ``out`` may touch a triangle with the normal n before the next search: one of the
    faces around the node, or all together, must face it. A node in a plane face that lies on another body's rim does
    not touch the faces beyond that rim, which would hold it back.
    """
    # Nearly all that are near face the triangle together.
    if wp.dot(out, n) < MAY_TOUCH:
        return True
    for k in range(surface.corner_starts[s], surface.corner_starts[s + 1]):
        if wp.dot(meeting.normals[surface.corners[k] / 3], n) < MAY_TOUCH:
            return True
    return False


@wp.func
def is_beside(way: wp.vec3, normal: wp.vec3, far: float, size: float, longest: float):
    """Whether a node behind the plane of a triangle is so far beside the triangle that it cannot come below it before
    the next search.

    Args:
        way: From the closest point of the triangle to the node.
        far: How far the two may move relative to each other [m].
        size, longest: The triangle's size, and its longest side [m].
    """
    depth = -wp.dot(way, normal)
    # The triangle may tilt by twice its corners' motion over its least height, and counts a little beyond its border.
    aside = far * (1.0 + 2.0 * depth * longest / (size * size)) + BORDER * size
    return wp.length(way + depth * normal) > aside


@wp.func
def approach(s: int, r: int, meeting: Meeting):
    """How far two places are expected to move relative to each other in an implicit step [m]."""
    return wp.length(ahead_at(s, meeting.ahead) - ahead_at(r, meeting.ahead))


@wp.func
def node_is_near(s: int, t: int, out: wp.vec3, surface: Surface, meeting: Meeting, near: Near):
    """Whether a node and a triangle may touch before the next search; ``out`` is the normal at the node."""
    c = surface.triangles[t]
    if c[0] < 0 or not may_meet(s, c[0], surface, meeting):
        return False
    if c[0] == s or c[1] == s or c[2] == s or surface.opposite[t] == s:
        return False
    normal = meeting.normals[t]
    is_own = surface.body[s] == surface.body[c[0]]
    if is_own and wp.dot(out, normal) > MAY_FACE:
        return False
    a = surface.x[c[0]]
    b = surface.x[c[1]]
    e = surface.x[c[2]]
    x = surface.x[s]
    way = x - point_of(on_triangle(x, a, b, e), a, b, e)
    distance = wp.length(way)
    nearing = float(0.0)
    far = meeting.reach[s] + triangle_reach(surface, meeting, c)
    for k in range(3):
        nearing = wp.max(nearing, approach(s, c[k], meeting))
    far += nearing
    if distance > far:
        size = triangle_size(surface, c)
        if wp.dot(way, normal) >= 0.0 or not (distance <= far + BAND * size):
            return False
        if is_beside(way, normal, far, size, wp.max(wp.length(b - a), wp.max(wp.length(e - b), wp.length(a - e)))):
            return False
        if is_own:
            # Deeper nodes of the same body do not count as touching; see ``locate.deepest``.
            apart = surface.rest[s] - surface.rest[c[0]]
            most = wp.max(wp.length(apart), wp.length(surface.rest[s] - surface.rest[c[1]]))
            most = wp.max(most, wp.length(surface.rest[s] - surface.rest[c[2]]))
            if distance > far + BAND_AT_REST * most and not node_faces_at_rest(s, c, apart, surface):
                return False
    if not is_own:
        return may_face(s, out, normal, surface, meeting)
    # Inverted elements have passed through their own body and have to get back.
    flags = near.flags[s] | near.flags[c[0]] | near.flags[c[1]] | near.flags[c[2]]
    if (flags & CRUSHED) != 0:
        return False
    are_apart = bool(True)
    for k in range(3):
        are_apart = are_apart and not share_bearers(s, c[k], surface)
    return are_apart


@wp.func
def is_opposite(e: wp.vec2i, m: int, surface: Surface):
    """Whether an edge lies opposite to edge m in a tetrahedron at one of its triangles."""
    f = surface.edges[m]
    for k in range(2):
        t = surface.sides[m][k]
        c = surface.triangles[t]
        a = surface.opposite[t]
        b = c[0] + c[1] + c[2] - f[0] - f[1]
        if (e[0] == a and e[1] == b) or (e[0] == b and e[1] == a):
            return True
    return False


@wp.func
def flat_edges_cross(k: int, m: int, far: float, s: float, t: float, way: wp.vec3, surface: Surface):
    """Whether flat edges k and m of surfaces that face each other may cross before the next search.

    Args:
        far: How far the two may move relative to each other [m].
        s, t: Where they are closest, as shares of their lengths.
        way: From there on m to there on k [m].
    """
    e = surface.edges[k]
    f = surface.edges[m]
    out = edge_normal(surface, m)
    if wp.dot(out, edge_normal(surface, k)) > FACING:
        return False
    if wp.length(way - wp.dot(way, out) * out) > far:
        return False
    of_first = ENDS - far / wp.length(surface.x[e[1]] - surface.x[e[0]])
    of_second = ENDS - far / wp.length(surface.x[f[1]] - surface.x[f[0]])
    return wp.min(s, 1.0 - s) >= of_first and wp.min(t, 1.0 - t) >= of_second


@wp.func
def face_away(first: wp.vec3, second: wp.vec3):
    """Whether two blunt edges of a body face so much the same way that they cannot touch before the next search, from
    the sums of their normals."""
    if wp.min(wp.length(first), wp.length(second)) < BLUNT:
        return False
    return wp.dot(first, second) > MAY_FACE * wp.length(first) * wp.length(second)


@wp.func
def edge_is_near(k: int, m: int, is_sharp: bool, out: wp.vec3, surface: Surface, meeting: Meeting, near: Near):
    """Whether two edges may cross before the next search; ``out`` is the sum of the normals at the first."""
    e = surface.edges[k]
    f = surface.edges[m]
    if f[0] < 0 or not may_meet(e[0], f[0], surface, meeting):
        return False
    if e[0] == f[0] or e[0] == f[1] or e[1] == f[0] or e[1] == f[1]:
        return False
    is_own = surface.body[e[0]] == surface.body[f[0]]
    if is_own and face_away(out, meeting.outs[m]):
        return False
    p = surface.x[e[0]]
    q = surface.x[e[1]]
    a = surface.x[f[0]]
    b = surface.x[f[1]]
    s, t = on_segments(p, q, a, b)
    way = p + s * (q - p) - a - t * (b - a)
    band = BAND * wp.min(wp.length(q - p), wp.length(b - a))
    far = edge_reach(meeting, e) + edge_reach(meeting, f)
    far += wp.max(
        wp.max(approach(e[0], f[0], meeting), approach(e[0], f[1], meeting)),
        wp.max(approach(e[1], f[0], meeting), approach(e[1], f[1], meeting)),
    )
    if not (wp.length(way) <= far + band) or is_opposite(e, m, surface):
        return False
    if is_own:
        flags = near.flags[e[0]] | near.flags[e[1]] | near.flags[f[0]] | near.flags[f[1]]
        if (flags & CRUSHED) != 0:
            return False
        for n in range(2):
            if share_bearers(e[n], f[0], surface) or share_bearers(e[n], f[1], surface):
                return False
    other = bend(surface, meeting, m)
    # Sharp edges find flat ones; the first of two sharp or flat edges finds the pair.
    if other < -SHARP:
        return False
    if is_sharp:
        return other <= SHARP or m > k
    return other <= SHARP and m > k and flat_edges_cross(k, m, far, s, t, way, surface)


@wp.struct
class Owner:
    """What looks for its neighbours: a node or an edge."""

    place: int  # a node of it; -1: there is nothing to look for
    is_edge: int
    is_sharp: wp.bool
    out: wp.vec3  # its normal, or the sum of both sides' ones
    low: wp.vec3  # its box, with what it may move [m]
    high: wp.vec3
    reach: float  # how far it may move [m]


@wp.func
def owner_of(i: int, surface: Surface, meeting: Meeting):
    """The node or the edge with a number; an edge looks for others if it is sharp, or flat if these touch."""
    nodes = surface.node.shape[0]
    found = Owner()
    found.place = -1
    if i < nodes:
        if surface.node[i] >= 0:
            found.place = i
            found.out = node_normal(i, surface, meeting)
            found.reach = meeting.reach[i]
            found.low = lower_end(i, surface, meeting)
            found.high = upper_end(i, surface, meeting)
    else:
        e = surface.edges[i - nodes]
        if e[0] >= 0:
            own = bend(surface, meeting, i - nodes)
            if own > SHARP or (own >= -SHARP and meeting.flat_edges != 0):
                found.place = e[0]
                found.is_edge = 1
                found.is_sharp = own > SHARP
                found.out = meeting.outs[i - nodes]
                found.reach = edge_reach(meeting, e)
                found.low = wp.min(lower_end(e[0], surface, meeting), lower_end(e[1], surface, meeting))
                found.high = wp.max(upper_end(e[0], surface, meeting), upper_end(e[1], surface, meeting))
    beyond = wp.vec3(found.reach, found.reach, found.reach)
    found.low -= beyond
    found.high += beyond
    return found


@wp.func
def is_near(i: int, other: int, owner: Owner, surface: Surface, meeting: Meeting, near: Near):
    """Whether an owner may touch a triangle or an edge before the next search."""
    if owner.is_edge != 0:
        k = i - surface.node.shape[0]
        return edge_is_near(k, other, owner.is_sharp, owner.out, surface, meeting, near)
    return node_is_near(i, other, owner.out, surface, meeting, near)


@wp.func
def places_in(owner: int, other: int, surface: Surface):
    """The places of a pair."""
    nodes = surface.node.shape[0]
    if owner < nodes:
        c = surface.triangles[other]
        return wp.vec4i(owner, c[0], c[1], c[2])
    e = surface.edges[owner - nodes]
    f = surface.edges[other]
    return wp.vec4i(e[0], e[1], f[0], f[1])


@wp.func
def distance_in(owner: int, other: int, surface: Surface, meeting: Meeting):
    """How far the two of a pair are apart at least; zero if they overlap [m]."""
    nodes = surface.node.shape[0]
    if owner < nodes:
        c = surface.triangles[other]
        a = surface.x[c[0]]
        b = surface.x[c[1]]
        e = surface.x[c[2]]
        way = surface.x[owner] - point_of(on_triangle(surface.x[owner], a, b, e), a, b, e)
        # A gap may be less than the distance where a node is beside a triangle; see ``locate_node``.
        far = wp.length(way) - BORDER * triangle_size(surface, c)
        return wp.where(wp.dot(way, meeting.normals[other]) < 0.0, 0.0, wp.max(far, 0.0))
    f = surface.edges[owner - nodes]
    g = surface.edges[other]
    p = surface.x[f[0]]
    q = surface.x[f[1]]
    r = surface.x[g[0]]
    u = surface.x[g[1]]
    s, t = on_segments(p, q, r, u)
    band = BAND * wp.min(wp.length(q - p), wp.length(u - r))
    return wp.max(wp.length(p + s * (q - p) - r - t * (u - r)) - band, 0.0)


@functools.cache
def pair_finder(is_wide: bool) -> wp.Kernel:
    """The search for pairs, in a wide tree by one thread of the CPU for each owner, or in a tree of Warp's by a warp of
    CUDA, whose threads go through the tree together and each test one of the next 32 candidates: few owners are near
    anything, so that a thread for each would wait for memory most of the time."""
    lanes = 1 if is_wide else LANES

    @wp.func
    def find_in_wide_tree(i: int, owner: Owner, tree: WideTree, surface: Surface, meeting: Meeting, near: Near):
        """How many neighbours there are, which are then the first ones of ``tree.found``."""
        way = wp.vec3()
        out = owner.out
        if owner.is_edge != 0:
            way = surface.x[surface.edges[i - surface.node.shape[0]][1]] - surface.x[owner.place]
            out = wp.where(wp.length(out) < BLUNT, wp.vec3(), wp.normalize(out))
        reach = wp.where(meeting.ahead.shape[0] > 0, -1.0, NEARLY * owner.reach)
        world = surface.world[owner.place]
        found = query_wide(
            tree, owner.is_edge, world, surface.body[owner.place], meeting.meets_itself, owner.low, owner.high, out,
            reach, surface.x[owner.place], way,
        )  # fmt: skip
        count = int(0)
        for k in range(found):
            other = tree.found[k]
            if is_near(i, other, owner, surface, meeting, near):
                tree.found[count] = other
                count += 1
        return count

    @wp.func
    def find_by_warp(
        i: int, lane: int, start: int, owner: Owner, of_triangles: wp.uint64, of_edges: wp.uint64, surface: Surface,
        meeting: Meeting, near: Near, rows: Rows, kept: Kept,
    ):  # fmt: skip
        """Count the neighbours, and those that this thread has found; it keeps the first ones. If a start is given,
        write all of them instead, in any order."""
        count = int(0)
        mine = int(0)
        tree = of_triangles
        if owner.is_edge != 0:
            tree = of_edges
        for body in range(meeting.roots.shape[2]):
            if meeting.meets_itself != 0 or body != surface.body[owner.place]:
                root = meeting.roots[owner.is_edge, surface.world[owner.place], body]
                query = wp.bvh_query_aabb(tree, owner.low, owner.high, root)
                goes_on = bool(True)
                while goes_on:
                    held = int(-1)
                    number = int(0)
                    while goes_on and number < LANES:
                        other = int(0)
                        goes_on = wp.bvh_query_next(query, other)
                        if goes_on:
                            if number == lane:
                                held = other
                            number += 1
                    found = int(0)
                    if held >= 0:
                        found = int(is_near(i, held, owner, surface, meeting, near))
                    at = count + sum_before(found)
                    if found != 0:
                        if start >= 0:
                            rows.acts[start + at] = held
                        elif mine < KEPT:
                            kept[mine] = held
                        mine += 1
                    count += lanes_with(found)
        return count, mine, kept

    @unique_kernel(cpu_compiler_flags=INLINED)
    def find_pairs(
        # In
        watch: Watch,
        tree: WideTree,
        of_triangles: wp.uint64,
        of_edges: wp.uint64,
        surface: Surface,
        meeting: Meeting,
        old: OldRows,
        # Out
        rows: Rows,
        near: Near,
    ):
        """Find the pairs of each node and edge, with their former forces."""
        thread = wp.tid()
        if watch.due[0] == 0:
            return
        i = thread // lanes
        lane = thread % lanes
        room = rows.owner.shape[0]
        owner = owner_of(i, surface, meeting)
        count = int(0)
        mine = int(0)
        kept = Kept()
        if owner.place >= 0:
            if wp.static(is_wide):
                count = find_in_wide_tree(i, owner, tree, surface, meeting, near)
            else:
                count, mine, kept = find_by_warp(
                    i, lane, -1, owner, of_triangles, of_edges, surface, meeting, near, rows, kept
                )
        start = int(0)
        if lane == 0 and count > 0:
            start = wp.atomic_add(rows.total, 0, count)
        start = of_first_lane(start)
        is_full = start + count > room
        if lane == 0:
            rows.starts[i] = start
            rows.counts[i] = wp.where(is_full, 0, count)
        if is_full:
            # The host repeats the run with larger arrays.
            row = start + lane
            while row < room:
                rows.owner[row] = -1
                row += lanes
            return
        if count == 0:
            return
        # First in the order in which they were found, in the place of ``acts``, and then in that of their numbers.
        if wp.static(is_wide):
            for k in range(count):
                rows.acts[start + k] = tree.found[k]
        elif lanes_with(wp.where(mine > KEPT, 1, 0)) != 0:
            find_by_warp(i, lane, start, owner, of_triangles, of_edges, surface, meeting, near, rows, kept)
        else:
            first = start + sum_before(mine)
            for k in range(KEPT):
                if k < mine:
                    rows.acts[first + k] = kept[k]
        synchronize_warp()
        k = int(lane)
        while k < count:
            other = rows.acts[start + k]
            rank = int(0)
            for m in range(count):
                if rows.acts[start + m] < other:
                    rank += 1
            rows.other[start + rank] = other
            k += lanes
        synchronize_warp()
        before = old.starts[i]
        last = before + old.counts[i]
        row = start + lane
        while row < start + count:
            other = rows.other[row]
            while before < last and old.other[before] < other:
                before += 1
            acts = int(0)
            force = wp.vec3()
            if before < last and old.other[before] == other:
                acts = old.acts[before]
                force = old.force[before]
            places = places_in(i, other, surface)
            rows.owner[row] = i
            rows.acts[row] = acts
            rows.force[row] = force
            if wp.static(is_wide):
                rows.places[row] = places
                rows.away[row] = distance_in(i, other, surface, meeting)
            for m in range(4):
                mark(near, places[m], PAIRED)
            row += lanes

    return find_pairs


# --- inverted elements: signs of loads that a body cannot carry -------------------------------------------------------

#: The surface of elements below this volume ratio ignores contact with its own body.
FLAT = wp.constant(0.25)


@wp.func
def volume_ratio(elements: Any, t: int, u: wp.array[wp.vec4]):
    """det F."""
    q = frame(elements, t)
    return wp.determinant(q + local_gradient(elements, t, u)) * wp.determinant(q)


@functools.cache
def count_crushed(Elements: type) -> wp.Kernel:
    """Count elements with det F < 0 among all elements, or among those that are nonzero in ``counted``."""

    @unique_kernel()
    def count_crushed(elements: Elements, u: wp.array[wp.vec4], counted: wp.array[wp.int32], count: wp.array[wp.int32]):
        t = wp.tid()
        if counted.shape[0] > 0 and counted[t] == 0:
            return
        if volume_ratio(elements, t, u) < 0.0:
            wp.atomic_add(count, 0, 1)

    return count_crushed


@functools.cache
def mark_crushed(Elements: type) -> wp.Kernel:
    """Mark the surface at elements that are inverted or nearly so; ``places`` maps nodes to places, or to places among
    bearers, [nodes]."""

    @unique_kernel()
    def mark_crushed(
        watch: Watch,
        elements: Elements,
        u: wp.array[wp.vec4],
        places: wp.array[wp.int32],
        are_borne: int,
        surface: Surface,
        near: Near,
    ):
        t = wp.tid()
        if watch.due[0] == 0:
            return
        if volume_ratio(elements, t, u) < FLAT:
            nodes = elements.nodes[t]
            for k in range(4):
                place = places[nodes[k]]
                if place >= 0 and are_borne == 0:
                    wp.atomic_or(near.flags, place, CRUSHED)
                elif place >= 0:
                    for m in range(surface.bearing.starts[place], surface.bearing.starts[place + 1]):
                        wp.atomic_or(near.flags, surface.bearing.places[m], CRUSHED)

    return mark_crushed
