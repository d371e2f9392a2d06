"""Cutting: which faces of leaves a surface separates.

A face is cut if the line between the centroids of its two leaves crosses the surface. So a plane separates exactly the
leaves with centroids on either side, and strips that a blade sweeps one after the other leave no face between them.
Both leaves keep a bit for the face in ``Pools.cut``; ``split`` then separates nodes.

Leaves near the surface are listed, and their faces meet in a hash table: the second leaf to arrive finds the first.

Tears: the stress across a face is N S N, with the face's normal N at rest and the second Piola-Kirchhoff stress S of
St. Venant and Kirchhoff in the two leaves, in the mean; rotations do not change it. A face is cut if it is above a
bound and no other face of its leaves is pulled harder, so that a tear runs instead of shattering what is around it."""

import warp as wp

from warp_corot.kernels.elements.elements import load_node
from warp_corot.kernels.meshing.growth import EMPTY, LIVE, claim_slot, edge_key
from warp_corot.kernels.remesh.criteria import Contents, green_strain, load_state
from warp_corot.kernels.remesh.cut_surface import (
    NEAR,
    NEAR_DEFORMED,
    Surface,
    centroid,
    crossing,
    is_far,
    is_near,
    near_triangle,
    next_near,
    place_of,
    radius,
)
from warp_corot.kernels.remesh.pools import ADDED, FRESH, FULL, LEAVES, REFINE, REMOVED, Carried, Pools, doubled

wp.set_module_options({"enable_backward": False})

# Places in ``Cuts.counts``.
STARS = wp.constant(0)  # listed leaves
MARKED = wp.constant(1)  # nodes around which leaves may have come apart
COPIES = wp.constant(2)  # nodes made in this cut
STAMP = wp.constant(3)  # number of cuts
FACES = wp.constant(4)  # faces cut in this cut
COUNTS = 5

#: Surfaces meet at an edge if the square of the sine of their angle is larger; otherwise they are one.
APART = wp.constant(wp.float64(0.1))
#: A leaf's bits in ``Cuts.fresh``: its faces that are cut now, and of these those that it has the surface behind.
SIDE_SHIFT = wp.constant(4)


@wp.struct
class Cuts:
    """Room for one cut: leaves near a surface, then leaves around marked nodes; "stars"."""

    counts: wp.array[wp.int32]
    room: int  # stars, at most
    stars: wp.array[wp.int32]  # places in the list of leaves
    fresh: wp.array[wp.int32]  # [stars] faces cut now
    # Faces: of star s and opposite to its node n at 4 s + n.
    slot: wp.array[wp.int32]  # in the table; -1 for none
    pull: wp.array[wp.float32]  # stress across it [Pa]
    other: wp.array[wp.int32]  # the same face of the other leaf, -1 if there is none
    keys: wp.array[wp.int64]
    owner: wp.array[wp.int32]  # [slots] the face that came first, -1
    # Corners: node n of star s at 4 s + n.
    link: wp.array[wp.int32]  # another corner of the same component; the smallest is linked to itself
    copy: wp.array[wp.int32]  # the new node of a smallest corner, -1 if it keeps its own
    # Nodes.
    mark: wp.array[wp.int32]  # the last cut in which a node was marked
    marked: wp.array[wp.int32]
    keeper: wp.array[wp.int32]  # the smallest corner of all its components, which keeps the node
    toughness: float  # energy of a cut [J/m^2], if all elements have the same
    toughness_column: int  # else a column of ``Carried.values``, or -1
    former_mass: wp.array[wp.float64]  # of marked nodes, and of those that new nodes are copies of
    names: wp.array2d[wp.int32]  # ``Pools.tets``, number by number


@wp.func
def face_node(face: int, n: int):
    """The n-th local node of the face opposite to a node."""
    return wp.where(n < face, n, n + 1)


