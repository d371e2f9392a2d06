"""Steps beside obstacles on the CPU that visit only what may touch: conservative advancement.

A visit to a place of the surface finds how far it is from obstacles. The nodes that carry it may go as far before the
next visit, less what obstacles have come nearer, so that a step looks at nothing but how far each of these nodes has
gone. After Mirtich, Impulse-based dynamic simulation of rigid body systems (1996), section 2.3. Several threads add to
the lists of what is visited.
"""

import warp as wp

from warp_corot.kernels.elements.elements import load_node
from warp_corot.kernels.elements.simd8 import on_cpu
from warp_corot.kernels.modules import INLINED
from warp_corot.kernels.stepping.pace import DONE, DT, Pace, length_before

from .bearing import carriers_of, find_borne
from .explicit_rows import FORESEEN, OUT, Rigid
from .explicit_step import push
from .mass_split import Sums, take_force
from .motion import Bearing, Foreseen, Motions, Part, Surface, distance_between, foreseen, kick_of
from .shapes import GROUND, distance_to, sure_distance
from .watch import BESIDE, FAR, FARTHEST, STABLE, Near, Watch, begin_obstacle, pair_of

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": INLINED})

#: Flags for places that were not visited in the step before, and for those that may touch something in this one.
LATE, LISTED = wp.constant(16), wp.constant(32)


@wp.struct
class Visits:
    """What steps visit. Carriers are all places, [S], and then all nodes that bear places, [B]: [N] = [S + B]."""

    # [N] a displacement, and how far the carrier may go from there before it is due, plus ``came`` then [m]
    budgets: wp.array[wp.vec4]
    # [N] how far the carrier has come to this displacement since all places were visited [m]
    ways: wp.array[wp.float32]
    # of each place that a carrier bears, as in ``Bearing.places``: ``ways`` plus ``came`` at which it is visited [m]
    until: wp.array[wp.float32]
    entries: wp.array[wp.vec4i]  # [S] where these are for the nodes that bear a place
    needs: wp.array[wp.float32]  # [N] how much of their budgets must be left in this step for those that are due [m]
    spans: wp.array[wp.float32]  # [S] the longest edge around a place at rest [m]
    # [2] how far any obstacle has gone since all places were visited, and goes in this step, at most [m]
    came: wp.array[wp.float32]
    step: wp.array[wp.int64]  # [1] the number of the last step
    is_first: wp.array[wp.int32]  # [1] whether this step visits everything
    may_miss: wp.array[wp.int32]  # [1] whether places may not have moved into obstacles unseen
    count: wp.array[wp.int32]  # [1] the number of steps, ever
    first_place: wp.array[wp.int32]  # [bodies]
    places: wp.array[wp.int32]  # [S] that number at the last visit to a place
    touches: wp.array[wp.int32]  # [O T] the same for an obstacle and a triangle
    contacts: wp.array[wp.int32]  # contacts of places that may act, by their numbers in ``mass_split``
    contact_count: wp.array[wp.int32]  # [1]
    carriers: wp.array[wp.int32]  # [N] that number when the motion of a carrier was found last
    # Lists for each body, from its first place or carrier on, and how many there are in each, [bodies]:
    chosen: wp.array[wp.int32]  # [S] the places that are visited in this step
    chosen_count: wp.array[wp.int32]
    due: wp.array[wp.int32]  # [N] those that are due, by their numbers among ``nodes`` of a ``Part``
    due_count: wp.array[wp.int32]
    carrying: wp.array[wp.int32]  # [N] those whose motion is known
    carrying_count: wp.array[wp.int32]
    is_shared: int  # whether several threads visit at the same time
    has_edges: int  # whether an obstacle can pass between nodes
    rigid: Rigid
    watch: Watch
    here: Near  # what may touch in this step


# Where one thread works, plain instructions take a fraction of the time of atomic ones.
@wp.func_native(
    on_cpu(
        """
    int& now = wp::index(a, i);
    if (now == value) return false;
    if (is_shared) return __atomic_exchange_n(&now, value, __ATOMIC_RELAXED) != value;
    now = value;
    return true;
""",
        otherwise="return false;\n",
    )
)
def claim(a: wp.array[wp.int32], i: int, value: int, is_shared: int) -> bool:
    """Write a value. Returns whether there was another one, to one thread of those that ask at the same time."""
    ...


@wp.func_native(
    on_cpu("""
    int& end = wp::index(counts, k);
    wp::index(list, first + (is_shared ? __atomic_fetch_add(&end, 1, __ATOMIC_RELAXED) : end++)) = item;
""")
)
def append(list: wp.array[wp.int32], first: int, counts: wp.array[wp.int32], k: int, item: int, is_shared: int):
    """Add an item to the end of the k-th list, which begins at ``first``."""
    ...


