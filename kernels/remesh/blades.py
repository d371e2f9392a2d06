"""Blades: where their edges are in the body at rest, the strips that they sweep there, and what they feel.

An edge is a row of points. Each has a place in the body at rest: that of the tissue where it is, or of the nearest
surface if it is outside but near. From one cut to the next, two neighbours sweep two triangles there, whose corners go
on in the next ones; so strips have no gaps, however the body deforms.

A face that is cut takes an energy, its area times the toughness. The edge owes it, and pays while it moves on through
the tissue: it pushes with the debt over the size of an element. In a steady cut that is the toughness times the length
of the edge, and the work of the push is exactly the energy of the cut.
"""

import warp as wp

from warp_corot.kernels.contact.motion import Motions, move_obstacle
from warp_corot.kernels.elements.elements import load_node
from warp_corot.kernels.meshing.bisection import single
from warp_corot.kernels.stepping.pace import DONE, DT, Pace

from .cut_surface import BUNDLE, Surface
from .pools import LEAVES, Carried, Pools, doubled, modulus_of

wp.set_module_options({"enable_backward": False})

#: A point's quality in a leaf, its smallest barycentric coordinate, in the upper half of ``Edges.best``.
QUALITIES = wp.constant(1048576.0)
#: Leaves in which it is lower do not count.
LEAST = wp.constant(-1.5)
#: A point is in the tissue down to this quality.
INSIDE = wp.constant(-0.02)
#: The nearest surface counts up to this distance, over the size of the element there.
REACH = wp.constant(1.0)
#: No point is found in a leaf that has a node farther from the blade than this many times its size: so is none in
#: leaves that are stretched to three times their length.
FAR = wp.constant(10.0)
#: A point that is outside now or was before, and is farther on at rest than this many times that size, has not cut.
JUMP = wp.constant(2.0)
#: Fraction of its motion relative to the tissue that a push may stop in a step: points share nodes.
HOLD = wp.constant(0.2)
#: A point pushes at most so hard, over the modulus and the area of an element: harder pushes would crush it.
STRENGTH = wp.constant(0.03)

OUTSIDE = wp.constant(0)
AT_SURFACE = wp.constant(1)
IN_TISSUE = wp.constant(2)


@wp.struct
class Edges:
    """Points on the edges of blades, [P], of one body."""

    blade: wp.array[wp.int32]
    local: wp.array[wp.vec3]  # in the blade's frame [m]
    goes_on: wp.array[wp.int32]  # whether the next point is on the same edge
    x: wp.array[wp.vec3]  # where it is [m]
    bounds: wp.array[wp.vec3d]  # [2] of these places
    best: wp.array[wp.int64]  # quality and leaf
    nodes: wp.array[wp.vec4i]  # of that leaf
    weights: wp.array[wp.vec4]
    size: wp.array[wp.float32]  # of that leaf [m]
    state: wp.array[wp.int32]  # OUTSIDE, AT_SURFACE or IN_TISSUE
    former: wp.array[wp.vec3]  # where it was at the last cut [m]
    swept: wp.array[wp.int32]  # whether it has cut since then
    push: wp.array[wp.vec3]  # [2 P] by the edge from a point to the next one, at the one and the other [N]
    move: wp.array[wp.vec3]  # [2 P] how far these have gone in the step [m]
    dt: wp.array[wp.float32]  # its length [s]
    work: wp.array[wp.float64]  # [blades] done on the tissue [J]
    modulus: wp.array[wp.float32]  # of the leaf that each is in [Pa]
    common: float  # modulus of all leaves that carry none


@wp.func
def tissue_place(node: int, carried: Carried):
    return load_node(carried.rest, node) + load_node(carried.u, node)


@wp.kernel(enable_backward=False)
def begin_step(
    # In
    pace: Pace,
    offset: int,
    # In and out
    moved: wp.array[wp.int64],
    # Out
    begins: wp.array[wp.int32],
):
    """Whether these forces are the first of a step; implicit steps ask for them several times."""
    step = pace.counts[DONE] + wp.int64(offset)
    begins[0] = wp.where(moved[0] == step, 0, 1)
    moved[0] = step


