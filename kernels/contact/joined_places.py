"""Where pairs of soft surfaces are closest in an implicit step; see ``joined``."""

import warp as wp

from warp_corot.kernels.stepping.pace import DT, Pace

from .carriers import Carriers, crowd_at, ease_at, gone_at, is_held_at, motion_at
from .joined import NEAR, OFTEN, STIFF, Joined, opened_by
from .law import Law, held_back
from .locate import locate_facing
from .motion import Surface
from .rows import Meeting, Rows, row_count
from .springs import kept_gap, least_gap
from .supports import left_at_pair, loose_at_pair, loose_part
from .vertices import across
from .watch import Watch, wake

wp.set_module_options({"enable_backward": False})

#: When pairs are located: at the beginning of a step, there again after another search, and after motions.
FIRST, REPEATED, LATER = wp.constant(1), wp.constant(2), wp.constant(0)
#: The most searches in a step after the first one.
SEARCHES = wp.constant(8)
#: What is left in each solve of how far a place has strayed before.
FADING = wp.constant(0.7)


@wp.kernel(enable_backward=False)
def begin_places(surface: Surface, joined: Joined):
    """Keep where places are when the step begins."""
    s = wp.tid()
    joined.start[s] = surface.x[s]


@wp.kernel(enable_backward=False)
def place_nodes(which: int, d: wp.array[wp.vec4], joined: Joined, carriers: Carriers, surface: Surface):
    """Put places where pairs are to be located: where the step begins, or after motions d. Pairs that were near are
    forgotten.
    """
    s = wp.tid()
    if joined.locates[0] == 0:
        return
    if s == 0:
        joined.counts[NEAR] = 0
    if surface.node[s] < 0:
        return
    x = joined.start[s]
    if which == LATER:
        x += motion_at(s, surface, carriers, d)
    surface.x[s] = x


@wp.kernel(enable_backward=False)
def find_strays(
    # In
    d: wp.array[wp.vec4],
    joined: Joined,
    carriers: Carriers,
    searches: wp.array[wp.int32],
    rounds: wp.array[wp.int32],
    most: int,
    # Out
    watch: Watch,
    surface: Surface,
    again: wp.array[wp.int32],
):
    """Ask for another search along the way of motions d if places have strayed beyond their reach, where pairs may be
    missing, unless the step has had its ``most`` solves."""
    s = wp.tid()
    if surface.node[s] < 0:
        return
    motion = motion_at(s, surface, carriers, d) + gone_at(s, surface, carriers)
    surface.d[s] = motion
    way = joined.start[s] + motion - watch.places[s]
    far = wp.length(way - watch.ahead[s] - watch.drift[surface.world[s]])
    watch.strayed[s] = wp.max(far, FADING * watch.strayed[s])
    if far > watch.reach[s]:
        if searches[0] < SEARCHES and rounds[0] < most:
            again[0] = 1
            wake(watch)
        else:
            wp.atomic_add(watch.missed, 0, 1)


@wp.kernel(enable_backward=False)
def empty_crowds(joined: Joined, carriers: Carriers):
    if joined.locates[0] != 0:
        carriers.crowd[wp.tid()] = 0.0


