"""Growing a forest: bisection without neighbour pointers, and judging what an element holds.

The midpoint of an edge is found in a hash table by the edge's two nodes (linear probing, filled by compare-and-swap).
A midpoint is active once a tetrahedron has been bisected at it; an element with an active midpoint on any edge hangs
and must be bisected too. Midpoints that are not active are places at which the body was looked at.
"""

import warp as wp

from .springs import FIRST_NODE, SECOND_NODE

EMPTY = wp.constant(wp.int64(-1))
LIVE = wp.constant(-1)
VOID = wp.constant(-2)

# What is known of a new element.
DONE = wp.constant(0)
SPLIT = wp.constant(1)
OPEN = wp.constant(2)

#: A gradient below this share of the steepest possible is taken for that much.
FLATTEST = wp.constant(0.1)


@wp.func
def edge_key(a: int, b: int):
    return (wp.int64(wp.min(a, b)) << wp.int64(32)) | wp.int64(wp.max(a, b))


@wp.func
def home_slot(key: wp.int64, mask: int):
    mixed = wp.uint64(key) * wp.uint64(11400714819323198485)
    return int(mixed >> wp.uint64(33)) & mask


@wp.func
def find_midpoint(a: int, b: int, keys: wp.array[wp.int64], values: wp.array[wp.int32]):
    """The node at the middle of an edge, -1 where there is none."""
    key = edge_key(a, b)
    mask = keys.shape[0] - 1
    slot = home_slot(key, mask)
    while keys[slot] != key and keys[slot] != EMPTY:
        slot = (slot + 1) & mask
    if keys[slot] == key:
        return values[slot]
    return -1


@wp.func
def claim_slot(key: wp.int64, keys: wp.array[wp.int64]):
    """The key's slot, and whether it was put there now: a negative slot - 1 says so."""
    mask = keys.shape[0] - 1
    slot = home_slot(key, mask)
    while True:
        before = wp.atomic_cas(keys, slot, EMPTY, key)
        if before == EMPTY:
            return -slot - 1
        if before == key:
            return slot
        slot = (slot + 1) & mask
    return slot


@wp.kernel(enable_backward=False)
def fill_table(
    # In
    ends: wp.array[wp.vec2i],
    # Out
    keys: wp.array[wp.int64],
    values: wp.array[wp.int32],
):
    """Enter all midpoints that there are into an empty table."""
    node = wp.tid()
    pair = ends[node]
    if pair[0] >= 0:
        slot = claim_slot(edge_key(pair[0], pair[1]), keys)
        values[-slot - 1] = node


@wp.kernel(enable_backward=False)
def insert_midpoints(
    # In
    pairs: wp.array[wp.vec2i],
    # In and out
    lattice: wp.array[wp.vec3i],
    ends: wp.array[wp.vec2i],
    keys: wp.array[wp.int64],
    values: wp.array[wp.int32],
    node_count: wp.array[wp.int32],
    # Out
    slots: wp.array[wp.int32],
):
    """Make the midpoints that are not there yet; the slot of each."""
    i = wp.tid()
    a = pairs[i][0]
    b = pairs[i][1]
    slot = claim_slot(edge_key(a, b), keys)
    if slot < 0:
        slot = -slot - 1
        node = wp.atomic_add(node_count, 0, 1)
        values[slot] = node
        ends[node] = wp.vec2i(wp.min(a, b), wp.max(a, b))
        p = lattice[a]
        q = lattice[b]
        # Half the difference, as the sum of two numbers may not fit.
        lattice[node] = wp.vec3i(p[0] + (q[0] - p[0]) / 2, p[1] + (q[1] - p[1]) / 2, p[2] + (q[2] - p[2]) / 2)
    slots[i] = slot


@wp.kernel(enable_backward=False)
def refinement_edges(
    # In
    elements: wp.array[wp.int32],
    tets: wp.array[wp.vec4i],
    level: wp.array[wp.int32],
    # Out
    pairs: wp.array[wp.vec2i],
):
    i = wp.tid()
    tet = tets[elements[i]]
    pairs[i] = wp.vec2i(tet[0], tet[3 - level[elements[i]] % 3])


