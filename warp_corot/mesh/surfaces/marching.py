"""Marching tetrahedra: the zero surface of the linear interpolant.

Each edge between a node inside and one outside has a vertex, so triangles on the same edge share a vertex. A node at
exactly zero counts as outside; all vertices around it are merged, and triangles that lose a side are removed.
"""

from __future__ import annotations

import itertools

import numpy as np

from warp_corot.mesh.growing.cut import codes

from .bound import SurfaceMesh
from .boundary import boundary_faces, signed_volumes

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
