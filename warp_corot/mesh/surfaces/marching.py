"""Surfaces in tetrahedra: marched, between labels, with the body's edges.

Marching tetrahedra give the zero surface of the linear interpolant. Each edge between a node inside and one outside has
a vertex, so triangles on the same edge share a vertex. A node at exactly zero counts as outside; all vertices around it
are merged, and triangles that lose a side are removed.

Surfaces between labels (Nielson and Franke 1997, *Computing the separating surface for segmented data*) have a vertex
on each edge between two labels, in each face with three, and in each element with four. So the surfaces of all labels
fit together without gaps, and each label's surface is closed.

Creases (Kobbelt, Botsch, Schwanecke and Seidel 2001, *Feature sensitive surface extraction from volume data*): if the
normals at the vertices of one element's polygon differ by more than an angle, a crease goes through the element. Then a
vertex is added where the tangent planes meet, and edges between two elements with such vertices are flipped to follow
the crease."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from warp_corot.kernels.tables.shapes import EDGES
from warp_corot.mesh.surfaces.bound import SurfaceMesh
from warp_corot.mesh.topology import boundary_faces, codes, signed_volumes

if TYPE_CHECKING:
    from warp_corot.domain import Domain

Array = np.ndarray


def _polygon(code: int) -> list[tuple[int, int]]:
    """The polygon in a right-handed element with these inside nodes; its corners are (inner node, outer node)."""
    inside = [n for n in range(4) if code >> n & 1]
    outside = [n for n in range(4) if n not in inside]
    found = list(itertools.product(inside, outside))
    if len(found) == 4:
        found[2:] = found[:1:-1]
    order = inside + outside
    odd = sum(a > b for a, b in itertools.combinations(order, 2)) % 2
    return [found[0], *found[:0:-1]] if odd and found else found


POLYGONS = [_polygon(code) for code in range(16)]


def marched(points: Array, tets: Array, values: Array) -> SurfaceMesh:
    """The zero surface of the linear interpolant of nodal values.

    Args:
        points: Positions of the nodes [m], float64 [n, 3].
        tets: Nodes of the elements, int32 [T, 4].
        values: Signed function at the nodes, negative inside [n].

    Returns:
        The surface, counter-clockwise seen from outside. Its points are bound to the two ends of their edges, the inner
        one first.
    """
    ends, polygons, _ = crossing_polygons(points, tets, values)
    return _merged_surface(points, ends[plain_triangles(polygons, ends)], values)


def marched_cut(points: Array, tets: Array, values: Array) -> SurfaceMesh:
    """As ``marched``, closed where elements have come apart: with the parts that are inside of faces of one element.

    Args:
        points, values: As for ``marched``.
        tets: Nodes of all elements with a node inside.

    Returns:
        As ``marched``, with ``is_cut``.
    """
    around = marched(points, tets, values)
    faces, _ = boundary_faces(tets, points)
    inside = values[faces] < 0
    corners = [np.stack([around.nodes[around.triangles, n] for n in range(2)], axis=2)]
    for count in (1, 2, 3):
        chosen = faces[inside.sum(axis=1) == count]
        # The first inside node after one that is not begins the polygon.
        first = np.argmax(inside & ~np.roll(inside, 1, axis=1), axis=1)[inside.sum(axis=1) == count]
        a, b, c = np.take_along_axis(chosen, (first[:, None] + np.arange(3)) % 3, axis=1).T
        ends = {1: [(a, a), (a, b), (a, c)], 2: [(a, a), (b, b), (b, c), (a, c)], 3: [(a, a), (b, b), (c, c)]}[count]
        polygon = np.stack([np.stack(pair, axis=1) for pair in ends], axis=1)
        corners += [polygon[:, [0, k, k + 1]] for k in range(1, len(ends) - 1)]
    is_cut = np.arange(sum(map(len, corners))) >= len(corners[0])
    return _merged_surface(points, np.concatenate(corners), values, is_cut)


def _merged_surface(points: Array, corners: Array, values: Array, is_cut: Array | None = None) -> SurfaceMesh:
    """Triangles with corners on edges [F, 3, 2], inner end first, as a surface with shared vertices."""
    ends = corners.reshape(-1, 2).astype(np.int64)
    at_node = values[ends[:, 1]] == 0
    ends[at_node, 0] = ends[at_node, 1]
    keys, place = np.unique(ends[:, 0] << 32 | ends[:, 1], return_inverse=True)
    a, b = keys >> 32, keys & 0xFFFFFFFF
    inner, outer = values[a].astype(np.float64), values[b].astype(np.float64)
    t = np.divide(inner, inner - outer, out=np.zeros(len(keys)), where=a != b)
    triangles = place.reshape(-1, 3)
    kept = _not_flat(triangles, a == b)
    triangles, is_cut = triangles[kept], None if is_cut is None else is_cut[kept]
    used, triangles = np.unique(triangles, return_inverse=True)
    a, b, t = a[used], b[used], t[used]
    x = points[a] + t[:, None] * (points[b] - points[a])
    nodes = np.stack([a, b, a, a], axis=1).astype(np.int32)
    weights = np.stack([1 - t, t, 0 * t, 0 * t], axis=1)
    return SurfaceMesh(x, nodes, weights, triangles.reshape(-1, 3).astype(np.int32), is_cut=is_cut)


def _not_flat(triangles: Array, at_node: Array) -> Array:
    """Numbers of the triangles but those that lost a side, and pairs that lie back to back on one another."""
    a, b, c = triangles.T
    kept = np.flatnonzero((a != b) & (b != c) & (c != a))
    whole = np.flatnonzero(at_node[triangles[kept]].all(axis=1))
    if not len(whole):
        return kept
    same = np.sort(triangles[kept[whole]], axis=1)
    _, which, count = np.unique(same, axis=0, return_inverse=True, return_counts=True)
    return np.delete(kept, whole[count[which.ravel()] == 2])


def crossing_polygons(points: Array, tets: Array, values: Array) -> tuple[Array, Array, Array]:
    """The polygons in which a surface crosses elements; `plain_triangles` makes triangles of them.

    Args:
        points, tets, values: As for `marched`.

    Returns:
        The two ends of each vertex's edge, the inner one first, or the same node twice [V, 2]; vertices of the polygons
        in order, the last one twice for triangles [P, 4]; the element of each polygon [P].
    """
    code = codes(values[tets] < 0)
    cut = np.flatnonzero((code > 0) & (code < 15))
    code, mirrored = code[cut], signed_volumes(points, tets[cut]) < 0
    corners, cells = [], []
    for kind in range(1, 15):
        chosen = np.flatnonzero(code == kind)
        count = len(POLYGONS[kind])
        ends = tets[cut[chosen]][:, np.array(POLYGONS[kind])[[0, 1, 2, count - 1]]]
        turned = mirrored[chosen]
        ends[turned] = ends[turned][:, [0, 3, 2, 1] if count == 4 else [0, 2, 1, 1]]
        corners.append(ends)
        cells.append(cut[chosen])
    pairs = np.concatenate(corners).reshape(-1, 2).astype(np.int64)
    at_node = values[pairs[:, 1]] == 0
    pairs[at_node, 0] = pairs[at_node, 1]
    keys, place = np.unique(pairs[:, 0] << 32 | pairs[:, 1], return_inverse=True)
    return np.stack([keys >> 32, keys & 0xFFFFFFFF], axis=1), place.reshape(-1, 4), np.concatenate(cells)


def plain_triangles(polygons: Array, ends: Array) -> Array:
    """Two triangles for each polygon [P, 4], without those that have no area [F, 3]."""
    triangles = np.concatenate([polygons[:, [0, 1, 2]], polygons[:, [0, 2, 3]]])
    return triangles[_not_flat(triangles, ends[:, 0] == ends[:, 1])]


def separated(points: Array, tets: Array, values: Array, labels: Array) -> SurfaceMesh:
    """The surfaces between labels, and between labels and the outside.

    Args:
        points: Positions of the nodes [m], float64 [n, 3].
        tets: Nodes of the elements, int32 [T, 4].
        values: Signed function at the nodes, negative inside [n].
        labels: Labels of the nodes, int32 [n]; labels of nodes outside do not matter.

    Returns:
        The surface with ``sides``, the higher label first: a triangle is seen counter-clockwise from the side of the
        lower one, which is 0 outside. Its points are bound to up to four nodes.
    """
    labels = np.where(values < 0, labels, -1)
    own = labels[tets]
    mixed = np.flatnonzero((own != own[:, :1]).any(axis=1))
    tets, own = tets[mixed], own[mixed]
    mirrored = signed_volumes(points, tets) < 0
    different = (np.diff(np.sort(own, axis=1), axis=1) > 0).sum(axis=1) + 1
    pieces = _Pieces(values)
    for count, add in ((2, _add_pairs), (3, _add_triples), (4, _add_quadruples)):
        chosen = np.flatnonzero(different == count)
        if len(chosen):
            add(pieces, tets[chosen], own[chosen], mirrored[chosen])
    return pieces.surface(points)


def _add_pairs(pieces: _Pieces, tets: Array, own: Array, mirrored: Array) -> None:
    """Elements with two labels: marching tetrahedra around the higher one."""
    high, low = own.max(axis=1), own.min(axis=1)
    code = codes(own == high[:, None])
    for kind in range(1, 15):
        chosen = np.flatnonzero(code == kind)
        pieces.add(tets[chosen], POLYGONS[kind], high[chosen], low[chosen], mirrored[chosen])


def _add_triples(pieces: _Pieces, tets: Array, own: Array, mirrored: Array) -> None:
    """Elements with three labels, one of them at two nodes a and a2: two quads and a triangle along the line from the
    point in the face a-b-c to that in a2-b-c."""
    for a, a2 in EDGES:
        b, c = (n for n in range(4) if n not in (a, a2))
        chosen = np.flatnonzero(own[:, a] == own[:, a2])
        nodes, labels = tets[chosen], own[chosen]
        turned = mirrored[chosen] ^ _odd((a, a2, b, c))
        one, two = (a, b, c), (a2, b, c)
        for face, behind, front in (
            ([(a, b), (a2, b), two, one], b, a),
            ([(a, c), (a2, c), two, one], a, c),
            ([(b, c), one, two], b, c),
        ):
            pieces.add(nodes, face, labels[:, behind], labels[:, front], turned)


def _add_quadruples(pieces: _Pieces, tets: Array, own: Array, mirrored: Array) -> None:
    """Elements with four labels: a quad across each edge, through the points in its two faces and the centre."""
    for i, j in EDGES:
        k, m = (n for n in range(4) if n not in (i, j))
        face = [(i, j), (i, j, k), (i, j, k, m), (i, j, m)]
        pieces.add(tets, face, own[:, i], own[:, j], mirrored ^ _odd((i, j, k, m)))


def _odd(order: tuple[int, ...]) -> bool:
    return bool(sum(a > b for a, b in itertools.combinations(order, 2)) % 2)


class _Pieces:
    """Triangles whose corners are given by the nodes between which they lie: two, three or four."""

    def __init__(self, values: Array):
        self.values = values.astype(np.float64)
        self.corners: list[Array] = []
        self.sides: list[Array] = []

    def add(self, tets: Array, face: Sequence[tuple[int, ...]], behind: Array, front: Array, turned: Array) -> None:
        """Add a polygon in each element; it faces from the label behind to the one in front unless it is reversed."""
        turned = turned ^ (behind < front)
        sides = np.stack([np.maximum(behind, front), np.minimum(behind, front)], axis=1)
        for n in range(1, len(face) - 1):
            corners = np.full((len(tets), 3, 4), -1, np.int64)
            for place, between in enumerate((face[0], face[n], face[n + 1])):
                corners[:, place, : len(between)] = np.sort(tets[:, list(between)], axis=1)
            corners[turned] = corners[turned][:, ::-1]
            self.corners.append(corners)
            self.sides.append(sides)

    def surface(self, points: Array) -> SurfaceMesh:
        corners = np.concatenate(self.corners).reshape(-1, 4)
        self._move_to_nodes(corners)
        keys, place = np.unique(corners, axis=0, return_inverse=True)
        triangles = place.reshape(-1, 3)
        a, b, c = triangles.T
        whole = (a != b) & (b != c) & (c != a)
        triangles, sides = triangles[whole], np.maximum(np.concatenate(self.sides)[whole], 0)
        used, triangles = np.unique(triangles, return_inverse=True)
        keys = keys[used]
        weights = self._weights(keys)
        nodes = np.where(keys < 0, keys[:, :1], keys)
        x = points[nodes[:, 0]] + np.einsum("vn,vnc->vc", weights, points[nodes] - points[nodes[:, :1]])
        triangles = triangles.reshape(-1, 3).astype(np.int32)
        return SurfaceMesh(x, nodes.astype(np.int32), weights, triangles, sides.astype(np.int32))

    def _move_to_nodes(self, corners: Array) -> None:
        """Move points on edges that end at a node at exactly zero to that node."""
        on_edge = np.flatnonzero(corners[:, 2] < 0)
        for end in range(2):
            node, other = corners[on_edge, end], corners[on_edge, 1 - end]
            at = (self.values[node] == 0) & (self.values[other] < 0)
            corners[on_edge[at], 0] = node[at]
            corners[on_edge[at], 1] = -1
            on_edge = on_edge[~at]

    def _weights(self, keys: Array) -> Array:
        """Weights: each point is the mean of the points on the edges between its nodes."""
        weights = np.zeros(keys.shape)
        pairs = np.zeros(len(keys))
        for i, j in EDGES:
            there = np.flatnonzero((keys[:, i] >= 0) & (keys[:, j] >= 0))
            a, b = self.values[keys[there, i]], self.values[keys[there, j]]
            crossed = (a < 0) != (b < 0)
            t = np.divide(a, a - b, out=np.full(len(there), 0.5), where=crossed)
            weights[there, i] += 1 - t
            weights[there, j] += t
            pairs[there] += 1
        weights[pairs == 0, 0] = 1.0
        return weights / np.maximum(pairs, 1)[:, None]


#: Normals that differ by more than this make a crease [°].
ANGLE = 30.0
#: A polygon whose centre is closer to the surface than this fraction of its size has no crease.
NEAR = 5.0e-3
#: Crossings of edges are found in this many steps, or until their error is below this fraction of the edge; normals
#: come from differences over this fraction of a polygon's size.
STEPS, OFF, APART = 6, 5.0e-5, 0.02
#: Tangent planes determine a vertex only in directions in which they differ: singular values below this fraction of the
#: largest one count as zero.
RANK = 0.15
#: How far outside its element a vertex may be, as a barycentric coordinate, and how much nearer to the surface than the
#: polygon's middle it must be.
OUTSIDE, NEARER = -0.2, 0.5
#: Places along a crease at which a vertex is tried, in polygon sizes from the polygon's middle; the middle comes first.
SLIDES = np.array(sorted(np.linspace(-1.5, 1.5, 31), key=abs))


def sharpened(points: Array, tets: Array, values: Array, domain: Domain) -> tuple[Array, Array]:
    """The surface of a body in tetrahedra that hold all of it: points [m], float64 [V, 3], and triangles int32 [F, 3].

    Args:
        points: Positions of the nodes [m], float64 [n, 3].
        tets: Nodes of the elements, int32 [T, 4].
        values: Signed function at the nodes, negative inside [n].
        domain: The body.
    """
    ends, polygons, cells = crossing_polygons(points, tets, values)
    x, normals = _crossings(points, ends, values, domain)
    whole = (ends[:, 0] != ends[:, 1])[polygons].all(axis=1)
    chosen, apexes = _apexes(x, normals, polygons, whole, points[tets[cells]], domain)
    triangles = plain_triangles(np.delete(polygons, chosen, axis=0), ends)
    numbers = len(x) + np.arange(len(chosen))
    x = np.concatenate([x, apexes])
    triangles = np.concatenate([triangles, _fans(x, polygons[chosen], numbers, domain)])
    used, corners = np.unique(triangles, return_inverse=True)
    return x[used], corners.reshape(-1, 3).astype(np.int32)


def _crossings(points: Array, ends: Array, values: Array, domain: Domain) -> tuple[Array, Array]:
    """The points where the surface crosses edges from a node inside to one outside [V, 3], and its unit normals there,
    NaN where they are not known.

    They come from the body's triangles if it has any, otherwise from false position (Illinois).
    """
    a, along = points[ends[:, 0]], points[ends[:, 1]] - points[ends[:, 0]]
    share, normals = np.zeros(len(ends)), np.full((len(ends), 3), np.nan)
    going = np.flatnonzero(ends[:, 0] != ends[:, 1])
    found = domain.exits(a[going], points[ends[going, 1]])
    if found is not None:
        known = np.isfinite(found[0])
        share[going[known]], normals[going[known]] = found[0][known], found[1][known]
        going = going[~known]
    low, high = np.zeros(len(ends)), np.ones(len(ends))
    below, above = values[ends[:, 0]].astype(np.float64), values[ends[:, 1]].astype(np.float64)
    close = OFF * np.linalg.norm(along, axis=1)
    for _ in range(STEPS):
        b, c = below[going], above[going]
        share[going] = low[going] + (high[going] - low[going]) * b / np.minimum(b - c, -1e-300)
        off = domain.sampled(a[going] + share[going, None] * along[going])
        inside = off < 0.0
        inner, outer = going[inside], going[~inside]
        low[inner], below[inner] = share[inner], off[inside]
        above[inner] *= 0.5
        high[outer], above[outer] = share[outer], off[~inside]
        below[outer] *= 0.5
        going = going[np.abs(off) > close[going]]
    return a + share[:, None] * along, normals


def _apexes(
    x: Array, known: Array, polygons: Array, whole: Array, corners: Array, domain: Domain
) -> tuple[Array, Array]:
    """Polygons that contain a crease, indices [m], and the points where the tangent planes at their vertices meet [m,
    3].

    Args:
        x: Vertices [V, 3].
        known: Normals at the vertices, NaN if unknown [V, 3].
        polygons: Their vertices [P, 4].
        whole: Which polygons have all of their vertices on edges [P].
        corners: Corners of their elements [P, 4, 3].
        domain: The body.
    """
    # Polygons without known normals may contain a crease.
    bent = np.flatnonzero(whole & ~(_least_cosine(known[polygons]) >= np.cos(np.radians(ANGLE))))
    at = x[polygons[bent]]
    middle = at.mean(axis=1)
    size = np.linalg.norm(at - middle[:, None], axis=2).max(axis=1)
    off = np.abs(domain.sampled(middle))
    away = off > NEAR * size
    chosen, at, middle, size, off = bent[away], at[away], middle[away], size[away], off[away]
    if not len(chosen):
        return chosen, np.empty((0, 3))
    normals = _normals(x, known, polygons[chosen], size, domain)
    bends = _least_cosine(normals) < np.cos(np.radians(ANGLE))
    chosen, normals = chosen[bends], normals[bends]
    at, middle, size, off = at[bends], middle[bends], size[bends], off[bends]
    heights = np.einsum("pic,pic->pi", normals, at - middle[:, None])
    u, s, v = np.linalg.svd(normals, full_matrices=False)
    inverse = np.where(s > RANK * s[:, :1], 1.0 / np.maximum(s, 1e-300), 0.0)
    apexes = middle + np.einsum("pkc,pk,pik,pi->pc", v, inverse, u, heights)
    straight = s[:, 2] <= RANK * s[:, 0]
    apexes, inside = _slid(apexes, np.where(straight, size, 0.0)[:, None] * v[:, 2], corners[chosen])
    good = (inside > OUTSIDE) & (np.abs(domain.sampled(apexes)) < NEARER * off)
    return chosen[good], apexes[good]


def _least_cosine(normals: Array) -> Array:
    """The least cosine of the angles between the normals of each polygon [P, 4, 3]; NaN if one is not known."""
    return np.min([np.einsum("pc,pc->p", normals[:, i], normals[:, j]) for i in range(4) for j in range(i)], axis=0)


def _normals(x: Array, known: Array, polygons: Array, size: Array, domain: Domain) -> Array:
    """The surface's unit normals at the vertices of polygons [P, 4, 3]; unknown ones come from differences over a
    fraction of the size of the largest polygon at each vertex."""
    used, vertices = np.unique(polygons, return_inverse=True)
    apart = np.zeros(len(used))
    np.maximum.at(apart, vertices.ravel(), np.repeat(APART * size, polygons.shape[1]))
    normals = known[used]
    sought = np.flatnonzero(np.isnan(normals[:, 0]))
    normals[sought] = domain.normals(x[used[sought]], apart[sought])
    return normals[vertices.reshape(polygons.shape)]


def _slid(points: Array, along: Array, corners: Array) -> tuple[Array, Array]:
    """Points moved along lines to where they are farthest inside their elements, and the least of their barycentric
    coordinates there."""
    edges = np.swapaxes(corners[:, 1:] - corners[:, :1], 1, 2)
    sides = np.stack([points - corners[:, 0], along], axis=2)
    later = np.linalg.solve(edges, sides)
    start, rise = (np.column_stack([k - later[:, :, n].sum(axis=1), later[:, :, n]]) for n, k in ((0, 1.0), (1, 0.0)))
    inside = (start[:, None] + SLIDES[:, None] * rise[:, None]).min(axis=2)
    best = np.argmax(inside, axis=1)
    return points + SLIDES[best, None] * along, inside[np.arange(len(best)), best]


def _fans(x: Array, polygons: Array, apexes: Array, domain: Domain) -> Array:
    """Triangles from apexes to the edges of their polygons; an edge between two apexes is flipped if it is then closer
    to the surface.
    """
    after = np.roll(polygons, -1, axis=1)
    fans = np.stack([np.repeat(apexes, polygons.shape[1]), polygons.ravel(), after.ravel()], axis=1)
    fans = fans[fans[:, 1] != fans[:, 2]]
    if not len(fans):
        return fans
    low, high = fans[:, 1:].min(axis=1), fans[:, 1:].max(axis=1)
    order = np.lexsort((high, low))
    same = (low[order[1:]] == low[order[:-1]]) & (high[order[1:]] == high[order[:-1]])
    one, other = order[:-1][same], order[1:][same]
    now = np.abs(domain.sampled(x[fans[one, 1:]].mean(axis=1)))
    then = np.abs(domain.sampled(0.5 * (x[fans[one, 0]] + x[fans[other, 0]])))
    one, other = one[then < now], other[then < now]
    apex, apex_other, start, end = fans[one, 0], fans[other, 0], fans[one, 1], fans[one, 2]
    fans[one] = np.stack([apex, start, apex_other], axis=1)
    fans[other] = np.stack([apex_other, end, apex], axis=1)
    return fans


@dataclass(frozen=True, eq=False)
class Detail:
    """Conforming tetrahedra that contain all of a body's surface, each inside one element of the mesh or outside the
    mesh.

    Attributes:
        points: float64 [n, 3] [m].
        tets: int32 [k, 4].
        phi: The body's signed function at the points [m], float32 [n].
        labels: Labels of the points, for points outside that of the nearest part, int32 [n]; None: no labels.
        sharp_points, sharp_triangles: The body's surface with its edges, float64 [V, 3] [m] and int32 [F, 3]; None: the
            marched one is drawn.
    """

    points: np.ndarray
    tets: np.ndarray
    phi: np.ndarray
    labels: np.ndarray | None = None
    sharp_points: np.ndarray | None = None
    sharp_triangles: np.ndarray | None = None

    @classmethod
    def of(cls, points: np.ndarray, tets: np.ndarray, phi: np.ndarray, labels: np.ndarray | None) -> Detail:
        """Of tetrahedra of a larger mesh, with the points that they need."""
        used, corners = np.unique(tets, return_inverse=True)
        named = None if labels is None else labels[used]
        return cls(points[used], corners.reshape(-1, 4).astype(np.int32), phi[used], named)

    def surface(self) -> SurfaceMesh:
        """The body's surface: with its edges if these are known, bound to nothing yet; else bound to these points."""
        if self.sharp_points is None or self.sharp_triangles is None:
            return marched(self.points, self._across(self.phi < 0), self.phi)
        unbound = np.zeros((len(self.sharp_points), 4))
        return SurfaceMesh(self.sharp_points, unbound.astype(np.int32), unbound, self.sharp_triangles)

    def separating_surface(self) -> SurfaceMesh:
        """The surfaces between labels and around them, bound to these points."""
        assert self.labels is not None
        return separated(self.points, self.tets, self.phi, self.labels)

    def sharpened(self, domain: Domain) -> Detail:
        """With the edges of the body."""
        points, triangles = sharpened(self.points, self._across(self.phi < 0), self.phi, domain)
        return replace(self, sharp_points=points, sharp_triangles=triangles)

    def _across(self, inside: np.ndarray) -> np.ndarray:
        own = inside[self.tets]
        return self.tets[own.any(axis=1) & ~own.all(axis=1)]
