"""Contact between soft surfaces: nodes with triangles, and edges with edges."""

import warp as wp

from .law import Law, held_back
from .locate import locate_edge, locate_node
from .motion import Surface
from .rows import Meeting, Rows
from .vertices import FORESEEN, across

wp.set_module_options({"enable_backward": False})


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
    if (is_live != 0) wp::index(live, __atomic_fetch_add(&wp::index(count, 0), 1, __ATOMIC_RELAXED)) = row;
#endif
""")
def list_by_warp(live: wp.array[wp.int32], count: wp.array[wp.int32], row: int, is_live: int):
    """Add a row to a list, or not. All threads of a warp must call it: they ask for their places together."""
    ...


@wp.func
def may_push(row: int, law: Law, surface: Surface, rows: Rows):
    """Whether a pair that has just been located may push in this step, whatever pushes its places."""
    w = rows.shares[row]
    if w[0] <= 0.0:
        return False
    force = rows.force[row]
    if wp.dot(force, force) > 0.0:
        return True
    gap = rows.gap[row]
    if gap <= law.closing:
        return True
    p = rows.places[row]
    most = float(0.0)
    for k in range(4):
        for m in range(4):
            if w[k] > 0.0 and w[m] < 0.0:
                most = wp.max(most, wp.length(surface.d[p[k]] - surface.d[p[m]]))
    return gap <= FORESEEN * most + law.closing


@wp.func
def locate_row(row: int, law: Law, surface: Surface, meeting: Meeting, rows: Rows):
    """Find where a pair is closest, and the force with which it begins. Returns whether it may push in this step."""
    nodes = meeting.body.shape[0]
    owner = rows.owner[row]
    is_near = bool(False)
    if owner >= nodes:
        is_near = locate_edge(row, owner - nodes, rows.other[row], surface, meeting, rows)
    elif owner >= 0:
        is_near = locate_node(row, owner, rows.other[row], surface, meeting, rows)
    was = rows.force[row]
    rows.force[row] = wp.vec3()
    rows.more[row] = wp.vec3()
    rows.acts[row] = 0
    if not is_near:
        rows.shares[row] = wp.vec4()
        return False
    n = rows.normal[row]
    # Keep all of it: if each step lost a part, surfaces would sink in until the overlap replaces that part, and would
    # creep.
    normal_force = wp.max(wp.dot(was, n), 0.0)
    if normal_force > 0.0:
        rows.force[row] = normal_force * n + held_back(across(was, n), normal_force, meeting.friction)
    return may_push(row, law, surface, rows)