@wp.kernel(enable_backward=False)
def move_blades(
    # In
    begins: wp.array[wp.int32],
    motions: Motions,
    pace: Pace,
    world_starts: wp.array[wp.float64],
    offset: int,
    # In and out
    wrenches: wp.array2d[wp.spatial_vectorf],
):
    """Move the blades to where they are at the end of a step."""
    if begins[0] != 0:
        o = wp.tid()
        move_obstacle(0, o, motions, pace, world_starts, offset)
        wrenches[o, 0] = wp.spatial_vector()


@wp.kernel(enable_backward=False)
def empty_boxes(
    # Out
    bounds: wp.array[wp.vec3d],
):
    """Begin boxes, the lowest and the highest corner of each in turn."""
    b = wp.tid()
    bounds[b] = wp.vec3d(wp.float64(1.0e30 * (1.0 - 2.0 * float(b % 2))))


@wp.func
def extend_box(b: int, low: wp.vec3d, high: wp.vec3d, bounds: wp.array[wp.vec3d]):
    wp.atomic_min(bounds, 2 * b, low)
    wp.atomic_max(bounds, 2 * b + 1, high)


@wp.kernel(enable_backward=False)
def place_points(
    # In
    motions: Motions,
    # In and out
    edges: Edges,
):
    """Find where points are, and extend their box."""
    k = wp.tid()
    x = wp.transform_point(motions.later[0, edges.blade[k]], edges.local[k])
    edges.x[k] = x
    edges.best[k] = wp.int64(-1)
    extend_box(0, doubled(x), doubled(x), edges.bounds)


@wp.func
def coordinates(x: wp.vec3, tet: wp.vec4i, carried: Carried):
    """Barycentric coordinates in a leaf, where it is now; all are low if it has no volume."""
    a = tissue_place(tet[0], carried)
    b = tissue_place(tet[1], carried) - a
    c = tissue_place(tet[2], carried) - a
    d = tissue_place(tet[3], carried) - a
    volume = wp.dot(b, wp.cross(c, d))
    if volume == 0.0:
        return wp.vec4(LEAST - 1.0)
    p = x - a
    second = wp.dot(p, wp.cross(c, d)) / volume
    third = wp.dot(b, wp.cross(p, d)) / volume
    fourth = wp.dot(b, wp.cross(c, p)) / volume
    return wp.vec4(1.0 - second - third - fourth, second, third, fourth)


@wp.kernel(enable_backward=False)
def find_leaves(
    # In
    threads: int,
    pools: Pools,
    carried: Carried,
    # In and out
    edges: Edges,
):
    """Find the leaf in which each point has the highest quality."""
    box_low = single(edges.bounds[0])
    box_high = single(edges.bounds[1])
    for i in range(wp.tid(), pools.counts[LEAVES], threads):
        tet = pools.leaf_tets[i]
        low = tissue_place(tet[0], carried)
        high = low
        size = float(carried.size[pools.level[pools.leaves[i]]])
        if are_apart(low, high, box_low, box_high, FAR * size):
            continue
        for n in range(1, 4):
            low = wp.min(low, tissue_place(tet[n], carried))
            high = wp.max(high, tissue_place(tet[n], carried))
        if are_apart(low, high, box_low, box_high, REACH * size):
            continue
        for k in range(edges.x.shape[0]):
            x = edges.x[k]
            if not are_apart(low, high, x, x, REACH * size):
                quality = wp.min(coordinates(x, tet, carried))
                if quality > LEAST:
                    rank = wp.int64(int((quality - LEAST) * QUALITIES))
                    wp.atomic_max(edges.best, k, (rank << wp.int64(32)) | wp.int64(i))


@wp.func
def are_apart(low: wp.vec3, high: wp.vec3, other_low: wp.vec3, other_high: wp.vec3, gap: float):
    """Whether there is a gap between two boxes."""
    apart = bool(False)
    for axis in range(3):
        apart = apart or low[axis] - gap > other_high[axis] or high[axis] + gap < other_low[axis]
    return apart


