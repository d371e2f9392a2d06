"""Formats of meshio: Gmsh, Abaqus, TetGen, NetGen, Medit, Nastran, XDMF, Exodus, MED, and VTK without its library."""

from __future__ import annotations

import io
import itertools
import re
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .filemesh import CORNERS, Block, FileMesh, Unreadable, corners_note, sets_of_numbers, whole_numbers

#: Names of arrays in the other readers.
RENAMED = {"gmsh:physical": "physical group", "gmsh:geometrical": "entity", "netgen:index": "material"}
RENAMED |= {"medit:ref": "entity", "tetgen:ref": "attribute"}
#: Name of the array with the numbers of sets of cells.
SETS = "element set"
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
    from meshio.abaqus._abaqus import read_buffer

    if path.suffix.lower() in (".node", ".ele"):
        for other in (path.with_suffix(".node"), path.with_suffix(".ele")):
            if not other.is_file():
                raise Unreadable(f"{other.name} is missing; the two files must be in one folder")
    reasons = []
    for kind in _filetypes_from_path(path):
        try:
            if kind == "abaqus":
                return _mesh(read_buffer(io.StringIO(_flat_abaqus(path))))
            given = _EndingText(path.read_text()) if kind == "nastran" else str(path)
            return _mesh(reader_map[kind](given))
        except meshio.ReadError as error:
            reasons.append(str(error) or f"it is not a {kind} file")
    raise Unreadable("; ".join(dict.fromkeys(reasons)))


def _mesh(mesh: Any) -> FileMesh:
    blocks: list[Block] = []
    ignored: dict[str, int] = {}
    notes: list[str] = []
    names, of_cells = _cell_sets(mesh)
    for place, block in enumerate(mesh.cells):
        kind = block.type.rstrip("0123456789")
        if kind not in CORNERS:
            ignored[block.type] = ignored.get(block.type, 0) + len(block.data)
            continue
        if block.type != kind:
            notes.append(corners_note(kind, ORDERS.get(block.type, 2)))
        nodes = np.asarray(block.data, np.int64)
        data = {SETS: of_cells[place]} if names else {}
        for name, values in mesh.cell_data.items():
            numbers = whole_numbers(values[place])
            if numbers is not None and len(numbers) == len(nodes):
                data[RENAMED.get(name, name)] = numbers
        blocks.append(Block(kind, nodes[:, : CORNERS[kind]], data))
    # Names of physical groups, or of NetGen's materials, of dimension 3.
    numbered = [(str(name), np.asarray(value).ravel().tolist()) for name, value in mesh.field_data.items()]
    groups = {int(numbers[0]): name for name, numbers in numbered if len(numbers) == 2 and numbers[1] == 3}
    array = "material" if "netgen:index" in mesh.cell_data else "physical group"
    named = ({array: groups} if groups else {}) | ({SETS: names} if names else {})
    points = np.asarray(mesh.points, np.float64)
    return FileMesh(points, blocks, named, ignored, list(dict.fromkeys(notes)), _node_sets(mesh))


def _cell_sets(mesh: Any) -> tuple[dict[int, str], list[NDArray[np.int64]]]:
    """Names of sets of cells by number, and the number of each cell's smallest set, by block."""
    sets: dict[str, list[tuple[int, NDArray[np.int64]]]] = {}
    for name, parts in _own_sets(mesh):
        sets.setdefault(name, []).extend(enumerate(parts))
    numbers = [np.zeros(len(block.data), np.int64) for block in mesh.cells]
    numbered = list(enumerate(sets.items(), start=1))
    for number, (_, own) in sorted(numbered, key=lambda each: -sum(len(part) for _, part in each[1][1])):
        for place, part in own:
            numbers[place][part.astype(np.int64)] = number
    return {number: name for number, (name, _) in numbered}, numbers


def _own_sets(mesh: Any) -> list[tuple[str, list[NDArray[Any]]]]:
    """The named sets of cells, with the numbers of their cells in each block; those of Gmsh repeat other data."""
    if any(name.startswith("gmsh:") for name in mesh.cell_data):
        return []
    named = ((name.partition(AGAIN)[0], parts) for name, parts in mesh.cell_sets.items())
    return [
        (name, parts)
        for name, parts in named
        if name and len(parts) == len(mesh.cells) and all(isinstance(part, np.ndarray) for part in parts)
    ]


