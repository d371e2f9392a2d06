"""TetGen's pairs of files: .node with points and .ele with tetrahedra."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from .filemesh import Block, FileMesh, Unreadable, corners_note


def read(path: Path) -> FileMesh:
    """The tetrahedra of the pair to which a file belongs, with their first attribute as regions.

    Raises:
        Unreadable: The other file does not exist, or numbers are missing or inconsistent.
    """
    node, ele = (_partner(path, suffix) for suffix in (".node", ".ele"))
    count, (dimension, attributes, markers), numbers = _table(node, 3)
    if dimension != 3:
        raise Unreadable(f"{node.name} has {dimension} dimensions; it must have 3")
    rows = _rows(numbers, count, 4 + attributes + markers, node)
    index = _whole(rows[:, 0], node)
    tets, (corners, regions), numbers = _table(ele, 2)
    if corners not in (4, 10):
        raise Unreadable(f"{ele.name} has {corners} nodes a tetrahedron; it must have 4 or 10")
    cells = _rows(numbers, tets, 1 + corners + regions, ele)
    named = _whole(cells[:, 1:5], ele)
    order = np.argsort(index, kind="stable")
    place = np.searchsorted(index[order], named).clip(0, max(len(index) - 1, 0))
    if not len(index) or (index[order][place] != named).any():
        raise Unreadable(f"{ele.name} names a point that is not in {node.name}")
    data = {}
    if regions and (cells[:, 1 + corners] == np.round(cells[:, 1 + corners])).all():
        data["attribute"] = cells[:, 1 + corners].astype(np.int64)
    notes = [corners_note("tetra")] if corners == 10 else []
    return FileMesh(rows[:, 1:4], [Block("tetra", order[place], data)], notes=notes)


def _partner(path: Path, suffix: str) -> Path:
    """The file of the pair with this extension, in upper or lower case."""
    if path.suffix.lower() == suffix:
        return path
    for candidate in (path.with_suffix(suffix), path.with_suffix(suffix.upper())):
        if candidate.is_file():
            return candidate
    raise Unreadable(f"{path.with_suffix(suffix).name} is missing; the two files must be in one folder")


def _table(path: Path, words: int) -> tuple[int, list[int], NDArray[np.float64]]:
    """The count in a file's first line, the numbers after it, and all numbers of the other lines."""
    lines = [line.partition("#")[0] for line in path.read_text("ascii", "replace").splitlines()]
    lines = [line for line in lines if line.strip()]
    first = lines[0].split() if lines else []
    try:
        head = [int(word) for word in first]
    except ValueError:
        head = []
    if len(head) < 2 or min(head) < 0:
        raise Unreadable(f"{path.name} begins with {' '.join(first)!r}; it must begin with counts")
    try:
        numbers = np.array(" ".join(lines[1:]).split(), dtype=np.float64)
    except ValueError as error:
        raise Unreadable(f"{path.name}: {error}") from None
    return head[0], [*head[1:], *[0] * words][:words], numbers


def _rows(numbers: NDArray[np.float64], count: int, width: int, path: Path) -> NDArray[np.float64]:
    if len(numbers) != count * width:
        raise Unreadable(f"{path.name} has {len(numbers)} numbers; it must have {count} rows of {width}")
    return numbers.reshape(count, width)


def _whole(values: NDArray[np.float64], path: Path) -> NDArray[np.int64]:
    if not (np.isfinite(values).all() and (values == np.round(values)).all() and (np.abs(values) < 2**53).all()):
        raise Unreadable(f"{path.name} has numbers of points that are not whole")
    return values.astype(np.int64)