@wp.kernel(enable_backward=False)
def all_edges(
    # In
    elements: wp.array[wp.int32],
    tets: wp.array[wp.vec4i],
    # Out
    pairs: wp.array[wp.vec2i],
):
    """The six edges of each element, in the order of ``shapes.EDGES``."""
    i = wp.tid()
    tet = tets[elements[i]]
    for e in range(6):
        pairs[6 * i + e] = wp.vec2i(tet[FIRST_NODE[e]], tet[SECOND_NODE[e]])


@wp.kernel(enable_backward=False)
def activate(
    # In
    slots: wp.array[wp.int32],
    values: wp.array[wp.int32],
    ends: wp.array[wp.vec2i],
    # Out
    active: wp.array[wp.uint8],
    touched: wp.array[wp.uint8],
):
    """Make midpoints active, and touch both ends of the edges of which they are."""
    node = values[slots[wp.tid()]]
    active[node] = wp.uint8(1)
    touched[ends[node][0]] = wp.uint8(1)
    touched[ends[node][1]] = wp.uint8(1)


@wp.kernel(enable_backward=False)
def bisect(
    # In
    elements: wp.array[wp.int32],
    slots: wp.array[wp.int32],
    values: wp.array[wp.int32],
    base: int,
    # In and out
    tets: wp.array[wp.vec4i],
    level: wp.array[wp.int32],
    parent: wp.array[wp.int32],
    first_child: wp.array[wp.int32],
    bound: wp.array[wp.uint8],
):
    """Maubach's rule; children stand behind one another from ``base`` on and are live or void as their parent was."""
    i = wp.tid()
    element = elements[i]
    x = tets[element]
    z = values[slots[i]]
    kind = level[element] % 3
    one = wp.vec4i(x[0], x[1], x[2], z)
    two = wp.vec4i(x[1], x[2], x[3], z)
    if kind == 1:
        one = wp.vec4i(x[0], x[1], z, x[3])
        two = wp.vec4i(x[1], x[2], z, x[3])
    elif kind == 2:
        one = wp.vec4i(x[0], z, x[2], x[3])
        two = wp.vec4i(x[1], z, x[2], x[3])
    child = base + 2 * i
    tets[child] = one
    tets[child + 1] = two
    for n in range(2):
        level[child + n] = level[element] + 1
        parent[child + n] = element
        first_child[child + n] = first_child[element]
        bound[child + n] = bound[element]
    first_child[element] = child


@wp.kernel(enable_backward=False)
def deepest_level(
    # In
    elements: wp.array[wp.int32],
    level: wp.array[wp.int32],
    # Out
    deepest: wp.array[wp.int32],
):
    wp.atomic_max(deepest, 0, level[elements[wp.tid()]])


@wp.kernel(enable_backward=False)
def flag_hanging(
    # In
    tets: wp.array[wp.vec4i],
    first_child: wp.array[wp.int32],
    wished: wp.array[wp.uint8],
    bound: wp.array[wp.uint8],
    keys: wp.array[wp.int64],
    values: wp.array[wp.int32],
    active: wp.array[wp.uint8],
    touched: wp.array[wp.uint8],
    first_new: int,
    # Out
    flags: wp.array[wp.int32],
):
    """Leaves that are wished to be bisected or have an active midpoint on an edge. Void ones only where bound to.

    Only elements from ``first_new`` on, and those that share an edge that was bisected of late, of which both ends are
    touched, need to be looked at closely.
    """
    i = wp.tid()
    flag = int(0)
    if first_child[i] == LIVE or (first_child[i] == VOID and bound[i] != wp.uint8(0)):
        if wished[i] != wp.uint8(0):
            flag = 1
        else:
            tet = tets[i]
            for e in range(6):
                a = tet[FIRST_NODE[e]]
                b = tet[SECOND_NODE[e]]
                if flag == 0 and (i >= first_new or int(touched[a]) * int(touched[b]) == 1):
                    node = find_midpoint(a, b, keys, values)
                    if node >= 0:
                        flag = int(active[node])
    flags[i] = flag


