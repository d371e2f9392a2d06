"""Contact of obstacles with the edges and the interiors of triangles, such as a needle between nodes.

After the nodes' own contacts, the forces on all triangles are found together in a few rounds. Contacts that share a
node divide its mass in proportion to their weights there. Then the rounds converge and add no energy for any number of
contacts (mass splitting; the bound is the sum of each row of J M^-1 J^T).
"""

import warp as wp

from warp_corot.kernels.stepping.pace import DT, Pace

from .bearing import ease, give_way, is_borne, loose_share
from .law import Law, held_back, least_motion, left_to_held
from .motion import Surface
from .near import AROUND, BESIDE, Near
from .supports import left_at_triangle
from .touches import Touches
from .vertices import Rigid, across, anchor, begin_borne, push_borne, touch

wp.set_module_options({"enable_backward": False})

#: The parts of ``push_nodes``.
ADD, BEGIN, CORRECT, END = (wp.constant(k) for k in (1, 2, 4, 8))


@wp.struct
class Skin:
    """The triangles of all surfaces, and those around each node: three times the triangle, and which corner."""

    triangles: wp.array[wp.vec3i]
    corner_starts: wp.array[wp.int32]
    corners: wp.array[wp.int32]


@wp.func
def approach(touches: Touches, o: int, t: int, surface: Surface, corners: wp.vec3i):
    """The motion of the triangle's point relative to the obstacle in this step [m]."""
    w = touches.shares[o, t]
    d = w[0] * surface.d[corners[0]] + w[1] * surface.d[corners[1]] + w[2] * surface.d[corners[2]]
    return d - touches.moved[o, t]


@wp.func
def judge_touch(
    o: int,
    t: int,
    law: Law,
    dt: float,
    surface: Surface,
    corners: wp.vec3i,
    corner_yielding: wp.array[wp.float32],
    touches: Touches,
):
    """Find whether the contact of an obstacle and a triangle acts in this round."""
    w = touches.shares[o, t]
    acts = int(0)
    if w[0] + w[1] + w[2] > 0.0:
        n = touches.normal[o, t]
        gap = touches.gap[o, t]
        gap += left_at_triangle(w, corners, gap, n, corner_yielding, surface)
        wanted = least_motion(gap, law, dt) - wp.dot(approach(touches, o, t, surface, corners), n)
        if wanted > 0.0 or wp.dot(touches.force[o, t], n) > 0.0:
            acts = 1
    touches.acts[o, t] = acts
    return acts


@wp.func
def crowd_at(
    s: int,
    law: Law,
    dt: float,
    surface: Surface,
    skin: Skin,
    corner_yielding: wp.array[wp.float32],
    touches: Touches,
):
    total = float(0.0)
    for k in range(skin.corner_starts[s], skin.corner_starts[s + 1]):
        t = skin.corners[k] / 3
        for o in range(touches.acts.shape[0]):
            if judge_touch(o, t, law, dt, surface, skin.triangles[t], corner_yielding, touches) != 0:
                total += touches.shares[o, t][skin.corners[k] % 3]
    return total


@wp.kernel(enable_backward=False)
def crowd_nodes(
    # In
    threads: int,
    near: Near,
    rigid: Rigid,
    pace: Pace,
    skin: Skin,
    corner_yielding: wp.array[wp.float32],
    # In and out
    touches: Touches,
    # Out
    crowd: wp.array[wp.float32],
):
    """Find the contacts that act, and sum their weights at each place. All corners of a triangle find the same.

    Args:
        corner_yielding: ``yielding`` of the surface, also for nodes that another process moves.
    """
    dt = float(pace.seconds[DT])
    k = wp.tid()
    count = near.count[0]
    while k < count:
        s = near.nodes[k]
        k += threads
        total = float(0.0)
        if (near.flags[s] & AROUND) != 0:
            total = crowd_at(s, rigid.law, dt, rigid.surface, skin, corner_yielding, touches)
        if (near.flags[s] & BESIDE) != 0 and is_borne(s, rigid.surface):
            _more, pushing = push_borne(s, 0.0, dt, rigid)
            total += pushing
        crowd[s] = total


@wp.func
def solve_touch(
    o: int,
    t: int,
    law: Law,
    dt: float,
    surface: Surface,
    corners: wp.vec3i,
    eases: wp.vec3,
    corner_yielding: wp.array[wp.float32],
    touches: Touches,
):
    """Correct the force on a triangle, whose corners give way by ``eases`` for each unit of their share [m/N]."""
    w = touches.shares[o, t]
    yielding = wp.dot(w, eases)
    share = float(0.0)
    free = wp.vec3()
    for k in range(3):
        s = corners[k]
        if corner_yielding[s] > 0.0:
            share += w[k] * loose_share(s, surface)
            free += w[k] * surface.d[s]
    before = touches.force[o, t]
    touches.more[o, t] = wp.vec3()
    if yielding <= 0.0:
        return
    n = touches.normal[o, t]
    d = approach(touches, o, t, surface, corners)
    gap = touches.gap[o, t]
    gap += left_at_triangle(w, corners, gap, n, corner_yielding, surface)
    wanted = least_motion(gap, law, dt) - wp.dot(d, n)
    wanted -= left_to_held(wanted + wp.dot(free, n), share)
    normal_force = wp.max(wp.dot(before, n) + wanted / yielding, 0.0)
    sideways = held_back(across(before, n) - across(d, n) / yielding, normal_force, touches.friction[o, t])
    force = normal_force * n + sideways
    touches.force[o, t] = force
    touches.more[o, t] = force - before


