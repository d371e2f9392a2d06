"""Contact between soft surfaces: nodes with triangles, and edges with edges.

Rows are solved as in ``triangles``. If results must be reproducible, their contributions to nodes are summed as
integers, so that the order of threads does not matter; otherwise as floats, of which a card adds a vector at once.
"""

import warp as wp

from warp_corot.kernels.elements.elements import add_force, load_node
from warp_corot.kernels.stepping.pace import DT, Pace

from .bearing import ease, forget_forces, give_way, is_borne, loose_share
from .law import Law, held_back, least_motion, left_to_held
from .locate import locate_edge, locate_node
from .motion import Surface
from .near import PAIRED, Near
from .rows import Meeting, Rows, row_count
from .supports import left_at_pair
from .vertices import across

wp.set_module_options({"enable_backward": False})

#: Weights are summed in multiples of one over this.
SHARES = wp.constant(1048576.0)
#: Gaps of more than so many times the motion of their places, besides ``Law.closing``, do not close in a step.
FORESEEN = wp.constant(4.0)
#: Number of threads of a warp.
LANES = wp.constant(32)


@wp.func
def opened(row: int, surface: Surface, rows: Rows):
    """How much the gap grows until the end of the step [m]."""
    p = rows.places[row]
    w = rows.shares[row]
    d = w[0] * surface.d[p[0]] + w[1] * surface.d[p[1]]
    return d + w[2] * surface.d[p[2]] + w[3] * surface.d[p[3]]


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    if (!__any_sync(0xffffffffu, place >= 0)) return;
    const int lane = threadIdx.x & 31, axis = lane & 3;
    for (int k = 0; k < 4; ++k) {
        const int from = (lane & ~3) | k;
        const int p = __shfl_sync(0xffffffffu, place, from);
        const long long x = __shfl_sync(0xffffffffu, (long long)grains[0], from);
        const long long y = __shfl_sync(0xffffffffu, (long long)grains[1], from);
        const long long z = __shfl_sync(0xffffffffu, (long long)grains[2], from);
        const long long own = axis == 0 ? x : axis == 1 ? y : z;
        if (p >= 0 && axis < 3 && own != 0)
            atomicAdd(reinterpret_cast<unsigned long long*>(&wp::index(added, p)) + axis, (unsigned long long)own);
    }
#else
    if (place >= 0)
        for (int axis = 0; axis < 3; ++axis) wp::index(added, place)[axis] += grains[axis];
#endif
""")
def add_by_warp(added: wp.array[wp.vec3l], place: int, grains: wp.vec3l):
    """Add grains at a place, or none if it is negative. All threads of a warp must call it: they add the components of
    one place side by side, which the memory does at once.
    """
    ...


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
    if (is_live != 0) wp::index(live, wp::index(count, 0)++) = row;
#endif
""")
def list_by_warp(live: wp.array[wp.int32], count: wp.array[wp.int32], row: int, is_live: int):
    """Add a row to a list, or not. All threads of a warp must call it: they ask for their places together."""
    ...


@wp.func
def grains_of(force: wp.vec3, grain: float):
    g = force / grain
    return wp.vec3l(wp.int64(g[0]), wp.int64(g[1]), wp.int64(g[2]))


@wp.func
def push_by_warp(row: int, force: wp.vec3, law: Law, rows: Rows, added: wp.array[wp.vec3l]):
    """Add a pair's force to its places, by all threads of a warp, some of which may have none."""
    if rows.exact == 0:
        if wp.dot(force, force) > 0.0:
            for k in range(4):
                add_force(rows.summed, rows.places[row][k], rows.shares[row][k] * force)
        return
    p = wp.vec4i(-1, -1, -1, -1)
    w = wp.vec4()
    if wp.dot(force, force) > 0.0:
        p = rows.places[row]
        w = rows.shares[row]
    for k in range(4):
        add_by_warp(added, p[k], grains_of(w[k] * force, law.grain))


@wp.func
def locate_row(row: int, surface: Surface, meeting: Meeting, rows: Rows):
    """Where a pair is closest, and the force with which it begins."""
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
        return wp.vec3()
    n = rows.normal[row]
    # Keep all of it: if each step lost a part, surfaces would sink in until the overlap replaces that part, and would
    # creep.
    normal_force = wp.max(wp.dot(was, n), 0.0)
    force = wp.vec3()
    if normal_force > 0.0:
        force = normal_force * n + held_back(across(was, n), normal_force, meeting.friction)
        rows.force[row] = force
    return force


@wp.func
def missing(row: int, law: Law, dt: float, surface: Surface, rows: Rows):
    """How much more the pair must open [m]."""
    gap = rows.gap[row]
    gap += left_at_pair(rows.places[row], rows.shares[row], gap, rows.normal[row], surface)
    return least_motion(gap, law, dt) - wp.dot(opened(row, surface, rows), rows.normal[row])


@wp.func
def may_push(row: int, law: Law, surface: Surface, rows: Rows):
    """Whether a pair that has just been located may push in this step, whatever pushes its places."""
    w = rows.shares[row]
    if w[0] <= 0.0:
        return 0
    force = rows.force[row]
    if wp.dot(force, force) > 0.0:
        return 1
    gap = rows.gap[row]
    if gap <= law.closing:
        return 1
    p = rows.places[row]
    most = float(0.0)
    for k in range(4):
        most += wp.abs(w[k]) * wp.length(surface.d[p[k]])
    return wp.where(gap <= FORESEEN * most + law.closing, 1, 0)


@wp.func
def judge_row(row: int, law: Law, dt: float, surface: Surface, rows: Rows):
    """Find whether a pair acts in this round."""
    acts = int(0)
    if rows.shares[row][0] > 0.0:
        force = wp.dot(rows.force[row], rows.normal[row])
        if force > 0.0 or missing(row, law, dt, surface, rows) > 0.0:
            acts = 1
    rows.acts[row] = acts
    return acts