@wp.func
def place_at_rest(tet: wp.vec4i, w: wp.vec4, carried: Carried):
    """The place at rest of a point with these coordinates in a leaf, whose deformation goes on beyond it."""
    place = wp.vec3d()
    for n in range(4):
        place += wp.float64(w[n]) * doubled(load_node(carried.rest, tet[n]))
    return place


@wp.func
def adopt_point(k: int, pools: Pools, carried: Carried, edges: Edges):
    """Bind a point to its leaf; returns its place at rest."""
    edges.state[k] = OUTSIDE
    if edges.best[k] < wp.int64(0):
        return wp.vec3d()
    i = int(edges.best[k] & wp.int64(4294967295))
    tet = pools.leaf_tets[i]
    weights = coordinates(edges.x[k], tet, carried)
    size = float(carried.size[pools.level[pools.leaves[i]]])
    state = int(IN_TISSUE)
    if wp.min(weights) < INSIDE:
        state = int(AT_SURFACE)
        weights = wp.max(weights, wp.vec4(0.0))
        weights = weights / (weights[0] + weights[1] + weights[2] + weights[3])
    there = wp.vec3()
    for n in range(4):
        there += weights[n] * tissue_place(tet[n], carried)
    if wp.length(there - edges.x[k]) > REACH * size:
        state = int(OUTSIDE)
    edges.nodes[k] = tet
    edges.weights[k] = weights
    edges.size[k] = size
    edges.modulus[k] = modulus_of(pools.leaves[i], edges.common, carried)
    edges.state[k] = state
    return place_at_rest(tet, weights, carried)


@wp.kernel(enable_backward=False)
def bind_points(
    # In
    pools: Pools,
    carried: Carried,
    # In and out
    edges: Edges,
):
    """Bind the points to the leaves in which they are."""
    adopt_point(wp.tid(), pools, carried, edges)


@wp.kernel(enable_backward=False)
def sweep_points(
    # In
    begins: int,
    pools: Pools,
    carried: Carried,
    # In and out
    edges: Edges,
    surface: Surface,
):
    """Bind points, and find from where to where at rest each has come, and whether it has cut on its way.

    What ended the last strips begins the next ones. Before a point met the tissue and after it left it, the leaf that
    it met or left says where it was.
    """
    k = wp.tid()
    count = edges.x.shape[0]
    former = edges.state[k]
    left = edges.nodes[k]
    start = surface.points[count + k]
    end = adopt_point(k, pools, carried, edges)
    last = end
    state = edges.state[k]
    swept = former != OUTSIDE and state != OUTSIDE
    if (former != IN_TISSUE or state != IN_TISSUE) and wp.length(end - start) > wp.float64(JUMP * edges.size[k]):
        swept = False
    if not swept and state == IN_TISSUE:
        start = place_at_rest(edges.nodes[k], coordinates(edges.former[k], edges.nodes[k], carried), carried)
        swept = True
    elif not swept and former == IN_TISSUE:
        last = place_at_rest(left, coordinates(edges.x[k], left, carried), carried)
        swept = True
    edges.former[k] = edges.x[k]
    edges.swept[k] = wp.where(swept and begins == 0, 1, 0)
    surface.points[k] = start
    surface.points[count + k] = end
    surface.points[2 * count + k] = last


@wp.kernel(enable_backward=False)
def sweep_strips(
    # In
    edges: Edges,
    # In and out
    surface: Surface,
):
    """Make the triangles that the edges have swept since the last time, and extend their boxes."""
    k = wp.tid()
    last = 2 * edges.x.shape[0] + k
    surface.triangles[2 * k] = wp.vec3i(k, k, k)
    surface.triangles[2 * k + 1] = wp.vec3i(k, k, k)
    if edges.goes_on[k] == 1 and edges.swept[k] == 1 and edges.swept[k + 1] == 1:
        surface.triangles[2 * k] = wp.vec3i(k, k + 1, last + 1)
        surface.triangles[2 * k + 1] = wp.vec3i(k, last + 1, last)
        for n in range(2):
            low = wp.min(surface.points[k + n], surface.points[last + n])
            high = wp.max(surface.points[k + n], surface.points[last + n])
            extend_box(0, low, high, surface.bounds)
            extend_box(1 + 2 * k / BUNDLE, low, high, surface.bounds)


