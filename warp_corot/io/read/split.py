"""Hexahedra, wedges and pyramids split into tetrahedra, and quadrilaterals into triangles, that fit their neighbours.

Every quadrilateral is cut by the diagonal through its corner with the smallest number (Dompierre, Labbé, Vallet and
Camarero, *How to subdivide pyramids, prisms, and hexahedra into tetrahedra*, 1999), so that two cells cut their common
face alike independently. A cell becomes the cone from its own corner with the smallest number over the triangles
of the faces without that corner: two tetrahedra for a pyramid, three for a wedge, six for a hexahedron.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from .filemesh import Block

#: Faces of each kind of cell by its corners in VTK's order, counter-clockwise seen from outside.
OUTSIDES: dict[str, tuple[tuple[int, ...], ...]] = {
    "pyramid": ((0, 3, 2, 1), (0, 1, 4), (1, 2, 4), (2, 3, 4), (3, 0, 4)),
    "wedge": ((0, 2, 1), (3, 4, 5), (0, 1, 4, 3), (1, 2, 5, 4), (2, 0, 3, 5)),
    "hexahedron": ((0, 3, 2, 1), (4, 5, 6, 7), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7)),
}


def split_solids(
    blocks: Iterable[Block], points: NDArray[np.float64]
) -> tuple[NDArray[np.int64], NDArray[np.int64], int]:
    """The tetrahedra of cells with volume.

    Tetrahedra do not change. The tetrahedra of any other cell have the cell's orientation: positive if its volume is
    positive. Tetrahedra with a repeated corner, from cells with merged corners, are left out.

    Args:
        blocks: Cells with volume, whose corners are all in ``points``.
        points: [N, 3].

    Returns:
        Tetrahedra int64 [T, 4]; the cell that contains each, numbered block after block, int64 [T]; and the number of
        cells so warped that some of their tetrahedra lie outside them.
    """
    tets, cells, first, warped = [np.empty((0, 4), np.int64)], [np.empty(0, np.int64)], 0, 0
    for block in blocks:
        if block.kind == "tetra":
            made, whose = block.nodes, np.arange(len(block.nodes))
        else:
            made, whose = _cones(block)
            made, folded = _wound_alike(made, whose, len(block.nodes), points)
            warped += folded
            whole = (np.diff(np.sort(made, axis=1), axis=1) > 0).all(axis=1)
            made, whose = made[whole], whose[whole]
        tets.append(made)
        cells.append(whose + first)
        first += len(block.nodes)
    return np.concatenate(tets), np.concatenate(cells), warped


def triangles_of(blocks: Iterable[Block]) -> NDArray[np.int64]:
    """The triangles of surface cells, int64 [T, 3]."""
    found = [np.empty((0, 3), np.int64)]
    for block in blocks:
        found.append(block.nodes if block.kind == "triangle" else _halves(block.nodes).reshape(-1, 3))
    return np.concatenate(found)


def split_polyhedron(faces: Sequence[Sequence[int]]) -> list[tuple[int, int, int, int]]:
    """The tetrahedra of one convex cell of any kind, given by the corners of its faces, by the same rule."""
    apex = min(min(face) for face in faces)
    return [(a, b, c, apex) for face in faces if apex not in face for a, b, c in fan(face)]


def fan(polygon: Sequence[int]) -> list[tuple[int, int, int]]:
    """The triangles of a convex polygon around its corner with the smallest number."""
    start = min(range(len(polygon)), key=polygon.__getitem__)
    turned = [*polygon[start:], *polygon[:start]]
    return [(turned[0], b, c) for b, c in pairwise(turned[1:])]


def _cones(block: Block) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    nodes, outsides = block.nodes, OUTSIDES[block.kind]
    lowest = np.argmin(nodes, axis=1)
    tets, whose = [np.empty((0, 4), np.int64)], [np.empty(0, np.int64)]
    for corner in range(nodes.shape[1]):
        cells = np.flatnonzero(lowest == corner)
        if not len(cells):
            continue
        for face in outsides:
            if corner in face:
                continue
            corners = nodes[cells][:, face]
            triangles = corners[:, None] if len(face) == 3 else _halves(corners)
            apex = np.broadcast_to(nodes[cells, corner][:, None, None], (*triangles.shape[:2], 1))
            tets.append(np.concatenate([triangles, apex], axis=2).reshape(-1, 4))
            whose.append(np.repeat(cells, triangles.shape[1]))
    order = np.argsort(np.concatenate(whose), kind="stable")
    return np.concatenate(tets)[order], np.concatenate(whose)[order]


def _halves(quads: NDArray[np.int64]) -> NDArray[np.int64]:
    """Two triangles for each quadrilateral, with the same orientation, [n, 2, 3]."""
    start = np.argmin(quads, axis=1)
    turned = np.take_along_axis(quads, (start[:, None] + np.arange(4)) % 4, axis=1)
    return turned[:, [[0, 1, 2], [0, 2, 3]]]


def _wound_alike(
    tets: NDArray[np.int64], whose: NDArray[np.int64], count: int, points: NDArray[np.float64]
) -> tuple[NDArray[np.int64], int]:
    """The tetrahedra oriented so that their cells' volumes are positive, and the number of cells with both signs."""
    x = points[tets]
    volumes = np.linalg.det(x[:, 1:] - x[:, :1]) if len(tets) else np.empty(0)
    total = np.bincount(whose, volumes, count)
    size = np.bincount(whose, np.abs(volumes), count)
    turned = (total < 0.0)[whose]
    tets = tets.copy()
    tets[turned] = tets[turned][:, [0, 1, 3, 2]]
    return tets, int(np.count_nonzero(size - np.abs(total) > 1e-6 * size))
