"""The part of the body in an element: none, a part of its surface with its flatness, or the interior.

The body's signed function is known at the nodes; between them its Lipschitz constant bounds its change.
"""

import warp as wp

from warp_corot.kernels.tables.shapes import FIRST_NODE, SECOND_NODE

from .bisection import lattice_place, single
from .growth import VOID, Forest

wp.set_module_options({"enable_backward": False})

# State of a new element.
DONE = wp.constant(0)
SPLIT = wp.constant(1)
OPEN = wp.constant(2)
LEFT = wp.constant(3)  # not evaluated again

#: The need of an element that must be bisected in any case [m].
MUST = wp.constant(1.0e30)

#: A gradient below this fraction of the steepest possible one is raised to it.
FLATTEST = wp.constant(0.1)

vec6 = wp.types.vector(length=6, dtype=wp.float32)


@wp.kernel(enable_backward=False)
def node_points(
    # In
    first: int,
    forest: Forest,
    # Out
    points: wp.array[wp.vec3],
):
    """Positions in float64, with a single rounding."""
    i = wp.tid()
    points[i] = single(lattice_place(forest.lattice[first + i], forest.origin, forest.spacing))


@wp.kernel(enable_backward=False)
def take_values(
    # In
    found: wp.array[wp.float32],
    first: int,
    top: wp.vec3i,
    noise: float,
    # In and out
    forest: Forest,
):
    """Values of new nodes: the outermost faces of the grid are outside, and rounding noise counts as zero."""
    i = wp.tid()
    p = forest.lattice[first + i]
    value = found[i]
    if wp.abs(value) <= noise:
        value = 0.0
    if wp.min(p) == 0 or p[0] == top[0] or p[1] == top[1] or p[2] == top[2]:
        value = wp.max(value, 0.0)
    forest.phi[first + i] = value


@wp.func
def values_at(tet: wp.vec4i, forest: Forest):
    return wp.vec4(forest.phi[tet[0]], forest.phi[tet[1]], forest.phi[tet[2]], forest.phi[tet[3]])


@wp.kernel(enable_backward=False)
def judge_by_corners(
    # In
    first: int,
    min_level: int,
    max_level: int,
    # In and out
    forest: Forest,
    # Out
    states: wp.array[wp.int32],
):
    """Elements have no surface if values exceed the function's possible change over the distance from them.

    Every point of an element is within its circumradius of some corner, within the longest edge of each, and within
    half the circumradius of some corner or midpoint of an edge: these ten are the nodes of the eight elements three
    levels below, which have half the size. Values at midpoints are bounded by those at the ends.
    """
    i = wp.tid()
    own_level = forest.level[first + i]
    p = values_at(forest.tets[first + i], forest)
    lipschitz = forest.lipschitz
    near = lipschitz * forest.circumradius[own_level]
    lowest = wp.min(p)
    highest = wp.max(p)
    longest = float(0.0)
    for e in range(6):
        longest = wp.max(longest, forest.edges[own_level, e])
    outside = lowest > near or highest > lipschitz * longest
    inside = highest < -near or lowest < -lipschitz * longest
    for e in range(6):
        change = 0.5 * lipschitz * forest.edges[own_level, e]
        a = p[FIRST_NODE[e]]
        b = p[SECOND_NODE[e]]
        lowest = wp.min(lowest, wp.max(a, b) - change)
        highest = wp.max(highest, wp.min(a, b) + change)
    state = DONE
    need = float(0.0)
    if outside or lowest > 0.5 * near:
        forest.first_child[first + i] = VOID
    elif own_level < min_level:
        state = SPLIT
        need = MUST
    elif own_level < max_level and not (inside or highest < -0.5 * near):
        state = OPEN
    states[i] = state
    forest.need[first + i] = need


@wp.func
def gradient_size(tet: wp.vec4i, forest: Forest):
    """Length of the interpolant's gradient, bounded from below by a fraction of the steepest one."""
    p = forest.lattice[tet[0]]
    spacing = float(forest.spacing)
    rows = wp.mat33()
    rise = wp.vec3()
    for n in range(3):
        q = forest.lattice[tet[n + 1]]
        rows[n] = spacing * wp.vec3(float(q[0] - p[0]), float(q[1] - p[1]), float(q[2] - p[2]))
        rise[n] = forest.phi[tet[n + 1]] - forest.phi[tet[0]]
    # Scaled, so that determinants do not underflow in float32.
    size = wp.length(rows[0])
    gradient = wp.inverse(rows / size) * rise / size
    return wp.max(wp.length(gradient), FLATTEST * forest.lipschitz)


@wp.func
def worst_deviation(deviation: vec6):
    """The largest deviation of a quadratic function from the linear interpolant, given the deviations at the midpoints.

    At barycentric coordinates l it is the sum of 4 l_i l_j e_ij: 4/3 of the mean of the e at a face's centre, 3/2 of it
    at the centroid.
    """
    faces = wp.static(4.0 / 9.0) * wp.vec4(
        deviation[0] + deviation[1] + deviation[3],
        deviation[0] + deviation[2] + deviation[4],
        deviation[1] + deviation[2] + deviation[5],
        deviation[3] + deviation[4] + deviation[5],
    )
    worst = wp.max(wp.max(faces), -wp.min(faces))
    total = float(0.0)
    for e in range(6):
        total += deviation[e]
        worst = wp.max(worst, wp.abs(deviation[e]))
    return wp.max(worst, 0.25 * wp.abs(total))