@wp.func
def locate(
    row: int,
    which: int,
    law: Law,
    dt: float,
    d: wp.array[wp.vec4],
    surface: Surface,
    meeting: Meeting,
    carriers: Carriers,
    rows: Rows,
    joined: Joined,
):
    was = joined.force[row]
    if which != LATER:
        was = rows.force[row]
        joined.target[row] = 0.0
    pushed = wp.dot(was, was) > 0.0
    if which == FIRST:
        rows.acts[row] = int(pushed)
    elif which == REPEATED:
        pushed = rows.acts[row] != 0
    elif pushed and joined.stiffness[row] > 0.0:
        e = opened_by(row, d, rows, surface, carriers) - joined.base[row]
        if wp.abs(rows.gap[row] + wp.dot(rows.normal[row], e) - joined.target[row]) <= law.slack:
            was = joined.multiplier[row]
    stays = bool(False)
    if which != LATER:
        joined.pushed[row] = 0
        joined.begun[row] = 0
    else:
        if pushed and joined.pushed[row] == 0:
            joined.begun[row] = joined.begun[row] + 1
        joined.pushed[row] = int(pushed)
        stays = joined.begun[row] >= OFTEN
    is_near = stays or locate_facing(row, surface, meeting, rows)
    joined.multiplier[row] = wp.vec3()
    joined.force[row] = wp.vec3()
    joined.stiffness[row] = 0.0
    if which != LATER:
        # For pairs that are located again before the first solve.
        joined.force[row] = was
    if not is_near:
        joined.most[row] = 0.0
        return
    p = rows.places[row]
    w = rows.shares[row]
    is_free = bool(False)
    given = wp.vec3()
    k = int(0)
    while k < 4:
        is_free = is_free or not is_held_at(p[k], surface, carriers)
        given += w[k] * gone_at(p[k], surface, carriers)
        k += 1
    if not is_free:
        joined.most[row] = 0.0
        return
    joined.stiffness[row] = 1.0
    joined.given[row] = given
    opened = opened_by(row, d, rows, surface, carriers)
    n = rows.normal[row]
    if not stays:
        joined.base[row] = wp.vec3()
        allowed = left_at_pair(p, w, rows.gap[row], n, surface)
        if which != LATER:
            joined.target[row] = kept_gap(rows.gap[row] + allowed, pushed, law, dt) - allowed
        else:
            joined.base[row] = opened
            # What began deeper than the two have gone sideways in the step began as an overlap.
            gone = opened + given
            began = rows.gap[row] - wp.dot(n, gone) + wp.length(across(gone, n)) + allowed
            joined.target[row] = wp.min(joined.target[row], least_gap(began, law, dt) - allowed)
    push = wp.max(wp.dot(was, n), 0.0)
    joined.multiplier[row] = push * n + held_back(across(was, n), push, meeting.friction)
    gap = rows.gap[row] + wp.dot(n, opened - joined.base[row])
    if push > 0.0 or gap < joined.target[row]:
        k = int(0)
        while k < 4:
            crowd_at(p[k], w[k], surface, carriers)
            k += 1


@wp.kernel(enable_backward=False)
def locate_rows(
    # In
    threads: int,
    which: int,
    law: Law,
    pace: Pace,
    d: wp.array[wp.vec4],
    surface: Surface,
    meeting: Meeting,
    # Out
    carriers: Carriers,
    rows: Rows,
    joined: Joined,
):
    """Where each pair is closest; its forces become its multipliers."""
    row = wp.tid()
    count = row_count(rows)
    dt = float(pace.seconds[DT])
    if joined.locates[0] == 0:
        count = 0
    while row < count:
        locate(row, which, law, dt, d, surface, meeting, carriers, rows, joined)
        row += threads


@wp.kernel(enable_backward=False)
def stiffen_rows(threads: int, surface: Surface, carriers: Carriers, rows: Rows, joined: Joined):
    """Stiffness of the pairs that have been located: those that share nodes share it. Only these may meet until
    pairs are located again.
    """
    row = wp.tid()
    count = row_count(rows)
    if joined.locates[0] == 0:
        count = 0
    while row < count:
        if joined.stiffness[row] > 0.0:
            p = rows.places[row]
            w = rows.shares[row]
            yielding = float(0.0)
            k = int(0)
            while k < 4:
                yielding += ease_at(p[k], w[k], surface, carriers)
                k += 1
            part = loose_part(loose_at_pair(p, w, surface))
            joined.stiffness[row] = part * STIFF / wp.max(yielding, 1.0e-30)
            joined.near[wp.atomic_add(joined.counts, NEAR, 1)] = row
        row += threads