@wp.func
def choose(s: int, visits: Visits):
    """Visit a place in this step, once. Returns whether it was not chosen before."""
    was = visits.places[s]
    if not claim(visits.places, s, visits.count[0], visits.is_shared):
        return False
    k = visits.rigid.surface.body[s]
    append(visits.chosen, visits.first_place[k], visits.chosen_count, k, s, visits.is_shared)
    visits.here.flags[s] = BESIDE | wp.where(was + 1 < visits.count[0], LATE, 0)
    return True


@wp.func_native(
    on_cpu("""
    // The order of numbers that are not negative is that of their bits.
    int* to = reinterpret_cast<int*>(&wp::index(budgets, n)) + 3;
    const int bits = *reinterpret_cast<const int*>(&most);
    if (is_shared) {
        int now = __atomic_load_n(to, __ATOMIC_RELAXED);
        while (bits < now && !__atomic_compare_exchange_n(to, &now, bits, true, __ATOMIC_RELAXED, __ATOMIC_RELAXED));
    } else if (bits < *to) *to = bits;
""")
)
def lower_budget(budgets: wp.array[wp.vec4], n: int, most: float, is_shared: int):
    """Lower a budget to at most a value that is not negative."""
    ...


# --- steps ------------------------------------------------------------------------------------------------------------

#: The phases of a visit.
CHOOSE, CARRY, PLACE, CORNERS, LIMIT = (wp.constant(k) for k in range(5))
#: A triangle is visited within this many of its longest edges of an obstacle; all of it is within 0.58 of one of a
#: corner. Nearer to an obstacle than LONG edges at rest the edges are measured, and nodes may go by GROWN of the
#: longest one until they are again.
COVERED, LONG, GROWN = wp.constant(1.3), wp.constant(8.0), wp.constant(0.3)
#: All places are visited again before a way is longer than so many elements, of which rounding would matter.
FARTHEST_WAY = wp.constant(4096.0)
#: A visit is due if a carrier uses up its budget when it goes so many times its motion in the step without contact.
AHEAD = wp.constant(2.0)


@wp.kernel(enable_backward=False)
def find_entries(bearing: Bearing, entries: wp.array[wp.vec4i]):
    """Find where the nodes that bear places list them."""
    n = wp.tid()
    for e in range(bearing.starts[n], bearing.starts[n + 1]):
        s = bearing.places[e]
        for m in range(4):
            if bearing.bearers[s][m] == n:
                entries[s][m] = e


# --- what is due -----------------------------------------------------------------------------------------------------


@wp.kernel(enable_backward=False)
def begin_visits(motions: Motions, pace: Pace, world_starts: wp.array[wp.float64], offset: int, visits: Visits):
    """Move obstacles, and forget the visits of the last step."""
    rigid = visits.rigid
    watch = visits.watch
    here = visits.here
    meets = float(0.0)
    for k in range(watch.poses.shape[0] * watch.poses.shape[1]):
        world, o = pair_of(k, watch)
        begin_obstacle(world, o, motions, pace, world_starts, offset, 0, watch)
        meets = wp.max(meets, distance_between(motions.now[world, o], motions.later[world, o], motions.reach[o]))
    kept = int(0)
    for k in range(here.touch_count[0]):
        pair = here.touches[k]
        # A triangle with a force is found again, wherever it is now.
        if wp.length_sq(rigid.rows.force[rigid.first_triangle + pair]) > 0.0:
            here.touches[kept] = pair
            kept += 1
        else:
            visits.touches[pair] = 0
    here.count[0] = 0
    here.touch_count[0] = kept
    visits.contact_count[0] = 0
    for body in range(visits.chosen_count.shape[0]):
        visits.chosen_count[body] = 0
        visits.due_count[body] = 0
        visits.carrying_count[body] = 0
    number = pace.counts[DONE] + wp.int64(offset)
    visits.is_first[0] = wp.where(visits.step[0] + wp.int64(1) == number, 0, 1)
    visits.step[0] = number
    visits.count[0] = visits.count[0] + 1
    # Before a run nodes may have been moved from outside.
    is_moved = offset == 0 and pace.counts[DONE] == watch.published[0]
    visits.may_miss[0] = wp.where(visits.is_first[0] != 0 or is_moved, 0, 1)
    if visits.is_first[0] != 0:
        visits.came[0] = 0.0
        watch.searches[0] = watch.searches[0] + 1
    else:
        visits.came[0] = visits.came[0] + visits.came[1]
    visits.came[1] = meets
    watch.awake[0] = wp.where(kept > 0, 1, 0)