@wp.func
def middle_of_piece(phi: wp.vec4):
    """Barycentric coordinates of the mean of the points where the surface cuts the edges of a crossed element."""
    place = wp.vec4(0.0)
    count = float(0.0)
    for e in range(6):
        a = FIRST_NODE[e]
        b = SECOND_NODE[e]
        if (phi[a] < 0.0) != (phi[b] < 0.0):
            t = phi[a] / (phi[a] - phi[b])
            place[a] = place[a] + 1.0 - t
            place[b] = place[b] + t
            count += 1.0
    return place / count


@wp.kernel(enable_backward=False)
def judge_by_edges(
    # In
    begin: int,
    elements: wp.array[wp.int32],
    first: int,
    slots: wp.array[wp.int32],
    # In and out
    forest: Forest,
    states: wp.array[wp.int32],
    # Out
    unsure: wp.array[wp.int32],
    probes: wp.array[wp.vec3],
    expected: wp.array[wp.float32],
    deviations: wp.array[wp.float32],
):
    """Compare the midpoints of the six edges with the linear interpolant: they determine a quadratic function.

    An element that would barely pass the finest tolerance is unsure and is evaluated once more, in the middle of
    its piece of the surface or at its centroid; ``expected`` is the quadratic function's value there. An element's
    need is the error of its piece of the surface [m]. ``begin`` is the first thread's place in ``elements``.
    """
    i = begin + wp.tid()
    element = elements[i]
    tet = forest.tets[element]
    own_level = forest.level[element]
    tolerance = forest.tolerances[own_level]
    least = forest.closest[own_level]
    radius = forest.circumradius[own_level]
    phi = values_at(tet, forest)
    deviation = vec6()
    lowest = wp.min(phi)
    highest = wp.max(phi)
    crossed = lowest < 0.0 and highest >= 0.0
    for e in range(6):
        middle = forest.phi[forest.values[slots[6 * i + e]]]
        lowest = wp.min(lowest, middle)
        highest = wp.max(highest, middle)
        deviation[e] = middle - 0.5 * (phi[FIRST_NODE[e]] + phi[SECOND_NODE[e]])
    worst = worst_deviation(deviation)

    state = OPEN
    need = float(0.0)
    near = 0.5 * forest.lipschitz * radius
    if lowest > near:
        forest.first_child[element] = VOID
        state = DONE
    elif highest < -near:
        state = DONE
    elif crossed:
        slope = gradient_size(tet, forest)
        tolerance *= slope
        least *= slope
        need = worst / slope
        if worst > tolerance:
            state = SPLIT
    elif wp.max(lowest, -highest) <= 2.0 * worst:
        need = worst
        if worst > tolerance:
            state = SPLIT
    if state == OPEN and (worst > least or worst < 0.25 * least or wp.max(lowest, -highest) > 4.0 * worst):
        state = DONE
    states[element - first] = state
    forest.need[element] = wp.min(need, radius)
    unsure[i] = wp.where(state == OPEN, 1, 0)

    place = wp.vec4(0.25)
    if crossed:
        place = middle_of_piece(phi)
    value = wp.dot(place, phi)
    for e in range(6):
        value += 4.0 * place[FIRST_NODE[e]] * place[SECOND_NODE[e]] * deviation[e]
    at = wp.vec3d()
    for n in range(4):
        at += wp.float64(place[n]) * lattice_place(forest.lattice[tet[n]], forest.origin, forest.spacing)
    probes[i] = single(at)
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
    # In and out
    forest: Forest,
    # Out
    states: wp.array[wp.int32],
):
    """The last evaluation. Where the function is not the quadratic one of its ten values, for example at a crease, it
    deviates more between the samples than at them: by half as much again where three faces meet."""
    i = wp.tid()
    element = elements[chosen[i]]
    tet = forest.tets[element]
    inside = int(0)
    for n in range(4):
        if forest.phi[tet[n]] < 0.0:
            inside += 1
    surprise = wp.abs(found[i] - expected[chosen[i]])
    deviation = deviations[chosen[i]]
    if surprise > 0.1 * deviation:
        deviation = 1.5 * deviation + surprise
    state = DONE
    need = forest.need[element]
    if inside > 0 and inside < 4:
        need = deviation / gradient_size(tet, forest)
    elif (found[i] < 0.0) != (inside == 4):
        need = wp.max(wp.abs(found[i]), deviation)
    elif wp.abs(found[i]) <= 2.0 * deviation:
        need = deviation
    if need > forest.tolerances[forest.level[element]]:
        state = SPLIT
    states[element - first] = state
    forest.need[element] = need