@wp.func
def face_key(tet: wp.vec4i, face: int):
    """A key of the face's three nodes, in any order; keys of different faces are equal once in 2**63."""
    a = tet[face_node(face, 0)]
    b = tet[face_node(face, 1)]
    c = tet[face_node(face, 2)]
    low = wp.min(a, wp.min(b, c))
    high = wp.max(a, wp.max(b, c))
    mixed = wp.uint64(edge_key(low, high)) * wp.uint64(11400714819323198485)
    mixed = (mixed ^ (mixed >> wp.uint64(29))) + wp.uint64(a + b + c - low - high)
    mixed = mixed * wp.uint64(13787848793156543929)
    return wp.int64((mixed ^ (mixed >> wp.uint64(32))) >> wp.uint64(1))


@wp.func
def meet(s: int, face: int, tet: wp.vec4i, cuts: Cuts):
    """Enter a face of a star; returns the same face of another star if that came before, else -1, and notes both."""
    slot = claim_slot(face_key(tet, face), cuts.keys)
    if slot < 0:
        slot = -slot - 1
    f = 4 * s + face
    cuts.slot[f] = slot
    before = wp.atomic_exch(cuts.owner, slot, f)
    if before >= 0:
        cuts.other[f] = before
        cuts.other[before] = f
    return before


@wp.func
def add_star(i: int, pools: Pools, cuts: Cuts):
    """List a leaf."""
    s = wp.atomic_add(cuts.counts, STARS, 1)
    if s >= cuts.room:
        wp.atomic_max(pools.counts, FULL, 1)
        return
    cuts.stars[s] = i
    cuts.fresh[s] = 0
    for n in range(4):
        cuts.slot[4 * s + n] = -1
        cuts.other[4 * s + n] = -1
        cuts.link[4 * s + n] = 4 * s + n
        cuts.copy[4 * s + n] = -1


@wp.func
def star_count(cuts: Cuts):
    """The number of stars; none if there is no room for all of them."""
    count = cuts.counts[STARS]
    return wp.where(count > cuts.room, 0, count)


@wp.func
def is_cut(f: int, pools: Pools, cuts: Cuts):
    """Whether the face of a star is cut."""
    return (pools.cut[pools.leaves[cuts.stars[f / 4]]] >> (f % 4)) % 2 == 1


@wp.kernel(enable_backward=False)
def begin_cut(
    # In
    follows_pass: int,
    # In and out
    pools: Pools,
    cuts: Cuts,
):
    counts = cuts.counts
    if follows_pass == 0:
        pools.counts[ADDED] = 0
        pools.counts[REMOVED] = 0
    counts[STAMP] = counts[STAMP] + 1
    counts[STARS] = 0
    counts[MARKED] = 0
    counts[COPIES] = 0
    counts[FACES] = 0


@wp.kernel(enable_backward=False)
def list_near(
    # In
    threads: int,
    surface: Surface,
    carried: Carried,
    # In and out
    pools: Pools,
    cuts: Cuts,
):
    """List the leaves near a surface; all, if faces tear."""
    near = wp.where(surface.is_deformed > wp.float64(0.0), NEAR_DEFORMED, NEAR)
    for i in range(wp.tid(), pools.counts[LEAVES], threads):
        tet = pools.leaf_tets[i]
        if is_far(i, near + wp.float64(1.0), surface, pools, carried):
            continue
        x = centroid(tet, surface.is_deformed, pools, carried)
        far = near * radius(tet, x, surface.is_deformed, pools, carried)
        if surface.stress > 0.0 or is_near(x, far, surface):
            add_star(i, pools, cuts)


@wp.kernel(enable_backward=False)
def mark_near(
    # In
    threads: int,
    surface: Surface,
    carried: Carried,
    # In and out
    pools: Pools,
):
    """Mark leaves at triangles for refinement to the triangles' levels."""
    for i in range(wp.tid(), pools.counts[LEAVES], threads):
        mark = wp.int8(0)
        if not is_far(i, wp.float64(2.0), surface, pools, carried):
            tet = pools.leaf_tets[i]
            x = centroid(tet, surface.is_deformed, pools, carried)
            far = radius(tet, x, surface.is_deformed, pools, carried)
            level = pools.level[pools.leaves[i]]
            t = next_near(0, x, x, far, surface)
            while t < surface.count:
                if level < surface.levels[t] and near_triangle(t, x, far, surface):
                    mark = REFINE
                t = next_near(t + 1, x, x, far, surface)
        pools.marks[i] = mark