@wp.func
def tissue_velocity(k: int, carried: Carried, edges: Edges):
    v = wp.vec3()
    for m in range(4):
        v += edges.weights[k][m] * load_node(carried.v, edges.nodes[k][m])
    return v


@wp.func
def push_of(k: int, move: wp.vec3, along: wp.vec3, most: float, dt: float, carried: Carried, edges: Edges):
    """The push of a point that moves so far in a step [N], at most so large."""
    v = move / dt - tissue_velocity(k, carried, edges)
    v -= wp.dot(v, along) * along
    speed = wp.length(v)
    if speed == 0.0:
        return wp.vec3()
    size = edges.size[k]
    yielding = float(0.0)
    for m in range(4):
        w = edges.weights[k][m]
        yielding += w * w * carried.inverse_mass[edges.nodes[k][m]]
    # Neither inertia nor elasticity stops more than a fraction of the motion.
    modulus = edges.modulus[k]
    holds = modulus * size * dt
    if yielding > 0.0:
        holds += 1.0 / (yielding * dt)
    return wp.min(wp.min(most, STRENGTH * modulus * size * size) / speed, HOLD * holds) * v


@wp.kernel(enable_backward=False)
def decide_pushes(
    # In
    begins: wp.array[wp.int32],
    motions: Motions,
    pace: Pace,
    carried: Carried,
    # In and out
    edges: Edges,
    debt: wp.array[wp.float64],
    wrenches: wp.array2d[wp.spatial_vectorf],
):
    """Let the edge between a point and the next one pay for its last push, and decide how hard it pushes in this step.

    What it pays is the work of the push in its motion relative to the tissue, which moves at its present velocity.
    """
    if begins[0] == 0:
        return
    k = wp.tid()
    if edges.goes_on[k] == 0:
        return
    owed = float(debt[2 * k] + debt[2 * k + 1])
    ends = int(0)
    for n in range(2):
        if edges.state[k + n] != OUTSIDE:
            ends += 1
            before = edges.push[2 * k + n]
            owed -= wp.dot(before, edges.move[2 * k + n] - edges.dt[k] * tissue_velocity(k + n, carried, edges))
        edges.push[2 * k + n] = wp.vec3()
    owed = wp.max(owed, 0.0)
    debt[2 * k] = wp.float64(owed)
    debt[2 * k + 1] = wp.float64(0.0)
    dt = float(pace.seconds[DT])
    edges.dt[k] = dt
    if owed == 0.0:
        return
    o = edges.blade[k]
    along = wp.normalize(wp.transform_vector(motions.later[0, o], edges.local[k + 1] - edges.local[k]))
    for n in range(2):
        if edges.state[k + n] != OUTSIDE:
            x = wp.transform_point(motions.later[0, o], edges.local[k + n])
            move = x - wp.transform_point(motions.now[0, o], edges.local[k + n])
            most = owed / (float(ends) * edges.size[k + n])
            force = push_of(k + n, move, along, most, dt, carried, edges)
            edges.push[2 * k + n] = force
            edges.move[2 * k + n] = move
            arm = x - wp.transform_get_translation(motions.later[0, o])
            wp.atomic_add(wrenches, o, 0, wp.spatial_vector(-force, -wp.cross(arm, force)))
            wp.atomic_add(edges.work, o, wp.float64(wp.dot(force, move)))


@wp.kernel(enable_backward=False)
def push_tissue(
    # In
    edges: Edges,
    # In and out
    forces: wp.array[wp.vec4],
):
    """Add the pushes of points to the forces of nodes."""
    f = wp.tid()
    force = edges.push[f]
    if wp.length_sq(force) > 0.0:
        k = f / 2 + f % 2
        for m in range(4):
            share = edges.weights[k][m] * force
            wp.atomic_add(forces, edges.nodes[k][m], wp.vec4(share[0], share[1], share[2], 0.0))
