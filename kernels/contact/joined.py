"""Soft surfaces against one another in an implicit step: the pairs of ``pairs`` as springs with multipliers.

A pair that must not overlap pushes with p = max(l - k (g - t), 0): its gap g at the end of the step, where that must
come to, t, a stiffness k like that of the nodes around it, and a multiplier l. Friction is the same across the normal,
bounded by Coulomb's law. Each time the step has been solved for, forces become the multipliers, so that gaps close
whatever k is (augmented Lagrangians), and pairs are located again where they have come to. Multipliers begin with the
forces of the last step. While a step is solved for, a pair stays what it was located as, a plane that nothing passes.
"""

import warp as wp

from warp_corot.kernels.elements.elements import add_force, load_node, store_node
from warp_corot.kernels.implicit.conjugate_gradients import had_much_to_do
from warp_corot.kernels.implicit.line_search import TRIED
from warp_corot.kernels.stepping.pace import DT, Pace

from .facing import locate_facing
from .law import Law, held_back
from .motion import Surface
from .rows import Meeting, Rows, row_count
from .vertices import across

wp.set_module_options({"enable_backward": False})

#: The stiffness of a pair over that of its nodes.
STIFF = wp.constant(4.0)
#: Lists of pairs.
NEAR, PUSHING, REACHED = (wp.constant(k) for k in range(3))


@wp.struct
class Joined:
    """The places [S] and pairs [P] of an implicit step. Entries number the nodes of all bodies in one vector."""

    entry: wp.array[wp.int32]  # [S]
    start: wp.array[wp.vec3]  # [S] where the step begins [m]
    carried: wp.array[wp.vec3]  # [S] how far held nodes have gone in the step [m]
    compliance: wp.array[wp.float32]  # [S] of the node alone [m/N]; zero: it is held
    base: wp.array[wp.vec3]  # [P] how much the pair has opened where it is located [m]
    given: wp.array[wp.vec3]  # [P] how much held nodes open it [m]
    target: wp.array[wp.float32]  # [P] the least gap at the end [m]
    stiffness: wp.array[wp.float32]  # [P] k [N/m]
    multiplier: wp.array[wp.vec3]  # [P] [N]
    most: wp.array[wp.float32]  # [P] most of friction [N]
    force: wp.array[wp.vec3]  # [P] on the first [N]
    derivative: wp.array[wp.mat33]  # [P] [N/m]
    crowd: wp.array[wp.float32]  # [S] the sum of shares in pairs that push
    locates: wp.array[wp.int32]  # [1] whether pairs are to be located
    near: wp.array[wp.int32]  # [P] the pairs that may meet, as they were located
    pushing: wp.array[wp.int32]  # [P] those that push
    reached: wp.array[wp.int32]  # [P] those that push before or after a change of the motions
    counts: wp.array[wp.int32]  # [3] the lengths of these three lists


@wp.kernel(enable_backward=False)
def begin_places(
    # In
    start: int,
    first: int,
    inverse_mass: wp.array[wp.float32],
    blocks: wp.array[wp.mat33],
    rest: wp.array[wp.vec4],
    u: wp.array[wp.vec4],
    increment: wp.array[wp.vec4],
    guess: wp.array[wp.vec4],
    # Out
    surface: Surface,
    joined: Joined,
):
    """Where a body's surface nodes are, and how far they may go; entries are from ``first`` on."""
    s = start + wp.tid()
    i = surface.node[s]
    surface.f[s] = wp.vec3()
    surface.d[s] = wp.vec3()
    surface.yielding[s] = 0.0
    joined.compliance[s] = 0.0
    joined.entry[s] = -1
    if i < 0:
        return
    home = load_node(rest, i)
    x = home + load_node(u, i)
    surface.rest[s] = home
    surface.x[s] = x
    surface.d[s] = load_node(guess, i)
    joined.start[s] = x
    joined.entry[s] = first + i
    joined.carried[s] = wp.vec3()
    joined.crowd[s] = 0.0
    if inverse_mass[i] > 0.0:
        joined.compliance[s] = 3.0 / wp.max(wp.trace(blocks[i]), 1.0e-30)
    else:
        # It is where the step ends; the motion tells the search how fast it is.
        joined.carried[s] = load_node(increment, i)
        surface.d[s] = joined.carried[s]