@wp.kernel(enable_backward=False)
def cross_faces(
    # In
    threads: int,
    surface: Surface,
    carried: Carried,
    # In and out
    pools: Pools,
    cuts: Cuts,
):
    """Cut the faces between near leaves on different sides."""
    for f in range(wp.tid(), 4 * star_count(cuts), threads):
        s = f / 4
        tet = pools.leaf_tets[cuts.stars[s]]
        before = meet(s, f % 4, tet, cuts)
        if before >= 0 and not is_cut(f, pools, cuts):
            p = centroid(tet, surface.is_deformed, pools, carried)
            q = centroid(pools.leaf_tets[cuts.stars[before / 4]], surface.is_deformed, pools, carried)
            normal, _t = crossing(p, q, surface)
            if wp.length_sq(normal) > wp.float64(0.0):
                side = wp.where(wp.dot(normal, q - p) > wp.float64(0.0), 0, 1)
                cut_side(f, side, pools, cuts)
                cut_side(before, 1 - side, pools, cuts)


@wp.func
def cut_side(f: int, side: int, pools: Pools, cuts: Cuts):
    bit = wp.lshift(1, f % 4)
    wp.atomic_or(pools.cut, pools.leaves[cuts.stars[f / 4]], bit)
    wp.atomic_or(cuts.fresh, f / 4, bit | wp.lshift(side, SIDE_SHIFT + f % 4))


@wp.func
def heal_side(f: int, pools: Pools, cuts: Cuts):
    bit = wp.lshift(1, f % 4)
    wp.atomic_and(pools.cut, pools.leaves[cuts.stars[f / 4]], ~bit)
    wp.atomic_and(cuts.fresh, f / 4, ~bit)


@wp.kernel(enable_backward=False)
def join_lone(
    # In
    threads: int,
    # In and out
    pools: Pools,
    cuts: Cuts,
):
    """Leave a leaf with the leaves on one side of the surface if it would hang on no face."""
    for s in range(wp.tid(), star_count(cuts), threads):
        fresh = cuts.fresh[s]
        if fresh % 16 != 0:
            hangs = bool(False)
            side = int(-1)
            for n in range(4):
                if cuts.other[4 * s + n] >= 0 and not is_cut(4 * s + n, pools, cuts):
                    hangs = True
                if (fresh >> n) % 2 == 1 and side < 0:
                    side = (fresh >> (SIDE_SHIFT + n)) % 2
            if not hangs:
                for n in range(4):
                    if (fresh >> n) % 2 == 1 and (fresh >> (SIDE_SHIFT + n)) % 2 == side:
                        heal_side(4 * s + n, pools, cuts)
                        heal_side(cuts.other[4 * s + n], pools, cuts)


@wp.func
def mark_face(tet: wp.vec4i, face: int, carried: Carried, cuts: Cuts):
    """Mark the nodes of a face, because leaves around them may have come apart."""
    for n in range(3):
        node = tet[face_node(face, n)]
        stamp = cuts.counts[STAMP]
        if cuts.mark[node] != stamp and wp.atomic_exch(cuts.mark, node, stamp) != stamp:
            cuts.marked[wp.atomic_add(cuts.counts, MARKED, 1)] = node
            cuts.keeper[node] = 2147483647
            cuts.former_mass[node] = carried.mass[node]


