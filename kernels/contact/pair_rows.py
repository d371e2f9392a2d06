"""Where pairs of soft surfaces are closest in an implicit step; see ``implicit_rows``."""

import warp as wp

from warp_corot.kernels.stepping.pace import DT, Pace

from .bearing import Carriers, crowd_at, gone_at, is_held_at, left_at, motion_at
from .implicit_rows import AGAIN, FIRST, REPEATED, ImplicitRows, list_row, opened_by
from .law import Law, across, held_back, kept_gap, least_gap
from .locate import locate_facing
from .motion import Surface
from .rows import Meeting, Rows, row_count
from .watch import Watch, wake

wp.set_module_options({"enable_backward": False})

#: A pair that has begun to push so often in a step is no longer located again.
OFTEN = wp.constant(3)
#: The most searches in a step after the first one.
SEARCHES = wp.constant(8)
#: What is left in each solve of how far a place has strayed before.
FADING = wp.constant(0.7)


@wp.kernel(enable_backward=False)
def find_strays(
    # In
    d: wp.array[wp.vec4],
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
    way = surface.x[s] + motion - watch.places[s]
    far = wp.length(way - watch.ahead[s] - watch.drift[surface.world[s]])
    watch.strayed[s] = wp.max(far, FADING * watch.strayed[s])
    if far > watch.reach[s]:
        if searches[0] < SEARCHES and rounds[0] < most:
            again[0] = 1
            wake(watch)
        else:
            wp.atomic_add(watch.missed, 0, 1)


@wp.func
def locate(
    k: int,
    which: int,
    law: Law,
    dt: float,
    d: wp.array[wp.vec4],
    surface: Surface,
    meeting: Meeting,
    carriers: Carriers,
    pairs: Rows,
    rows: ImplicitRows,
):
    r = rows.first_pair + k
    was = rows.force[r]
    was_listed = rows.listed[r] != 0
    if which != AGAIN:
        was = pairs.force[k]
        rows.target[r] = 0.0
    pushed = wp.dot(was, was) > 0.0
    if which == FIRST:
        pairs.acts[k] = int(pushed)
    elif which == REPEATED:
        pushed = pairs.acts[k] != 0
    elif pushed and was_listed:
        slip = opened_by(r, d, rows, surface, carriers) - rows.moved[r]
        if wp.abs(rows.gap[r] + wp.dot(rows.normal[r], slip) - rows.opened[r] - rows.target[r]) <= law.slack:
            was = rows.multiplier[r]
    stays = bool(False)
    if which != AGAIN:
        rows.pushed[k] = 0
        rows.begun[k] = 0
    else:
        if pushed and rows.pushed[k] == 0:
            rows.begun[k] = rows.begun[k] + 1
        rows.pushed[k] = int(pushed)
        stays = rows.begun[k] >= OFTEN
    is_near = stays or locate_facing(k, surface, meeting, pairs)
    rows.listed[r] = 0
    # For pairs that are located again before the first solve.
    rows.force[r] = wp.where(which != AGAIN, was, wp.vec3())
    p = pairs.places[k]
    w = pairs.weights[k]
    is_free = bool(False)
    given = wp.vec3()
    if is_near:
        m = int(0)
        while m < 4:
            is_free = is_free or not is_held_at(p[m], surface, carriers)
            given += w[m] * gone_at(p[m], surface, carriers)
            m += 1
    if not is_free:
        rows.most[r] = 0.0
        return
    n = pairs.normal[k]
    rows.places[r] = p
    rows.weights[r] = w
    rows.normal[r] = n
    rows.gap[r] = pairs.gap[k]
    rows.friction[r] = meeting.friction
    rows.moved[r] = -given
    slip = opened_by(r, d, rows, surface, carriers) + given
    if not stays:
        allowed = left_at(p, w, rows.gap[r], n, surface)
        if which != AGAIN:
            rows.opened[r] = wp.dot(n, given)
            rows.target[r] = kept_gap(rows.gap[r] + allowed, pushed, law, dt) - allowed
        else:
            rows.opened[r] = wp.dot(n, slip)
            # What began deeper than the two have gone sideways in the step began as an overlap.
            began = rows.gap[r] - rows.opened[r] + wp.length(across(slip, n)) + allowed
            rows.target[r] = wp.min(rows.target[r], least_gap(began, law, dt) - allowed)
    push = wp.max(wp.dot(was, n), 0.0)
    rows.multiplier[r] = push * n + held_back(across(was, n), push, meeting.friction)
    list_row(r, rows)
    if push > 0.0 or rows.gap[r] + wp.dot(n, slip) - rows.opened[r] < rows.target[r]:
        m = int(0)
        while m < 4:
            crowd_at(1, p[m], w[m], surface, carriers)
            m += 1


@wp.kernel(enable_backward=False)
def locate_pairs(
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
    pairs: Rows,
    rows: ImplicitRows,
):
    """Where each pair is closest; its forces become its multipliers."""
    k = wp.tid()
    dt = float(pace.seconds[DT])
    while k < row_count(pairs) and (which == FIRST or rows.locates[0] != 0):
        locate(k, which, law, dt, d, surface, meeting, carriers, pairs, rows)
        k += threads