@wp.func_native(
    on_cpu(
        """
    const int* nodes = &wp::index(node, 0);
    const float* w = &wp::index(inverse_mass, 0);
    const auto first = [](const auto& a) { return reinterpret_cast<const four*>(&wp::index(a, 0)); };
    const four *from = first(budgets) + shift, *forces = first(f), *at = first(u), *speeds = first(v);
    const four g = {gravity[0], gravity[1], gravity[2], 0.0f};
    for (; n < end; ++n) {
        const int i = nodes[n];
        if (i < 0) continue;
        const four gone = at[i] - from[n], kicked = (speeds[i] + kick * (w[i] * forces[i] + g)) * damped;
        const four goes = w[i] > 0.0f ? kicked : speeds[i], sum = gone * gone + (ahead * ahead) * goes * goes;
        const float left = from[n][3] - used;
        // The square of a sum of two is at most twice the sum of their squares.
        if (!(left > 0.0f && 2.0f * (sum[0] + sum[1] + sum[2]) <= left * left)) break;
    }
    return n;
""",
        otherwise="return end;\n",
    )
)
def next_due(
    n: int,
    end: int,
    shift: int,
    used: float,
    kick: float,
    damped: float,
    ahead: float,
    gravity: wp.vec3,
    node: wp.array[wp.int32],
    budgets: wp.array[wp.vec4],
    inverse_mass: wp.array[wp.float32],
    f: wp.array[wp.vec4],
    u: wp.array[wp.vec4],
    v: wp.array[wp.vec4],
) -> int:
    """The next carrier from n on that may be due without loads; most are not, and need no roots.

    Args:
        shift: How much larger their numbers are in ``budgets``.
        used: How much of the budgets is used by other motion [m].
        kick, damped: As in ``motion.foreseen``.
        ahead: How long nodes go on as in this step [s].
    """
    ...


@wp.func
def start_at(u: wp.vec3, left: float):
    return wp.vec4(u[0], u[1], u[2], left)


@wp.func
def know(n: int, own: Foreseen, part: Part, visits: Visits):
    """Store the motion of a carrier without contact."""
    first = part.start + part.shift
    append(visits.carrying, first, visits.carrying_count, part.number, n, visits.is_shared)
    part.nodes.rest[n] = own.rest
    part.nodes.x[n] = own.x
    part.nodes.d[n] = own.d
    part.nodes.yielding[n] = own.yielding


@wp.kernel(enable_backward=False)
def find_due(threads: int, thread: int, start: int, count: int, part: Part, visits: Visits):
    """List the carriers of a body, so many from a start, whose budgets this step may use up; a thread takes a part of
    them."""
    body = part.dynamics
    watch = visits.watch
    dt = float(part.pace.seconds[DT])
    damped = 1.0 / (1.0 + dt * body.damping)
    used = visits.came[0] + AHEAD * visits.came[1] + watch.least[0]
    is_first = visits.is_first[0] != 0
    n = start + (count * thread) / threads
    end = start + (count * (thread + 1)) / threads
    while n < end:
        if not is_first and body.load.shape[0] == 0:
            n = next_due(
                n, end, part.shift, used, kick_of(part.pace, part.offset), damped, AHEAD * dt, body.gravity,
                part.nodes.node, visits.budgets, body.inverse_mass, body.f, body.u, body.v,
            )  # fmt: skip
        if n < end and part.nodes.node[n] >= 0:
            i = part.nodes.node[n]
            c = n + part.shift
            budget = visits.budgets[c]
            own = foreseen(i, part)
            gone = wp.length(load_node(body.u, i) - wp.vec3(budget[0], budget[1], budget[2]))
            goes = AHEAD * wp.length(own.d)
            if is_first or not (gone + goes <= budget[3] - used):
                visits.carriers[c] = visits.count[0]
                know(n, own, part, visits)
                visits.needs[c] = goes + used
                way = wp.where(is_first, 0.0, visits.ways[c] + gone)
                visits.ways[c] = way
                visits.budgets[c] = start_at(load_node(body.u, i), FAR)
                if way > FARTHEST_WAY * watch.size:
                    visits.step[0] = wp.int64(-2)  # all places are visited in the next step
                append(visits.due, part.start + part.shift, visits.due_count, part.number, n, visits.is_shared)
                watch.awake[0] = 1
        n += 1


@wp.kernel(enable_backward=False)
def end_run(pace: Pace, watch: Watch):
    """Note which step was a run's last one."""
    watch.published[0] = pace.counts[DONE]