@wp.func
def solve_row(
    row: int,
    law: Law,
    dt: float,
    surface: Surface,
    friction: float,
    eases: wp.vec4,
    rows: Rows,
):
    """Correct the force of a pair, whose places give way by ``eases`` for each unit of their share [m/N]; returns the
    change."""
    p = rows.places[row]
    w = rows.shares[row]
    yielding = float(0.0)
    share = float(0.0)
    free = wp.vec3()
    for k in range(4):
        yielding += wp.abs(w[k]) * eases[k]
        if surface.yielding[p[k]] > 0.0:
            share += wp.abs(w[k]) * loose_share(p[k], surface)
            free += w[k] * surface.d[p[k]]
    if yielding <= 0.0:
        return wp.vec3()
    n = rows.normal[row]
    before = rows.force[row]
    wanted = missing(row, law, dt, surface, rows)
    wanted -= left_to_held(wanted + wp.dot(free, n), share)
    normal_force = wp.max(wp.dot(before, n) + wanted / yielding, 0.0)
    slip = across(opened(row, surface, rows), n)
    force = normal_force * n + held_back(across(before, n) - slip / yielding, normal_force, friction)
    rows.force[row] = force
    return force - before


# --- all of them, however many threads there are --------------------------------------------------------------------


@wp.kernel(enable_backward=False)
def locate_rows(threads: int, law: Law, surface: Surface, meeting: Meeting, rows: Rows, added: wp.array[wp.vec3l]):
    """Where each pair is closest, and the force with which it begins: that of the last step. Lists those that may push,
    which are fewer than half."""
    row = wp.tid()
    # Warps stay together.
    beyond = row_count(rows) + row % wp.min(threads, LANES)
    while row < beyond:
        force = wp.vec3()
        is_live = int(0)
        if row < row_count(rows):
            force = locate_row(row, surface, meeting, rows)
            is_live = may_push(row, law, surface, rows)
        push_by_warp(row, force, law, rows, added)
        list_by_warp(rows.live, rows.live_count, row, is_live)
        row += threads


@wp.kernel(enable_backward=False)
def judge_rows(threads: int, law: Law, pace: Pace, surface: Surface, rows: Rows, crowd: wp.array[wp.int32]):
    """Which pairs act, and the sum of their shares at each node."""
    k = wp.tid()
    dt = float(pace.seconds[DT])
    while k < rows.live_count[0]:
        row = rows.live[k]
        k += threads
        if judge_row(row, law, dt, surface, rows) != 0:
            p = rows.places[row]
            w = rows.shares[row]
            for m in range(4):
                wp.atomic_add(crowd, p[m], int(SHARES * wp.abs(w[m])))


@wp.kernel(enable_backward=False)
def solve_rows(
    # In
    threads: int,
    law: Law,
    pace: Pace,
    surface: Surface,
    friction: float,
    crowd: wp.array[wp.int32],
    # In and out
    rows: Rows,
    # Out
    added: wp.array[wp.vec3l],
):
    """Correct the force of each pair that acts."""
    k = wp.tid()
    dt = float(pace.seconds[DT])
    count = rows.live_count[0]
    beyond = count + k % wp.min(threads, LANES)
    while k < beyond:
        more = wp.vec3()
        row = int(0)
        if k < count:
            row = rows.live[k]
            if rows.acts[row] != 0:
                p = rows.places[row]
                eases = wp.vec4()
                for m in range(4):
                    eases[m] = ease(p[m], crowd, surface.yielding, surface) / SHARES
                more = solve_row(row, law, dt, surface, friction, eases, rows)
        push_by_warp(row, more, law, rows, added)
        k += threads


@wp.func
def take_sum(s: int, law: Law, rows: Rows, added: wp.array[wp.vec3l]):
    """The force that was added at a place, which begins at zero again."""
    if rows.exact == 0:
        force = load_node(rows.summed, s)
        if wp.dot(force, force) > 0.0:
            rows.summed[s] = wp.vec4()
        return force
    grains = added[s]
    if grains[0] != wp.int64(0) or grains[1] != wp.int64(0) or grains[2] != wp.int64(0):
        added[s] = wp.vec3l()
    return law.grain * wp.vec3(float(grains[0]), float(grains[1]), float(grains[2]))


@wp.func
def apply(s: int, law: Law, surface: Surface, rows: Rows, added: wp.array[wp.vec3l], crowd: wp.array[wp.int32]):
    crowd[s] = 0
    force = take_sum(s, law, rows, added)
    forget_forces(s, surface)
    if wp.dot(force, force) > 0.0:
        surface.f[s] = surface.f[s] + force
        if is_borne(s, surface):
            surface.bearing.gathered[s] = force
        else:
            surface.d[s] = surface.d[s] + surface.yielding[s] * force


@wp.kernel(enable_backward=False)
def apply_added(
    threads: int,
    near: Near,
    law: Law,
    surface: Surface,
    rows: Rows,
    added: wp.array[wp.vec3l],
    crowd: wp.array[wp.int32],
):
    """Give nodes what was added to their forces."""
    k = wp.tid()
    count = near.count[0]
    while k < count:
        s = near.nodes[k]
        k += threads
        if (near.flags[s] & PAIRED) != 0:
            apply(s, law, surface, rows, added, crowd)
        else:
            forget_forces(s, surface)


@wp.kernel(enable_backward=False)
def settle_pairs(threads: int, near: Near, surface: Surface):
    """Move borne places by these forces."""
    k = wp.tid()
    count = near.count[0]
    while k < count:
        s = near.nodes[k]
        k += threads
        if is_borne(s, surface):
            give_way(s, surface)