@wp.func
def shared_area(tet: wp.vec4i, face: int, normal: wp.vec3d, surface: Surface, pools: Pools, carried: Carried):
    """The area of the surface that a face stands for, at rest: that of its projection, or its own if it tears."""
    a = tet[face_node(face, 0)]
    b = tet[face_node(face, 1)]
    c = tet[face_node(face, 2)]
    zero = wp.float64(0.0)
    x = place_of(a, zero, pools, carried)
    at_rest = wp.cross(place_of(b, zero, pools, carried) - x, place_of(c, zero, pools, carried) - x)
    now = at_rest
    if surface.is_deformed > zero:
        x = place_of(a, surface.is_deformed, pools, carried)
        y = place_of(b, surface.is_deformed, pools, carried)
        now = wp.cross(y - x, place_of(c, surface.is_deformed, pools, carried) - x)
    if surface.stress > 0.0:
        return wp.float64(0.5) * wp.length(at_rest)
    size = wp.length(now)
    if size == zero:
        return zero
    return wp.float64(0.5) * wp.abs(wp.dot(now, normal)) * wp.length(at_rest) / size


@wp.func
def filled(i: int, pools: Pools, carried: Carried):
    """The share of a leaf that is inside the body."""
    if carried.fill_column < 0:
        return 1.0
    return wp.min(carried.values[pools.leaves[i], carried.fill_column], 1.0)


@wp.func
def toughness_of(e: int, carried: Carried, cuts: Cuts):
    if cuts.toughness_column >= 0:
        return carried.values[e, cuts.toughness_column]
    return cuts.toughness


@wp.func
def snap_face(
    tet: wp.vec4i,
    face: int,
    normal: wp.vec3d,
    t: int,
    surface: Surface,
    pools: Pools,
    carried: Carried,
):
    """Note how far the nodes of a face are from the surface, which a leaf brings back to rest.

    A node that is on another cut already stays on it.
    """
    offset = surface.offset
    if t >= 0:
        offset = wp.dot(normal, surface.points[surface.triangles[t][0]])
    zero = wp.float64(0.0)
    x = place_of(tet[0], surface.is_deformed, pools, carried)
    at_rest = place_of(tet[0], zero, pools, carried)
    now = wp.mat33d()
    before = wp.mat33d()
    for n in range(3):
        edge = place_of(tet[n + 1], surface.is_deformed, pools, carried) - x
        edge_at_rest = place_of(tet[n + 1], zero, pools, carried) - at_rest
        for axis in range(3):
            now[axis, n] = edge[axis]
            before[axis, n] = edge_at_rest[axis]
    across = wp.transpose(now * wp.inverse(before)) * normal
    square = wp.length_sq(across)
    most = NEAR * radius(tet, centroid(tet, zero, pools, carried), zero, pools, carried)
    for n in range(3):
        node = tet[face_node(face, n)]
        away = offset - wp.dot(normal, place_of(node, surface.is_deformed, pools, carried))
        if wp.abs(away) <= most * wp.sqrt(square):
            move = (away / square) * across
            other = doubled(load_node(carried.snap, node))
            if wp.length_sq(other) > zero:
                along = across - (wp.dot(across, other) / wp.length_sq(other)) * other
                both = other + ((away - wp.dot(across, other)) / wp.length_sq(along)) * along
                if wp.length_sq(along) > APART * square and wp.length(both) <= most:
                    move = both
            carried.snap[node] = wp.vec4(float(move[0]), float(move[1]), float(move[2]), 0.0)


@wp.kernel(enable_backward=False)
def count_faces(
    # In
    threads: int,
    surface: Surface,
    # In and out
    carried: Carried,
    pools: Pools,
    cuts: Cuts,
):
    """Add up the area and the energy of the faces that are cut now, mark their nodes, and clear the table."""
    area = wp.float64(0.0)
    for f in range(wp.tid(), 4 * star_count(cuts), threads):
        s = f / 4
        if (cuts.fresh[s] >> (f % 4)) % 2 == 1:
            tet = pools.leaf_tets[cuts.stars[s]]
            mark_face(tet, f % 4, carried, cuts)
            if f < cuts.other[f]:
                p = centroid(tet, surface.is_deformed, pools, carried)
                i = cuts.stars[cuts.other[f] / 4]
                q = centroid(pools.leaf_tets[i], surface.is_deformed, pools, carried)
                normal, t = crossing(p, q, surface)
                if surface.stress > 0.0:
                    normal = wp.vec3d()
                part = shared_area(tet, f % 4, normal, surface, pools, carried)
                part *= wp.float64(0.5 * (filled(i, pools, carried) + filled(cuts.stars[s], pools, carried)))
                area += part
                if surface.stress == 0.0:
                    snap_face(tet, f % 4, normal, t, surface, pools, carried)
                wp.atomic_add(cuts.counts, FACES, 1)
                if t >= 0:
                    both = toughness_of(pools.leaves[i], carried, cuts)
                    both += toughness_of(pools.leaves[cuts.stars[s]], carried, cuts)
                    wp.atomic_add(surface.debt, t, wp.float64(0.5 * both) * part)
        forget(f, cuts)
    if area > wp.float64(0.0):
        wp.atomic_add(carried.cut_area, 0, area)


