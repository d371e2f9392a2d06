"""When pairs of soft surfaces are searched for, and which of them a step looks at, on the CPU.

Two places that could not touch at the last search cannot until their relative motion has used up the distance that was
between them then. So a step looks at how far places have moved, and only at those pairs that may touch in it.
"""

import warp as wp

from warp_corot.kernels.elements.simd8 import on_cpu
from warp_corot.kernels.modules import INLINED
from warp_corot.kernels.stepping.pace import Pace

from .approach import Part, Visits, append, choose
from .bearing import is_borne
from .explicit_rows import FORESEEN, WAITS
from .law import Law
from .motion import Surface, foreseen
from .rows import Rows, row_count
from .watch import FARTHEST, Near, Watch

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": INLINED})

#: When it is tested whether a search is due: before a step, before a search, which tests only whether anything may have
#: been missed, or after it.
BEFORE_STEP, BEFORE_SEARCH, AFTER_SEARCH = (wp.constant(k) for k in range(3))
#: Motion is reserved for so many steps like that of the search, and the fastest one once more for anything, which may
#: be hit.
STEPS = wp.constant(16.0)
#: Motion is rounded by less than this.
ROUNDED = wp.constant(1.0001)


@wp.kernel(enable_backward=False)
def foresee_carriers(begin: int, end: int, part: Part, pace: Pace, offset: int, visits: Visits):
    """Find the motion of the carriers from ``begin`` to ``end`` in this step without contact."""
    for n in range(begin, end):
        i = part.nodes.node[n]
        if i >= 0:
            d = foreseen(i, part.dynamics, pace, offset).d
            visits.carried[n + part.shift] = wp.vec4(d[0], d[1], d[2], 0.0)


@wp.kernel(enable_backward=False)
def follow_places(begin: int, end: int, part: Part, surface: Surface, visits: Visits):
    """Find how far the places from ``begin`` to ``end`` have come since the last search, and go in this step."""
    for s in range(begin, end):
        if surface.node[s] >= 0:
            gone = wp.vec4()
            goes = wp.vec4()
            if is_borne(s, surface):
                b = surface.bearing.bearers[s]
                w = surface.bearing.weights[s]
                for k in range(4):
                    gone += w[k] * part.dynamics.u[part.nodes.node[b[k]]]
                    goes += w[k] * visits.carried[b[k] + part.shift]
            else:
                gone = part.dynamics.u[surface.node[s]]
                goes = visits.carried[s]
            visits.gone[s] = gone - visits.searched[s]
            visits.goes[s] = goes


@wp.func
def length_of(a: wp.vec4):
    return wp.sqrt(a[0] * a[0] + a[1] * a[1] + a[2] * a[2])


@wp.kernel(enable_backward=False)
def ask_for_search(
    # In
    when: int,
    surface: Surface,
    law: Law,
    # In and out
    watch: Watch,
    visits: Visits,
):
    """Ask for a search if ``FORESEEN`` more steps may bring things together that the last one has not found, and count
    what may have been missed. Only motion relative to the mean of a world counts."""
    places = surface.node.shape[0]
    for w in range(visits.mean_gone.shape[0]):
        visits.mean_gone[w] = wp.vec4()
        visits.mean_goes[w] = wp.vec4()
    for s in range(places):
        if surface.node[s] >= 0:
            w = surface.world[s]
            one = wp.vec4(0.0, 0.0, 0.0, 1.0)
            visits.mean_gone[w] = visits.mean_gone[w] + visits.gone[s] + one
            visits.mean_goes[w] = visits.mean_goes[w] + visits.goes[s]
    for w in range(visits.mean_gone.shape[0]):
        share = 1.0 / wp.max(visits.mean_gone[w][3], 1.0)
        visits.mean_gone[w] = share * visits.mean_gone[w]
        visits.mean_goes[w] = share * visits.mean_goes[w]
    if when == AFTER_SEARCH:
        for s in range(places):
            visits.searched[s] = visits.searched[s] + visits.gone[s]
            visits.gone[s] = wp.vec4()
        watch.due[0] = 0
        watch.searches[0] = watch.searches[0] + 1
    for s in range(places):
        if surface.node[s] >= 0:
            w = surface.world[s]
            far = FORESEEN * length_of(visits.goes[s] - visits.mean_goes[w])
            if when != AFTER_SEARCH:
                gone = length_of(visits.gone[s] - visits.mean_gone[w])
                far = wp.where(when == BEFORE_SEARCH, gone - 0.5 * law.closing, gone + far)
            if not (far <= watch.reach[s] - 0.5 * law.closing):
                if when == BEFORE_STEP:
                    watch.due[0] = 1
                elif when == AFTER_SEARCH or visits.may_miss[0] != 0:
                    watch.missed[0] = watch.missed[0] + 1
                return


@wp.kernel(enable_backward=False)
def reserve_motion(
    # In
    surface: Surface,
    law: Law,
    # In and out
    watch: Watch,
    visits: Visits,
    near: Near,
):
    """Choose how far places may move until the next search."""
    fastest = float(0.0)
    for s in range(surface.node.shape[0]):
        if surface.node[s] >= 0:
            far = length_of(visits.goes[s] - visits.mean_goes[surface.world[s]])
            fastest = wp.max(fastest, far)
            watch.reach[s] = far
        near.flags[s] = 0
    near.count[0] = 0
    for s in range(surface.node.shape[0]):
        steps = wp.min(STEPS * watch.reach[s] + fastest, FARTHEST * watch.size)
        watch.reach[s] = 0.5 * law.closing + watch.least[0] + steps


@wp.func_native(
    on_cpu(
        """
    const auto at = [&](const auto& a, int k) { return *reinterpret_cast<const four*>(&wp::index(a, places[k])); };
    const auto length = [](four a) { return __builtin_sqrtf(a[0] * a[0] + a[1] * a[1] + a[2] * a[2]); };
    float most = 0.0f;
    for (int k = 0; k < first; ++k)
        for (int m = first; m < 4; ++m) {
            const float far = length(at(gone, k) - at(gone, m)) + ahead * length(at(goes, k) - at(goes, m));
            most = far <= most ? most : far;
        }
    return most;
""",
        otherwise="return 0.0f;\n",
    )
)
def nearing(places: wp.vec4i, first: int, ahead: float, gone: wp.array[wp.vec4], goes: wp.array[wp.vec4]) -> float:
    """How far two sides have come nearer since the last search and may in so many steps, at most [m].

    Args:
        places: Those of both sides.
        first: How many are of the first side.
    """
    ...


@wp.kernel(enable_backward=False)
def list_rows(
    # In
    first: int,
    closing: float,
    nodes: int,
    rows: Rows,
    # In and out
    watch: Watch,
    here: Near,
    visits: Visits,
):
    """List the pairs that may touch in this step, and those with a force from the last one, and visit their places.

    Args:
        first: The number of the first pair among contacts.
        closing: As in ``Law`` [m].
        nodes: Number of places; owners from there on are edges.
    """
    for row in range(row_count(rows)):
        owner = rows.owner[row]
        if owner >= 0:
            places = rows.places[row]
            far = nearing(places, wp.where(owner < nodes, 1, 2), FORESEEN, visits.gone, visits.goes)
            if not (ROUNDED * far + closing < rows.away[row]) or rows.acts[row] > WAITS:
                append(visits.contacts, 0, visits.contact_count, 0, first + row, 0)
                for k in range(4):
                    choose(places[k], here, visits)
    if visits.contact_count[0] > 0:
        watch.awake[0] = 1