@wp.kernel(enable_backward=False)
def gather_flagged(
    # In
    flags: wp.array[wp.int32],
    places: wp.array[wp.int32],
    first: int,
    # Out
    chosen: wp.array[wp.int32],
):
    """Numbers, from ``first`` on, of what is flagged, in order."""
    i = wp.tid()
    if flags[i] != 0:
        chosen[places[i]] = first + i


@wp.kernel(enable_backward=False)
def flag_equal(
    # In
    states: wp.array[wp.int32],
    state: int,
    # Out
    flags: wp.array[wp.int32],
):
    i = wp.tid()
    flags[i] = wp.where(states[i] == state, 1, 0)


@wp.kernel(enable_backward=False)
def node_points(
    # In
    lattice: wp.array[wp.vec3i],
    first: int,
    origin: wp.vec3d,
    spacing: wp.float64,
    # Out
    points: wp.array[wp.vec3],
):
    """Positions in float64, rounded once."""
    i = wp.tid()
    p = lattice[first + i]
    points[i] = wp.vec3(
        float(origin[0] + wp.float64(p[0]) * spacing),
        float(origin[1] + wp.float64(p[1]) * spacing),
        float(origin[2] + wp.float64(p[2]) * spacing),
    )


@wp.kernel(enable_backward=False)
def take_values(
    # In
    found: wp.array[wp.float32],
    lattice: wp.array[wp.vec3i],
    first: int,
    top: wp.vec3i,
    noise: float,
    # Out
    phi: wp.array[wp.float32],
):
    """Values of new nodes: nothing is inside on the outermost faces of the grid, and rounding noise counts as zero."""
    i = wp.tid()
    p = lattice[first + i]
    value = found[i]
    if wp.abs(value) <= noise:
        value = 0.0
    if wp.min(p) == 0 or p[0] == top[0] or p[1] == top[1] or p[2] == top[2]:
        value = wp.max(value, 0.0)
    phi[first + i] = value


@wp.kernel(enable_backward=False)
def judge_by_corners(
    # In
    first: int,
    tets: wp.array[wp.vec4i],
    level: wp.array[wp.int32],
    phi: wp.array[wp.float32],
    circumradius: wp.array[wp.float32],
    edges: wp.array2d[wp.float32],
    lipschitz: float,
    min_level: int,
    max_level: int,
    # In and out
    first_child: wp.array[wp.int32],
    # Out
    states: wp.array[wp.int32],
):
    """No surface is where values are beyond what the function can change over the distance from them.

    Every point of an element is within its circumradius of some corner, within the longest edge of each, and within
    half the circumradius of some corner or midpoint of an edge: these ten are the nodes of the eight elements three
    levels below, of half the size. Midpoints' values are bounded from those of the ends.
    """
    i = wp.tid()
    tet = tets[first + i]
    own_level = level[first + i]
    p = wp.vec4(phi[tet[0]], phi[tet[1]], phi[tet[2]], phi[tet[3]])
    near = lipschitz * circumradius[own_level]
    lowest = wp.min(p)
    highest = wp.max(p)
    longest = float(0.0)
    for e in range(6):
        longest = wp.max(longest, edges[own_level, e])
    outside = lowest > near or highest > lipschitz * longest
    inside = highest < -near or lowest < -lipschitz * longest
    for e in range(6):
        change = 0.5 * lipschitz * edges[own_level, e]
        a = p[FIRST_NODE[e]]
        b = p[SECOND_NODE[e]]
        lowest = wp.min(lowest, wp.max(a, b) - change)
        highest = wp.max(highest, wp.min(a, b) + change)
    state = DONE
    if outside or lowest > 0.5 * near:
        first_child[first + i] = VOID
    elif own_level < min_level:
        state = SPLIT
    elif own_level < max_level and not (inside or highest < -0.5 * near):
        state = OPEN
    states[i] = state