# --- visits ----------------------------------------------------------------------------------------------------------


@wp.func
def position_of(s: int, part: Part, surface: Surface, share: float):
    """Where a place is that this step need not visit, with this share of its displacement: zero is at rest."""
    n, w = carriers_of(s, surface)
    x = wp.vec3()
    for m in range(4):
        if w[m] != 0.0:
            k = n[m] - part.shift
            i = part.nodes.node[k]
            x += w[m] * (part.nodes.rest[k] + share * load_node(part.dynamics.u, i))
    return x


@wp.func
def longest_edge(s: int, x: wp.vec3, share: float, part: Part, surface: Surface):
    """The longest edge from a place at x [m]; ``share`` as for ``position_of``."""
    longest = float(0.0)
    for c in range(surface.corner_starts[s], surface.corner_starts[s + 1]):
        # Each edge belongs to two triangles, in one of which its end comes next.
        r = surface.triangles[surface.corners[c] / 3][(surface.corners[c] + 1) % 3]
        longest = wp.max(longest, wp.length(position_of(r, part, surface, share) - x))
    return longest


@wp.func
def carry(s: int, part: Part, visits: Visits):
    """Find the motion of the carriers of a place in this step without contact, and begin to measure their way here."""
    b, _w = carriers_of(s, visits.rigid.surface)
    for m in range(4):
        c = b[m]
        n = c - part.shift
        if claim(visits.carriers, c, visits.count[0], visits.is_shared):
            i = part.nodes.node[n]
            know(n, foreseen(i, part), part, visits)
            now = load_node(part.dynamics.u, i)
            budget = visits.budgets[c]
            gone = wp.length(now - wp.vec3(budget[0], budget[1], budget[2]))
            visits.ways[c] = visits.ways[c] + gone
            visits.budgets[c] = start_at(now, wp.max(budget[3] - gone, 0.0))


@wp.func
def room_beside(s: int, part: Part, visits: Visits):
    """How far a place may go before it or a triangle around it may touch an obstacle [m]; those that may are listed."""
    rigid = visits.rigid
    watch = visits.watch
    here = visits.here
    surface = rigid.surface
    x = surface.x[s]
    close = FORESEEN * (wp.length(surface.d[s]) + visits.came[1])
    may_touch = bool(False)
    farthest = FARTHEST * watch.size
    room = float(farthest)
    for o in range(rigid.shapes.kind.shape[0]):
        r = o * surface.node.shape[0] + s
        span = float(0.0)
        if visits.has_edges != 0 and rigid.shapes.kind[o] != GROUND:
            span = LONG * visits.spans[s]
        pose = rigid.motions.now[surface.world[s], o]
        distance, _n = distance_to(rigid.shapes, o, pose, x, room + span + rigid.law.tolerance)
        gap = sure_distance(rigid.shapes, o, distance) - rigid.law.tolerance
        # A place that could act in the last step is found once more.
        holds = rigid.allowance[r] != 0.0 or wp.length_sq(rigid.rows.force[r]) > 0.0
        if gap <= close or rigid.rows.acts[r] != OUT or holds:
            may_touch = True
            append(visits.contacts, 0, visits.contact_count, 0, r, visits.is_shared)
        if holds:
            gap = wp.min(gap, 0.0)
        elif gap < -watch.least[0] and (here.flags[s] & LATE) != 0 and visits.may_miss[0] != 0:
            wp.atomic_add(watch.missed, 0, 1)
        if span == 0.0 or gap > span:
            room = wp.min(room, gap - span)
        else:
            longest = longest_edge(s, x, 1.0, part, surface)
            room = wp.min(room, wp.min(gap - longest, GROWN * longest))
            if gap <= COVERED * longest + close + watch.least[0]:
                for c in range(surface.corner_starts[s], surface.corner_starts[s + 1]):
                    pair = o * surface.triangles.shape[0] + surface.corners[c] / 3
                    if claim(visits.touches, pair, 1, visits.is_shared):
                        append(here.touches, 0, here.touch_count, 0, pair, visits.is_shared)
    if may_touch:
        if not (wp.length(surface.d[s]) <= STABLE * watch.size):
            wp.atomic_add(watch.missed, 0, 1)
        here.flags[s] = here.flags[s] | LISTED
        append(here.nodes, 0, here.count, 0, s, visits.is_shared)
    return wp.max(room, 0.0)