@wp.func
def opened_by(row: int, d: wp.array[wp.vec4], rows: Rows, joined: Joined):
    """How much farther apart the two are after motions d [m]."""
    p = rows.places[row]
    w = rows.shares[row]
    e = wp.vec3()
    for k in range(4):
        e += w[k] * load_node(d, joined.entry[p[k]])
    return e


@wp.kernel(enable_backward=False)
def place_nodes(is_first: int, d: wp.array[wp.vec4], joined: Joined, surface: Surface):
    """Put surface nodes where pairs are to be located: at the beginning of the step, or after motions d. Pairs that
    were near are forgotten.
    """
    s = wp.tid()
    i = joined.entry[s]
    if joined.locates[0] == 0:
        return
    if s == 0:
        joined.counts[NEAR] = 0
    if i < 0:
        return
    x = joined.start[s]
    if is_first == 0:
        x += load_node(d, i)
    surface.x[s] = x
    joined.crowd[s] = 0.0


@wp.func
def least_gap(gap: float, law: Law, dt: float):
    """Where a gap must be at the end of the step; overlaps open slowly."""
    if gap > -law.tolerance:
        return 0.0
    return gap + wp.min(-law.settling * gap, law.recovery * dt)


@wp.func
def locate(
    row: int,
    is_first: int,
    law: Law,
    dt: float,
    d: wp.array[wp.vec4],
    surface: Surface,
    meeting: Meeting,
    rows: Rows,
    joined: Joined,
):
    is_near = locate_facing(row, surface, meeting, rows)
    was = joined.force[row]
    if is_first != 0:
        was = rows.force[row]
        joined.target[row] = 0.0
    joined.multiplier[row] = wp.vec3()
    joined.force[row] = wp.vec3()
    joined.stiffness[row] = 0.0
    if not is_near:
        return
    p = rows.places[row]
    w = rows.shares[row]
    yielding = float(0.0)
    given = wp.vec3()
    for k in range(4):
        yielding += joined.compliance[p[k]]
        given += w[k] * joined.carried[p[k]]
    if yielding == 0.0:
        return
    joined.stiffness[row] = 1.0
    joined.given[row] = given
    joined.base[row] = wp.vec3()
    if is_first != 0:
        joined.target[row] = least_gap(rows.gap[row], law, dt)
    else:
        joined.base[row] = opened_by(row, d, rows, joined)
    n = rows.normal[row]
    push = wp.max(wp.dot(was, n), 0.0)
    joined.multiplier[row] = push * n + held_back(across(was, n), push, meeting.friction)
    gap = rows.gap[row] + wp.dot(n, opened_by(row, d, rows, joined) - joined.base[row])
    if push > 0.0 or gap < joined.target[row]:
        for k in range(4):
            wp.atomic_add(joined.crowd, p[k], wp.abs(w[k]))


