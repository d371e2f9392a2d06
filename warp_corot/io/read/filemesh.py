"""The content of a file: points, blocks of cells, and numbers that distinguish regions; or voxels."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

#: Numbers of corners of cells with volume, by kind.
SOLIDS = {"tetra": 4, "pyramid": 5, "wedge": 6, "hexahedron": 8}
#: Numbers of corners of cells of surfaces, by kind.
FACES = {"triangle": 3, "quad": 4}
CORNERS = {**SOLIDS, **FACES}
#: Arrays with more distinct numbers than this do not define node sets.
MOST_SETS = 32


class Unreadable(Exception):
    """A reader's reason for not reading a file."""


@dataclass(frozen=True)
class Block:
    """Cells of one kind.

    Attributes:
        kind: A key of `SOLIDS` or `FACES`.
        nodes: Their corners in VTK's order, int64 [n, corners].
        data: Numbers of cells by array name, int64 [n].
    """

    kind: str
    nodes: NDArray[np.int64]
    data: dict[str, NDArray[np.int64]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        corners = CORNERS.get(self.kind)
        if corners is not None and self.nodes.shape[1:] != (corners,):
            raise Unreadable(f"its cells of the kind {self.kind} have the shape {list(self.nodes.shape)}")


@dataclass(frozen=True)
class FileMesh:
    """The parts of a file from which bodies and surfaces are made.

    Attributes:
        points: Points in the file's unit, float64 [N, 3].
        blocks: Cells with volume and cells of surfaces; cells of higher order only with their corners.
        names: Meanings of the numbers in an array, by array and number.
        ignored: Number of the file's cells of other kinds (lines, vertices), by kind.
        notes: Notes for the user, one line each.
        node_sets: Named sets of nodes in the file, indices int64 [n].
        metres: Metres in the file's unit; None if the file does not say.
        up_axis: "X", "Y" or "Z"; None if the file does not say.
        objects: Names of parts that share no nodes, and the number of tetrahedra or triangles of each, in order, if the
            arrays of the blocks do not number them.
    """

    points: NDArray[np.float64]
    blocks: list[Block]
    names: dict[str, dict[int, str]] = field(default_factory=dict)
    ignored: dict[str, int] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    node_sets: dict[str, NDArray[np.int64]] = field(default_factory=dict)
    metres: float | None = None
    up_axis: str | None = None
    objects: list[tuple[str, int]] = field(default_factory=list)

    def __post_init__(self) -> None:
        if self.points.ndim != 2 or self.points.shape[1] != 3:
            raise Unreadable(f"its points have the shape {list(self.points.shape)}; it must be [N, 3]")

    @property
    def solids(self) -> list[Block]:
        """The blocks of cells with volume."""
        return [block for block in self.blocks if block.kind in SOLIDS and len(block.nodes)]

    @property
    def faces(self) -> list[Block]:
        """The blocks of triangles and quadrilaterals."""
        return [block for block in self.blocks if block.kind in FACES and len(block.nodes)]

    def kinds(self) -> str:
        """The kinds of cells, for messages."""
        found = {block.kind for block in self.blocks if len(block.nodes)} | {k for k, n in self.ignored.items() if n}
        return ", ".join(sorted(found)) or "none"


@dataclass(frozen=True)
class FileImage:
    """The voxels of a file, see `warp_corot.io.read.volumes.LoadedVolume`.

    Attributes:
        values: [nx, ny, nz].
        affine: From voxel indices to positions, float64 [4, 4].
        notes: Notes for the user, one line each.
        unit: "m", "cm", "mm", or None if the file does not say.
    """

    values: NDArray[Any]
    affine: NDArray[np.float64]
    notes: list[str]
    unit: str | None = None


def joined_triangles(parts: Iterable[tuple[str, NDArray[Any], NDArray[Any]]], **about: Any) -> FileMesh:
    """Surfaces, each with a name, points [N, 3] and triangles [T, 3], as one file's; ``about`` are more attributes."""
    points, blocks, objects, offset = [np.empty((0, 3))], [], [], 0
    for name, own, triangles in parts:
        points.append(np.asarray(own, np.float64).reshape(-1, 3))
        blocks.append(Block("triangle", np.asarray(triangles, np.int64).reshape(-1, 3) + offset))
        objects.append((name, len(triangles)))
        offset += len(own)
    return FileMesh(np.concatenate(points), blocks, objects=objects, **about)


def sets_of_numbers(name: str, values: NDArray[np.int64]) -> dict[str, NDArray[np.int64]]:
    """The node sets that an array of whole numbers, one a node, defines.

    An array of zeros and ones is one set with the array's name. An array with a few distinct numbers is one set for
    each number but zero, ``NAME_NUMBER``. An array of many numbers, for instance one that counts nodes, defines no set.

    Args:
        name: The array's name.
        values: Its numbers.
    """
    numbers = np.unique(values[values != 0])
    if len(numbers) > MOST_SETS:
        return {}
    if numbers.tolist() == [1]:
        return {name: np.flatnonzero(values)}
    return {f"{name}_{number}": np.flatnonzero(values == number) for number in numbers.tolist()}


def corners_note(kind: str, order: int | None = 2) -> str:
    """The note about cells of higher order, of which only the corners are used."""
    word = {2: "second-order", 3: "third-order"}.get(order or 0, "higher-order")
    return f"{word} cells ({kind}) are taken by their corners, with straight edges"


def whole_numbers(values: Any) -> NDArray[np.int64] | None:
    """Values as int64 [n]; None unless they are whole numbers, one a cell."""
    array = np.asarray(values)
    if array.ndim == 2 and array.shape[1] == 1:
        array = array[:, 0]
    if array.ndim != 1:
        return None
    if array.dtype.kind in "iub":
        return array.astype(np.int64)
    if array.dtype.kind == "f" and (np.abs(array) < 2**53).all() and (array == np.round(array)).all():
        return array.astype(np.int64)
    return None


# --- hexahedra, wedges and pyramids split into tetrahedra that fit their neighbours ----------------------------------

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