@wp.kernel(enable_backward=False)
def solve_touches(
    # In
    threads: int,
    near: Near,
    law: Law,
    pace: Pace,
    surface: Surface,
    triangles: wp.array[wp.vec3i],
    crowd: wp.array[wp.float32],
    corner_yielding: wp.array[wp.float32],
    # In and out
    touches: Touches,
):
    """Correct the force of each acting contact.

    Args:
        corner_yielding: ``yielding`` of the surface, also for nodes that another process moves.
    """
    dt = float(pace.seconds[DT])
    k = wp.tid()
    count = near.touch_count[0]
    while k < count:
        o = near.touches[k] // triangles.shape[0]
        t = near.touches[k] % triangles.shape[0]
        k += threads
        if touches.acts[o, t] != 0:
            eases = wp.vec3()
            for n in range(3):
                eases[n] = ease(triangles[t][n], crowd, corner_yielding, surface)
            solve_touch(o, t, law, dt, surface, triangles[t], eases, corner_yielding, touches)


@wp.func
def share_of(s: int, skin: Skin, touches: Touches):
    """A place's share of the changes, summed in a fixed order."""
    total = wp.vec3()
    for k in range(skin.corner_starts[s], skin.corner_starts[s + 1]):
        t = skin.corners[k] / 3
        corner = skin.corners[k] % 3
        for o in range(touches.acts.shape[0]):
            if touches.acts[o, t] != 0:
                total += touches.shares[o, t][corner] * touches.more[o, t]
    return total


@wp.func
def push_node(s: int, flags: int, parts: int, skin: Skin, dt: float, touches: Touches, rigid: Rigid):
    """Some of the parts of ``push_nodes`` for a place that is a node."""
    if (parts & ADD) != 0 and (flags & AROUND) != 0:
        total = share_of(s, skin, touches)
        if wp.dot(total, total) > 0.0:
            rigid.surface.f[s] = rigid.surface.f[s] + total
            rigid.surface.d[s] = rigid.surface.d[s] + rigid.surface.yielding[s] * total
    if (flags & BESIDE) != 0:
        if (parts & (BEGIN | CORRECT)) != 0:
            touch(s, (parts & BEGIN) != 0, dt, rigid)
        if (parts & END) != 0:
            anchor(s, rigid)


@wp.func
def gather_borne(
    s: int, flags: int, parts: int, skin: Skin, dt: float, touches: Touches, crowd: wp.array[wp.float32], rigid: Rigid
):
    """The same for a borne place: its own forces are corrected together with those on triangles."""
    if (parts & ADD) != 0:
        total = wp.vec3()
        if (flags & AROUND) != 0:
            total = share_of(s, skin, touches)
        if (flags & BESIDE) != 0:
            if (parts & BEGIN) != 0:
                total += begin_borne(s, rigid)
            else:
                yielding = ease(s, crowd, rigid.surface.yielding, rigid.surface)
                more, _count = push_borne(s, yielding, dt, rigid)
                total += more
        rigid.surface.bearing.gathered[s] = total
        rigid.surface.f[s] = rigid.surface.f[s] + total
    elif (parts & END) != 0 and (flags & BESIDE) != 0:
        anchor(s, rigid)


@wp.kernel(enable_backward=False)
def push_nodes(
    # In
    threads: int,
    near: Near,
    parts: int,
    skin: Skin,
    pace: Pace,
    touches: Touches,
    crowd: wp.array[wp.float32],
    # In and out
    rigid: Rigid,
):
    """Do the work on nodes one by one, without their neighbours. Borne places are moved afterwards, by
    ``settle_places``.

    Args:
        parts: A sum. ADD: give each node its share of the changes of forces on triangles. BEGIN: find the forces [O, S]
            with which nodes are outside obstacles at the end of the step, with friction. CORRECT: correct these if
            other forces have moved nodes since. END: update the anchors of sticking nodes.
    """
    dt = float(pace.seconds[DT])
    k = wp.tid()
    count = near.count[0]
    while k < count:
        s = near.nodes[k]
        k += threads
        flags = near.flags[s]
        if is_borne(s, rigid.surface):
            gather_borne(s, flags, parts, skin, dt, touches, crowd, rigid)
        else:
            push_node(s, flags, parts, skin, dt, touches, rigid)


@wp.kernel(enable_backward=False)
def settle_places(threads: int, near: Near, parts: int, rigid: Rigid):
    """Move borne places by the forces that were gathered; with END in ``parts``, update their anchors."""
    k = wp.tid()
    count = near.count[0]
    while k < count:
        s = near.nodes[k]
        k += threads
        if is_borne(s, rigid.surface):
            give_way(s, rigid.surface)
            if (parts & END) != 0 and (near.flags[s] & BESIDE) != 0:
                anchor(s, rigid)
