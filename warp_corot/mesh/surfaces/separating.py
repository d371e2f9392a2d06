"""Surfaces between labels (Nielson and Franke 1997, *Computing the separating surface for segmented data*).

There is a vertex on each edge between two labels, in each face with three, and in each element with four. So the
surfaces of all labels fit together without gaps, and each label's surface is closed.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np

from warp_corot.kernels.tables.shapes import EDGES
from warp_corot.mesh.growing.cut import codes

from .bound import SurfaceMesh
from .boundary import signed_volumes
from .marching import POLYGONS

Array = np.ndarray


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
