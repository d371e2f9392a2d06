"""The search for pairs of soft surfaces on CUDA: a warp for each node and edge.

All its threads go through the tree together, and each tests one of the next 32 candidates. Few nodes are near anything,
so a thread for each would wait for memory most of the time.
"""

import warp as wp

from warp_corot.kernels.stepping.threads import lanes_with, of_first_lane, sum_before, synchronize_warp

from .boxes import edge_reach, lower_end, root_of, upper_end
from .motion import Surface
from .rows import Meeting, OldRows, Rows
from .search import SHARP, bend, edge_is_near, finds_pairs, mark_row, node_is_near, node_normal
from .watch import Near, Watch

wp.set_module_options({"enable_backward": False})

LANES = wp.constant(32)
#: Number of neighbours that a thread keeps; if one has more, the warp finds all a second time.
KEPT = wp.constant(8)
Kept = wp.types.vector(length=8, dtype=wp.int32)


@wp.struct
class Owner:
    """What looks for its neighbours: a node or an edge."""

    place: int  # a node of it; -1: there is nothing to look for
    is_edge: int
    is_sharp: wp.bool
    out: wp.vec3  # its normal, or the sum of both sides' ones
    low: wp.vec3  # its box, with what it may move [m]
    high: wp.vec3


@wp.func
def owner_of(i: int, surface: Surface, meeting: Meeting):
    """The node or the edge with a number."""
    nodes = meeting.body.shape[0]
    found = Owner()
    found.place = -1
    if i < nodes:
        if surface.node[i] >= 0:
            reach = meeting.reach[i]
            beyond = wp.vec3(reach, reach, reach)
            found.place = i
            found.out = node_normal(i, meeting)
            found.low = lower_end(i, surface, meeting) - beyond
            found.high = upper_end(i, surface, meeting) + beyond
        return found
    e = meeting.edges[i - nodes]
    if e[0] >= 0:
        own = bend(surface, meeting, i - nodes)
        if finds_pairs(own, meeting):
            reach = edge_reach(meeting, e)
            beyond = wp.vec3(reach, reach, reach)
            found.place = e[0]
            found.is_edge = 1
            found.is_sharp = own > SHARP
            found.out = meeting.outs[i - nodes]
            found.low = wp.min(lower_end(e[0], surface, meeting), lower_end(e[1], surface, meeting)) - beyond
            found.high = wp.max(upper_end(e[0], surface, meeting), upper_end(e[1], surface, meeting)) + beyond
    return found


@wp.func
def find_near(
    i: int,
    lane: int,
    start: int,
    owner: Owner,
    of_triangles: wp.uint64,
    of_edges: wp.uint64,
    surface: Surface,
    meeting: Meeting,
    near: Near,
    rows: Rows,
    kept: Kept,
):
    """Find the neighbours of a node or an edge: how many there are, and how many of them this thread has found, of
    which it keeps the first ones; or, if a start is given, write all, in any order."""
    nodes = meeting.body.shape[0]
    count = int(0)
    mine = int(0)
    tree = of_triangles
    if owner.is_edge != 0:
        tree = of_edges
    for g in range(meeting.groups):
        root = root_of(owner.is_edge, g, owner.place, owner.low, owner.high, surface, meeting)
        if root >= 0:
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
                is_near = int(0)
                if held >= 0:
                    if owner.is_edge != 0:
                        is_near = int(edge_is_near(i - nodes, held, owner.is_sharp, owner.out, surface, meeting, near))
                    else:
                        is_near = int(node_is_near(i, held, owner.out, surface, meeting, near))
                at = count + sum_before(is_near)
                if is_near != 0:
                    if start >= 0:
                        rows.acts[start + at] = held
                    elif mine < KEPT:
                        kept[mine] = held
                    mine += 1
                count += lanes_with(is_near)
    return count, mine, kept


@wp.kernel(enable_backward=False)
def find_pairs_by_warp(
    # In
    watch: Watch,
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
    i = thread // LANES
    lane = thread % LANES
    room = rows.owner.shape[0]
    owner = owner_of(i, surface, meeting)
    count = int(0)
    mine = int(0)
    kept = Kept()
    if owner.place >= 0:
        count, mine, kept = find_near(i, lane, -1, owner, of_triangles, of_edges, surface, meeting, near, rows, kept)
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
            row += LANES
        return
    if count == 0:
        return
    # First in the order in which they were found, in the place of ``acts``, and then in that of their numbers.
    if lanes_with(wp.where(mine > KEPT, 1, 0)) != 0:
        find_near(i, lane, start, owner, of_triangles, of_edges, surface, meeting, near, rows, kept)
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
        k += LANES
    synchronize_warp()
    first_old = old.starts[i]
    k = int(lane)
    while k < count:
        row = start + k
        other = rows.other[row]
        acts = int(0)
        force = wp.vec3()
        for before in range(first_old, first_old + old.counts[i]):
            if old.other[before] == other:
                acts = old.acts[before]
                force = old.force[before]
        rows.owner[row] = i
        rows.acts[row] = acts
        rows.force[row] = force
        mark_row(i, other, meeting, near)
        k += LANES
