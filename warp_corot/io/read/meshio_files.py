"""Formats of meshio: NetGen .vol, XDMF, Exodus, MED, and those of VTK and Gmsh if these are not installed."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .filemesh import CORNERS, Block, FileMesh, Unreadable, corners_note, sets_of_numbers, whole_numbers

#: Names of arrays in the other readers.
RENAMED = {"gmsh:physical": "physical group", "gmsh:geometrical": "entity", "netgen:index": "material"}
RENAMED |= {"medit:ref": "entity"}

#: Orders of cells by meshio's names, if not two.
ORDERS = {"tetra20": 3, "tetra35": 4, "hexahedron64": 3, "triangle10": 3, "quad16": 3}


class _EndingText(io.StringIO):
    """A text that fails at its second end: meshio's reader of Nastran waits for ever for a first card."""

    ended = False

    def readline(self, size: int = -1, /) -> str:  # type: ignore[override]
        line = super().readline(size)
        if not line and self.ended:
            raise Unreadable("it ends before its first card")
        self.ended = not line
        return line


def read(path: Path) -> FileMesh:
    """All cells of a file, with the arrays of whole numbers and the sets of its cells.

    Raises:
        Unreadable: With meshio's own message.
    """
    import meshio
    from meshio._helpers import _filetypes_from_path, reader_map

    reasons = []
    for kind in _filetypes_from_path(path):
        try:
            given = _EndingText(path.read_text()) if kind == "nastran" else str(path)
            return _mesh(reader_map[kind](given))
        except meshio.ReadError as error:
            reasons.append(str(error) or f"it is not a {kind} file")
    raise Unreadable("; ".join(dict.fromkeys(reasons)))


def _mesh(mesh: Any) -> FileMesh:
    blocks: list[Block] = []
    ignored: dict[str, int] = {}
    notes: list[str] = []
    for place, block in enumerate(mesh.cells):
        kind = block.type.rstrip("0123456789")
        if kind not in CORNERS:
            ignored[block.type] = ignored.get(block.type, 0) + len(block.data)
            continue
        if block.type != kind:
            notes.append(corners_note(kind, ORDERS.get(block.type, 2)))
        nodes = np.asarray(block.data, np.int64)
        data = {}
        for name, values in mesh.cell_data.items():
            numbers = whole_numbers(values[place])
            if numbers is not None and len(numbers) == len(nodes):
                data[RENAMED.get(name, name)] = numbers
        blocks.append(Block(kind, nodes[:, : CORNERS[kind]], data))
    points = np.asarray(mesh.points, np.float64)
    return FileMesh(points, blocks, _names(mesh), ignored, list(dict.fromkeys(notes)), _node_sets(mesh))


def _node_sets(mesh: Any) -> dict[str, NDArray[np.int64]]:
    """Sets of points, point data with few distinct whole numbers, and the points of groups of dimension below 3."""
    found: dict[str, NDArray[np.int64]] = {}
    for name, values in mesh.point_data.items():
        numbers = whole_numbers(values)
        if numbers is not None:
            found |= sets_of_numbers(name, numbers)
    groups = mesh.cell_data.get("gmsh:physical", [])
    for name, value in mesh.field_data.items():
        number, dimension = [*np.asarray(value).ravel().tolist(), -1, -1][:2]
        of_group = [
            np.asarray(block.data)[np.asarray(numbers) == number].ravel()
            for block, numbers in zip(mesh.cells, groups, strict=False)
            if block.dim == dimension < 3
        ]
        if sum(map(len, of_group)):
            found[str(name)] = np.unique(np.concatenate(of_group)).astype(np.int64)
    return found | {str(name): np.asarray(nodes, np.int64) for name, nodes in mesh.point_sets.items()}


def _names(mesh: Any) -> dict[str, dict[int, str]]:
    """Names of physical groups, or of NetGen's materials, of dimension 3."""
    found = {}
    for name, value in mesh.field_data.items():
        numbers = np.asarray(value).ravel()
        if len(numbers) == 2 and numbers[1] == 3:
            found[int(numbers[0])] = str(name)
    array = "material" if "netgen:index" in mesh.cell_data else "physical group"
    return {array: found} if found else {}
