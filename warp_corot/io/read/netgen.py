"""NetGen's own files, .vol and .vol.gz."""

from __future__ import annotations

import gzip
from collections.abc import Iterator
from itertools import islice
from pathlib import Path

import numpy as np

from .filemesh import CORNERS, Block, FileMesh, Unreadable, corners_note

#: Kinds and their corners by the number of nodes.
SOLIDS = {4: "tetra", 10: "tetra", 5: "pyramid", 13: "pyramid", 6: "wedge", 15: "wedge"}
SOLIDS |= {8: "hexahedron", 20: "hexahedron"}
SURFACES = {3: "triangle", 6: "triangle", 4: "quad", 8: "quad"}
MATERIAL = "material"


def read(path: Path) -> FileMesh:
    """Elements with the numbers and names of their materials.

    Raises:
        Unreadable: The file is truncated or its numbers are inconsistent.
    """
    with (
        gzip.open(path, "rt", errors="replace") if path.suffix.lower() == ".gz" else path.open(errors="replace") as file
    ):
        lines = (line for line in (line.partition("#")[0].strip() for line in file) if line)
        first = next(lines, "")
        if first == "mesh3d":
            return _volume(lines)
        raise Unreadable(f"it begins with {first[:20]!r}; it must begin with mesh3d")


def _volume(lines: Iterator[str]) -> FileMesh:
    points: list[list[float]] = []
    solids: list[list[int]] = []
    surfaces: list[list[int]] = []
    names: dict[int, str] = {}
    for line in lines:
        if line == "points":
            points = [_reals(row) for row in _rows(lines, line)]
        elif line == "volumeelements":
            solids = [_wholes(row) for row in _rows(lines, line)]
        elif line.startswith("surfaceelements"):
            surfaces = [_wholes(row, 5)[4:] for row in _rows(lines, line)]
        elif line == "materials":
            for row in _rows(lines, line):
                number, _, name = row.partition(" ")
                names[_wholes(number)[0]] = name.strip()
        elif line == "endmesh":
            break
    return _mesh(points, [(row[0], row[2 : 2 + row[1]]) for row in map(_counted, solids)], surfaces, names)


def _mesh(
    points: list[list[float]],
    solids: list[tuple[int, list[int]]],
    surfaces: list[list[int]],
    names: dict[int, str],
) -> FileMesh:
    if not points:
        raise Unreadable("it has no points")
    notes, blocks = [], []
    for count, kind in SOLIDS.items():
        found = [(material, nodes) for material, nodes in solids if len(nodes) == count]
        if found:
            nodes = np.array([row[: CORNERS[kind]] for _, row in found], np.int64) - 1
            blocks.append(Block(kind, nodes, {MATERIAL: np.array([material for material, _ in found], np.int64)}))
            if count > CORNERS[kind]:
                notes.append(corners_note(kind))
    odd = next((len(nodes) for _, nodes in solids if len(nodes) not in SOLIDS), None)
    if odd is not None:
        raise Unreadable(f"a volume element has {odd} nodes")
    for count, kind in SURFACES.items():
        rows = [row[1 : 1 + CORNERS[kind]] for row in surfaces if row[0] == count and len(row) > count]
        if rows:
            blocks.append(Block(kind, np.array(rows, np.int64) - 1))
    named = {MATERIAL: names} if names else {}
    return FileMesh(np.array(points, np.float64), blocks, named, notes=notes)


def _rows(lines: Iterator[str], what: str) -> list[str]:
    """The lines of a section, whose first line has their number."""
    said = next(lines, "")
    if not said.isdecimal():
        raise Unreadable(f"the number of {what} is {said[:20]!r}")
    rows = list(islice(lines, int(said)))
    if len(rows) < int(said):
        raise Unreadable(f"it ends after {len(rows)} of {said} {what}")
    return rows


def _counted(row: list[int]) -> list[int]:
    if len(row) < 2 or len(row) != 2 + row[1]:
        raise Unreadable(f"a volume element is incomplete: {' '.join(map(str, row[:14]))!r}")
    return row


def _wholes(row: str, least: int = 1) -> list[int]:
    try:
        numbers = [int(word) for word in row.split() if "." not in word and "e" not in word]
    except ValueError:
        numbers = []
    if len(numbers) < least:
        raise Unreadable(f"{row[:60]!r} must be whole numbers")
    return numbers


def _reals(row: str) -> list[float]:
    try:
        numbers = [float(word) for word in row.split()[:3]]
    except ValueError:
        numbers = []
    if len(numbers) != 3:
        raise Unreadable(f"{row[:60]!r} must be three coordinates")
    return numbers