@wp.func
def forget(f: int, cuts: Cuts):
    """Take a face out of the table."""
    slot = cuts.slot[f]
    if slot >= 0:
        cuts.keys[slot] = EMPTY
        cuts.owner[slot] = -1


@wp.kernel(enable_backward=False)
def mark_bisected(
    # In
    threads: int,
    carried: Carried,
    # In and out
    pools: Pools,
    cuts: Cuts,
):
    """Mark the nodes of cut faces that the last pass bisected: a midpoint is made once for both sides."""
    for i in range(wp.tid(), 2 * pools.counts[FRESH], threads):
        e = pools.fresh[i / 2] + i % 2
        if pools.first_child[e] == LIVE:
            for face in range(4):
                if (pools.cut[e] >> face) % 2 == 1:
                    mark_face(pools.tets[e], face, carried, cuts)


@wp.kernel(enable_backward=False)
def pull_faces(
    # In
    threads: int,
    contents: Contents,
    carried: Carried,
    # In and out
    pools: Pools,
    cuts: Cuts,
):
    """Find the stress of each leaf across its faces, and the leaves on both sides of each."""
    for s in range(wp.tid(), star_count(cuts), threads):
        i = cuts.stars[s]
        element = load_state(pools.leaves[i], carried.origin, carried.spacing, pools, contents, carried.u)
        e = green_strain(element)
        for face in range(4):
            a = element.rest[face_node(face, 0)]
            normal = wp.cross(element.rest[face_node(face, 1)] - a, element.rest[face_node(face, 2)] - a)
            normal = wp.normalize(normal)
            cuts.pull[4 * s + face] = element.lam * wp.trace(e) + 2.0 * element.mu * wp.dot(normal, e * normal)
            meet(s, face, pools.leaf_tets[i], cuts)


@wp.func
def mean_pull(f: int, pools: Pools, cuts: Cuts):
    """The mean stress across a face that holds two leaves together; zero across others."""
    other = cuts.other[f]
    if other < 0 or is_cut(f, pools, cuts):
        return 0.0
    return 0.5 * (cuts.pull[f] + cuts.pull[other])


@wp.kernel(enable_backward=False)
def choose_faces(
    # In
    threads: int,
    surface: Surface,
    pools: Pools,
    # In and out
    cuts: Cuts,
):
    """Choose the faces that tear: those above the bound, and above all others of both leaves."""
    for f in range(wp.tid(), 4 * star_count(cuts), threads):
        other = cuts.other[f]
        cuts.link[f] = 0
        if other > f:
            pull = mean_pull(f, pools, cuts)
            if pull > surface.stress:
                most = float(0.0)
                for n in range(4):
                    most = wp.max(most, mean_pull(4 * (f / 4) + n, pools, cuts))
                    most = wp.max(most, mean_pull(4 * (other / 4) + n, pools, cuts))
                if pull >= most:
                    cuts.link[f] = 1


@wp.kernel(enable_backward=False)
def tear_faces(
    # In
    threads: int,
    # In and out
    pools: Pools,
    cuts: Cuts,
):
    """Cut the chosen faces."""
    for f in range(wp.tid(), 4 * star_count(cuts), threads):
        if cuts.link[f] == 1:
            cut_side(f, 0, pools, cuts)
            cut_side(cuts.other[f], 1, pools, cuts)