def _node_sets(mesh: Any) -> dict[str, NDArray[np.int64]]:
    """Sets of points, point data with few distinct whole numbers, and the points of sets of cells and of groups of
    dimension below 3."""
    found: dict[str, NDArray[np.int64]] = {}
    for name, values in mesh.point_data.items():
        numbers = whole_numbers(values)
        if numbers is not None:
            found |= sets_of_numbers(name, numbers)
    chosen: list[tuple[str, list[Any]]] = []
    groups = mesh.cell_data.get("gmsh:physical", [])
    for name, value in mesh.field_data.items():
        number, dimension = [*np.asarray(value).ravel().tolist(), -1, -1][:2]
        pairs = zip(mesh.cells, groups, strict=False)
        chosen.append((name, [np.asarray(own) == number if b.dim == dimension < 3 else [] for b, own in pairs]))
    for name, parts in [*chosen, *_own_sets(mesh)]:
        of_set = [
            np.asarray(block.data)[part].ravel()
            for block, part in zip(mesh.cells, parts, strict=False)
            if isinstance(part, np.ndarray) and part.size
        ]
        if sum(map(len, of_set)):
            nodes = np.unique(np.concatenate([*of_set, found.get(str(name), [])])).astype(np.int64)
            found[str(name)] = nodes
    return found | {str(name): np.asarray(nodes, np.int64) for name, nodes in mesh.point_sets.items()}


# --- Abaqus: what meshio's reader does not know -----------------------------------------------------------------------

#: Element types by family and number of nodes, in place of their variants.
SHELLS = {"3": "S3", "4": "S4", "6": "STRI65", "8": "S8R"}
TYPE = re.compile(r"(?i)\btype\s*=\s*(?:(C3D|SC)|STRI|SFM3D|R3D|M3D|F3D|DS|CPS|CPE|S)(\d)(\d?)\w*")
ELSET = re.compile(r"(?i)\belset\s*=\s*([^,\n]*)")
#: What separates the name of a set that several groups of elements are listed in from a number.
AGAIN = "\x00"


def _flat_abaqus(path: Path) -> str:
    """An input file in one text, with its included files, one list of nodes, and element types that meshio knows.

    Raises:
        Unreadable: It has several parts or instances, whose numbers repeat.
    """
    text = re.sub(r"(?m)^\*\*.*\n?", "", _with_included(path))
    text = re.sub(r"(?m)^(\*.*),[ \t]*\n", r"\1, ", text)
    _, *cards = re.split(r"(?m)^(?=\*)", text)
    words = [card[1:].partition("\n")[0].partition(",")[0].strip().upper() for card in cards]
    if words.count("INSTANCE") > 1 or words.count("PART") > 1:
        raise Unreadable("it has several parts or instances; write it without parts and assemblies")
    nodes = "".join(card.partition("\n")[2] for card, word in zip(cards, words, strict=True) if word == "NODE")
    found, number = [f"*NODE\n{nodes}"] if nodes else [], itertools.count()
    for card, word in zip(cards, words, strict=True):
        head, _, data = card.partition("\n")
        if word == "ELEMENT":
            head = TYPE.sub(lambda m: f"TYPE={f'C3D{m[2]}{m[3]}' if m[1] else SHELLS.get(m[2], m[0])}", head)
            name = ELSET.search(head)
            head = f"{ELSET.sub('', head)}, ELSET={name[1].strip() if name else ''}{AGAIN}{next(number)}"
        if word in ("ELEMENT", "ELSET", "NSET"):
            found.append(f"{head}\n{data}")
    return "\n".join(found)


def _with_included(path: Path) -> str:
    text = path.read_text("utf-8", "replace")
    include = re.compile(r"(?im)^\*include\s*,\s*input\s*=\s*(\S.*?)\s*$")
    return include.sub(lambda found: _with_included(path.parent / found[1].strip('"')), text)