@wp.kernel(enable_backward=False)
def visit(threads: int, thread: int, first: int, last: int, part: Part, visits: Visits):
    """Find the motion of what is due in a body without contact, and how far it is from obstacles.

    Args:
        threads, thread: Number of threads, and this one.
        first, last: The phases.
    """
    surface = visits.rigid.surface
    here = visits.here
    are_borne = part.shift > 0
    own = part.start + part.shift
    if first == CHOOSE:
        k = int(thread)
        while k < visits.due_count[part.number]:
            n = visits.due[own + k]
            k += threads
            if are_borne:
                need = visits.ways[n + part.shift] + visits.needs[n + part.shift]
                for e in range(surface.bearing.starts[n], surface.bearing.starts[n + 1]):
                    if visits.is_first[0] != 0 or not (visits.until[e] >= need):
                        choose(surface.bearing.places[e], visits)
            else:
                choose(n, visits)
    if first <= CARRY and last >= CARRY:
        k = int(thread)
        while k < visits.chosen_count[part.number]:
            s = visits.chosen[part.place + k]
            k += threads
            carry(s, part, visits)
    if first <= PLACE and last >= PLACE:
        k = int(thread)
        while k < visits.chosen_count[part.number]:
            s = visits.chosen[part.place + k]
            k += threads
            if are_borne:
                find_borne(s, part.nodes, surface)
            if visits.is_first[0] != 0 and visits.has_edges != 0:
                visits.spans[s] = longest_edge(s, position_of(s, part, surface, 0.0), 0.0, part, surface)
            room = room_beside(s, part, visits)
            b, w = carriers_of(s, surface)
            left = visits.came[0] + room / (wp.abs(w[0]) + wp.abs(w[1]) + wp.abs(w[2]) + wp.abs(w[3]))
            for m in range(4):
                if w[m] != 0.0:
                    lower_budget(visits.budgets, b[m], left, visits.is_shared)
                    if are_borne:
                        visits.until[visits.entries[s][m]] = visits.ways[b[m]] + left
    if first <= CORNERS and last >= CORNERS and thread == 0:
        for k in range(here.touch_count[0]):
            for m in range(3):
                s = surface.triangles[here.touches[k] % surface.triangles.shape[0]][m]
                if surface.body[s] == part.number and choose(s, visits):
                    carry(s, part, visits)
                    if are_borne:
                        find_borne(s, part.nodes, surface)
                if surface.body[s] == part.number and (here.flags[s] & LISTED) == 0:
                    here.flags[s] = here.flags[s] | LISTED
                    append(here.nodes, 0, here.count, 0, s, visits.is_shared)
    if last == LIMIT and are_borne:
        k = int(thread)
        while k < visits.due_count[part.number]:
            n = visits.due[own + k]
            k += threads
            most = float(FAR)
            for e in range(surface.bearing.starts[n], surface.bearing.starts[n + 1]):
                most = wp.min(most, visits.until[e])
            lower_budget(
                visits.budgets, n + part.shift, wp.max(most - visits.ways[n + part.shift], 0.0), visits.is_shared
            )


@wp.kernel(enable_backward=False)
def end_visits(
    # In
    threads: int,
    thread: int,
    buffer: int,
    grain: float,
    counts: int,
    part: Part,
    visits: Visits,
    # In and out
    sums: Sums,
    account: wp.array2d[wp.float64],
    # Out
    contact_forces: wp.array[wp.vec4],
):
    """Add the contact forces at the carriers of what was visited to a body's forces; see ``end_contact``."""
    k = int(thread)
    while k < visits.carrying_count[part.number]:
        n = visits.carrying[part.start + part.shift + k]
        k += threads
        if sums.touched[n + part.shift] != 0:
            force = take_force(n + part.shift, buffer, grain, sums)
            push(part.nodes.node[n], force, counts, part, account, contact_forces)


@wp.kernel(enable_backward=False)
def complete_triangles(part: Part, visits: Visits):
    """Find where the other corners of triangles around places with a force were at the beginning of the last step."""
    before = float(length_before(part.pace))
    surface = visits.rigid.surface
    for k in range(visits.chosen_count[part.number]):
        s = visits.chosen[part.place + k]
        if wp.length_sq(surface.f[s]) > 0.0:
            for c in range(surface.corner_starts[s], surface.corner_starts[s + 1]):
                r = surface.triangles[surface.corners[c] / 3][(surface.corners[c] + 1) % 3]
                if visits.places[r] != visits.count[0]:
                    b, w = carriers_of(r, surface)
                    x = position_of(r, part, surface, 1.0)
                    for m in range(4):
                        x -= (w[m] * before) * load_node(part.dynamics.v, part.nodes.node[b[m] - part.shift])
                    surface.x[r] = x