@wp.kernel(enable_backward=False)
def locate_rows(
    # In
    threads: int,
    is_first: int,
    law: Law,
    pace: Pace,
    d: wp.array[wp.vec4],
    surface: Surface,
    meeting: Meeting,
    # Out
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
        locate(row, is_first, law, dt, d, surface, meeting, rows, joined)
        row += threads


@wp.kernel(enable_backward=False)
def stiffen_rows(threads: int, rows: Rows, joined: Joined):
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
            for k in range(4):
                yielding += wp.abs(w[k]) * wp.max(joined.crowd[p[k]], wp.abs(w[k])) * joined.compliance[p[k]]
            joined.stiffness[row] = STIFF / wp.max(yielding, 1.0e-30)
            joined.near[wp.atomic_add(joined.counts, NEAR, 1)] = row
        row += threads


@wp.struct
class RowState:
    """The force of a pair on its first side [N], the derivative of that [N/m], and its push along the normal [N]."""

    force: wp.vec3
    derivative: wp.mat33
    push: float


@wp.func
def row_state(row: int, e: wp.vec3, most: float, rows: Rows, joined: Joined):
    """A pair that has opened by e, with friction of at most ``most``."""
    made = RowState()
    k = joined.stiffness[row]
    n = rows.normal[row]
    first = joined.multiplier[row]
    gap = rows.gap[row] + wp.dot(n, e - joined.base[row])
    whole = wp.outer(n, n)
    made.push = wp.max(wp.dot(first, n) - k * (gap - joined.target[row]), 0.0)
    if made.push > 0.0:
        made.force = made.push * n
        made.derivative = k * whole
    if most > 0.0:
        sideways = across(first - k * (e + joined.given[row]), n)
        size = wp.length(sideways)
        plane = wp.identity(3, dtype=wp.float32) - whole
        share = float(1.0)
        if size > most:
            # What slides has no stiffness in the direction in which it slides.
            share = most / size
            plane -= wp.outer(sideways, sideways) / (size * size)
        made.force += share * sideways
        made.derivative += (k * share) * plane
    return made


@wp.kernel(enable_backward=False)
def empty_list(which: int, joined: Joined):
    joined.counts[which] = 0


@wp.kernel(enable_backward=False)
def update_rows(threads: int, friction: float, d: wp.array[wp.vec4], rows: Rows, joined: Joined):
    """Forces and derivatives after motions d, with the friction that the push there allows, and the pairs that push."""
    k = wp.tid()
    while k < joined.counts[NEAR]:
        row = joined.near[k]
        e = opened_by(row, d, rows, joined)
        push = row_state(row, e, 0.0, rows, joined).push
        joined.most[row] = friction * push
        joined.force[row] = wp.vec3()
        if push > 0.0:
            made = row_state(row, e, friction * push, rows, joined)
            joined.force[row] = made.force
            joined.derivative[row] = made.derivative
            joined.pushing[wp.atomic_add(joined.counts, PUSHING, 1)] = row
        k += threads


@wp.kernel(enable_backward=False)
def find_reached(threads: int, d: wp.array[wp.vec4], change: wp.array[wp.vec4], rows: Rows, joined: Joined):
    """The pairs that push after motions d or with the change: as gaps change in proportion, no others push between."""
    k = wp.tid()
    while k < joined.counts[NEAR]:
        row = joined.near[k]
        e = opened_by(row, d, rows, joined)
        after = e + opened_by(row, change, rows, joined)
        push = wp.max(row_state(row, e, 0.0, rows, joined).push, row_state(row, after, 0.0, rows, joined).push)
        if push > 0.0:
            joined.reached[wp.atomic_add(joined.counts, REACHED, 1)] = row
        k += threads


@wp.func
def add_to_entries(row: int, force: wp.vec3, rows: Rows, joined: Joined, y: wp.array[wp.vec4]):
    p = rows.places[row]
    w = rows.shares[row]
    for k in range(4):
        if joined.compliance[p[k]] > 0.0:
            add_force(y, joined.entry[p[k]], w[k] * force)


@wp.kernel(enable_backward=False)
def add_row_forces(threads: int, rows: Rows, joined: Joined, y: wp.array[wp.vec4]):
    """Add the forces of pairs on nodes that are free [N]."""
    k = wp.tid()
    while k < joined.counts[PUSHING]:
        row = joined.pushing[k]
        add_to_entries(row, joined.force[row], rows, joined, y)
        k += threads


@wp.kernel(enable_backward=False)
def add_row_products(threads: int, rows: Rows, joined: Joined, x: wp.array[wp.vec4], y: wp.array[wp.vec4]):
    """Add the derivative times x."""
    k = wp.tid()
    while k < joined.counts[PUSHING]:
        row = joined.pushing[k]
        add_to_entries(row, joined.derivative[row] * opened_by(row, x, rows, joined), rows, joined, y)
        k += threads


@wp.kernel(enable_backward=False)
def add_row_slopes(
    # In
    threads: int,
    rows: Rows,
    joined: Joined,
    d: wp.array[wp.vec4],
    change: wp.array[wp.vec4],
    search: wp.array2d[wp.float64],
    # Out
    slopes: wp.array[wp.float64],
):
    """Add the power of pairs along a change of motions, at the share that is tried; all bodies are one world."""
    k = wp.tid()
    share = float(search[0, TRIED])
    total = wp.float64(0.0)
    while k < joined.counts[REACHED]:
        row = joined.reached[k]
        along = opened_by(row, change, rows, joined)
        e = opened_by(row, d, rows, joined) + share * along
        made = row_state(row, e, joined.most[row], rows, joined)
        total += wp.dot(wp.vec3d(made.force), wp.vec3d(along))
        k += threads
    if total != wp.float64(0.0):
        wp.atomic_add(slopes, 0, total)


@wp.kernel(enable_backward=False)
def end_rows(threads: int, rows: Rows, joined: Joined, added: wp.array[wp.vec3]):
    """Keep forces for the next step, and gather them at places, held ones too."""
    row = wp.tid()
    count = row_count(rows)
    while row < count:
        force = wp.vec3()
        if joined.stiffness[row] > 0.0:
            force = joined.force[row]
        rows.force[row] = force
        acts = int(0)
        if wp.dot(force, force) > 0.0:
            acts = 1
            p = rows.places[row]
            w = rows.shares[row]
            for k in range(4):
                wp.atomic_add(added, p[k], w[k] * force)
        rows.acts[row] = acts
        row += threads


@wp.kernel(enable_backward=False)
def end_places(
    # In
    start: int,
    d: wp.array[wp.vec4],
    joined: Joined,
    # In and out
    added: wp.array[wp.vec3],
    # Out
    surface: Surface,
    contact_forces: wp.array[wp.vec4],
):
    """What has come of the step at a body's surface nodes: places at its beginning, motions and forces."""
    s = start + wp.tid()
    i = surface.node[s]
    if i < 0:
        return
    surface.x[s] = joined.start[s]
    surface.d[s] = load_node(d, joined.entry[s])
    surface.f[s] = surface.f[s] + added[s]
    added[s] = wp.vec3()
    store_node(contact_forces, i, surface.f[s])


@wp.kernel(enable_backward=False)
def judge_round(
    # In
    scalars: wp.array2d[wp.float64],
    iterations: wp.array[wp.int32],
    changed: wp.array[wp.int32],
    total: wp.array[wp.int32],
    most: int,
    settled: wp.float64,
    near: wp.float64,
    # In and out
    locates: wp.array[wp.int32],
    rounds: wp.array[wp.int32],
    linear: wp.array[wp.int32],
    # Out
    going: wp.array[wp.int32],
):
    """Solve again until the last solve had next to nothing to do, just after pairs were located."""
    linear[0] = linear[0] + iterations[0]
    rounds[0] = rounds[0] + 1
    was_located = locates[0] != 0 or total[0] == 0
    is_settled = changed[0] == 0 and not had_much_to_do(scalars, 0, settled)
    locates[0] = wp.where(changed[0] == 0 and not had_much_to_do(scalars, 0, near), 1, 0)
    changed[0] = 0
    going[0] = wp.where((is_settled and was_located) or rounds[0] >= most, 0, 1)


@wp.kernel(enable_backward=False)
def gather_change(one: wp.array[wp.int32], changed: wp.array[wp.int32]):
    if one[0] != 0:
        changed[0] = 1


@wp.kernel(enable_backward=False)
def spread(iterations: wp.array[wp.int32], status: wp.array[wp.int32], both: wp.array2d[wp.int32]):
    """The same count and status for every world."""
    world = wp.tid()
    both[0, world] = iterations[0]
    both[1, world] = status[0]