@wp.func
def gradient_size(
    tet: wp.vec4i, phi: wp.array[wp.float32], lattice: wp.array[wp.vec3i], spacing: float, lipschitz: float
):
    """Length of the interpolant's gradient, from below bounded by a share of the steepest."""
    p = lattice[tet[0]]
    rows = wp.mat33()
    rise = wp.vec3()
    for n in range(3):
        q = lattice[tet[n + 1]]
        rows[n] = spacing * wp.vec3(float(q[0] - p[0]), float(q[1] - p[1]), float(q[2] - p[2]))
        rise[n] = phi[tet[n + 1]] - phi[tet[0]]
    # Scaled, so that no determinant is below float32's range.
    size = wp.length(rows[0])
    gradient = wp.inverse(rows / size) * rise / size
    return wp.max(wp.length(gradient), FLATTEST * lipschitz)


@wp.kernel(enable_backward=False)
def judge_by_edges(
    # In
    elements: wp.array[wp.int32],
    first: int,
    slots: wp.array[wp.int32],
    values: wp.array[wp.int32],
    tets: wp.array[wp.vec4i],
    level: wp.array[wp.int32],
    phi: wp.array[wp.float32],
    lattice: wp.array[wp.vec3i],
    origin: wp.vec3d,
    spacing: wp.float64,
    circumradius: wp.array[wp.float32],
    lipschitz: float,
    tolerance: float,
    # In and out
    first_child: wp.array[wp.int32],
    states: wp.array[wp.int32],
    # Out
    probes: wp.array[wp.vec3],
    expected: wp.array[wp.float32],
    deviations: wp.array[wp.float32],
):
    """Compare the midpoints of the six edges with the linear interpolant.

    Of a quadratic function the six deviations e tell all: it deviates by sum 4 l_i l_j e_ij at barycentric coordinates
    l, so by their mean times 4/3 at a face's centre and 3/2 at the centroid. What barely passes is looked at once more,
    in the middle of its piece of the surface or at its centroid: what the quadratic function has there is ``expected``.
    """
    i = wp.tid()
    element = elements[i]
    tet = tets[element]
    deviation = wp.vector(dtype=wp.float32, length=6)
    lowest = phi[tet[0]]
    highest = phi[tet[0]]
    for n in range(1, 4):
        lowest = wp.min(lowest, phi[tet[n]])
        highest = wp.max(highest, phi[tet[n]])
    crossed = lowest < 0.0 and highest >= 0.0
    total = float(0.0)
    worst = float(0.0)
    for e in range(6):
        middle = phi[values[slots[6 * i + e]]]
        lowest = wp.min(lowest, middle)
        highest = wp.max(highest, middle)
        ends = 0.5 * (phi[tet[FIRST_NODE[e]]] + phi[tet[SECOND_NODE[e]]])
        deviation[e] = middle - ends
        total += deviation[e]
        worst = wp.max(worst, wp.abs(deviation[e]))
    faces = wp.static(4.0 / 9.0) * wp.vec4(
        deviation[0] + deviation[1] + deviation[3],
        deviation[0] + deviation[2] + deviation[4],
        deviation[1] + deviation[2] + deviation[5],
        deviation[3] + deviation[4] + deviation[5],
    )
    worst = wp.max(worst, wp.max(wp.max(faces), -wp.min(faces)))
    worst = wp.max(worst, 0.25 * wp.abs(total))

    state = OPEN
    near = 0.5 * lipschitz * circumradius[level[element]]
    if lowest > near:
        first_child[element] = VOID
        state = DONE
    elif highest < -near:
        state = DONE
    elif crossed:
        tolerance *= gradient_size(tet, phi, lattice, float(spacing), lipschitz)
        if worst > tolerance:
            state = SPLIT
    elif worst > tolerance and wp.max(lowest, -highest) <= 2.0 * worst:
        state = SPLIT
    if state == OPEN and (worst < 0.25 * tolerance or wp.max(lowest, -highest) > 4.0 * worst):
        state = DONE
    states[element - first] = state

    place = wp.vec4(0.25)
    if crossed:
        place = wp.vec4(0.0)
        count = float(0.0)
        for e in range(6):
            a = FIRST_NODE[e]
            b = SECOND_NODE[e]
            if (phi[tet[a]] < 0.0) != (phi[tet[b]] < 0.0):
                t = phi[tet[a]] / (phi[tet[a]] - phi[tet[b]])
                place[a] = place[a] + 1.0 - t
                place[b] = place[b] + t
                count += 1.0
        place = place / count
    value = float(0.0)
    for e in range(6):
        value += 4.0 * place[FIRST_NODE[e]] * place[SECOND_NODE[e]] * deviation[e]
    at = origin
    for n in range(4):
        p = lattice[tet[n]]
        value += place[n] * phi[tet[n]]
        weight = wp.float64(place[n]) * spacing
        at += wp.vec3d(wp.float64(p[0]) * weight, wp.float64(p[1]) * weight, wp.float64(p[2]) * weight)
    probes[i] = wp.vec3(float(at[0]), float(at[1]), float(at[2]))
    expected[i] = value
    deviations[i] = worst


@wp.kernel(enable_backward=False)
def judge_by_probes(
    # In
    chosen: wp.array[wp.int32],
    elements: wp.array[wp.int32],
    first: int,
    found: wp.array[wp.float32],
    expected: wp.array[wp.float32],
    deviations: wp.array[wp.float32],
    tets: wp.array[wp.vec4i],
    phi: wp.array[wp.float32],
    lattice: wp.array[wp.vec3i],
    spacing: float,
    lipschitz: float,
    tolerance: float,
    # Out
    states: wp.array[wp.int32],
):
    """The last look. Where the function is not the quadratic one of its ten values, as at a crease, it deviates between
    the points looked at by more than at them: by half as much again where three faces meet."""
    i = wp.tid()
    element = elements[chosen[i]]
    tet = tets[element]
    inside = int(0)
    for n in range(4):
        if phi[tet[n]] < 0.0:
            inside += 1
    surprise = wp.abs(found[i] - expected[chosen[i]])
    deviation = deviations[chosen[i]]
    if surprise > 0.1 * deviation:
        deviation = 1.5 * deviation + surprise
    state = DONE
    if inside > 0 and inside < 4:
        if deviation > tolerance * gradient_size(tet, phi, lattice, spacing, lipschitz):
            state = SPLIT
    elif (found[i] < 0.0) != (inside == 4):
        if wp.max(wp.abs(found[i]), deviation) > tolerance:
            state = SPLIT
    elif deviation > tolerance and wp.abs(found[i]) <= 2.0 * deviation:
        state = SPLIT
    states[element - first] = state


@wp.kernel(enable_backward=False)
def gather_points(
    # In
    chosen: wp.array[wp.int32],
    points: wp.array[wp.vec3],
    # Out
    gathered: wp.array[wp.vec3],
):
    i = wp.tid()
    gathered[i] = points[chosen[i]]


@wp.kernel(enable_backward=False)
def centroids(
    # In
    first: int,
    tets: wp.array[wp.vec4i],
    lattice: wp.array[wp.vec3i],
    origin: wp.vec3d,
    spacing: wp.float64,
    # Out
    points: wp.array[wp.vec3],
):
    i = wp.tid()
    tet = tets[first + i]
    at = origin
    for n in range(4):
        p = lattice[tet[n]]
        at += wp.float64(0.25) * spacing * wp.vec3d(wp.float64(p[0]), wp.float64(p[1]), wp.float64(p[2]))
    points[i] = wp.vec3(float(at[0]), float(at[1]), float(at[2]))


@wp.kernel(enable_backward=False)
def flag_wished(
    # In
    wished: wp.array[wp.uint8],
    first: int,
    # Out
    flags: wp.array[wp.int32],
):
    i = wp.tid()
    flags[i] = int(wished[first + i])


@wp.kernel(enable_backward=False)
def flag_open(
    # In
    elements: wp.array[wp.int32],
    states: wp.array[wp.int32],
    first: int,
    # Out
    flags: wp.array[wp.int32],
):
    i = wp.tid()
    flags[i] = wp.where(states[elements[i] - first] == OPEN, 1, 0)


@wp.kernel(enable_backward=False)
def take_wishes(
    # In
    states: wp.array[wp.int32],
    first: int,
    # Out
    wished: wp.array[wp.uint8],
):
    i = wp.tid()
    wished[first + i] = wp.where(states[i] == SPLIT, wp.uint8(1), wp.uint8(0))
