"""Gmsh's format 1, whose files begin with ``$NOD``."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from .filemesh import Block, FileMesh, Unreadable, corners_note, real, whole

#: Kinds and their corners, and the number of nodes, by the format's element types.
KINDS = {
    2: ("triangle", 3, 3),
    3: ("quad", 4, 4),
    4: ("tetra", 4, 4),
    5: ("hexahedron", 8, 8),
    6: ("wedge", 6, 6),
    7: ("pyramid", 5, 5),
    9: ("triangle", 3, 6),
    10: ("quad", 4, 9),
    11: ("tetra", 4, 10),
    12: ("hexahedron", 8, 27),
    13: ("wedge", 6, 18),
    14: ("pyramid", 5, 14),
    16: ("quad", 4, 8),
    17: ("hexahedron", 8, 20),
    18: ("wedge", 6, 15),
    19: ("pyramid", 5, 13),
}


def read(path: Path) -> FileMesh | None:
    """Nodes and elements; None for a file of another version.

    Raises:
        Unreadable: The file is truncated or its numbers are inconsistent.
    """
    with path.open("rb") as file:
        if not file.read(64).lstrip(b"\xef\xbb\xbf \t\r\n").startswith((b"$NOD", b"$NOE")):
            return None
    lines = iter(path.read_text("ascii", "replace").split("\n"))
    tags: list[int] = []
    places: list[list[float]] = []
    cells: dict[int, list[tuple[int, int, list[int]]]] = {}
    for line in lines:
        if line.strip() in ("$NOD", "$NOE"):
            for number in range(_count(lines, "nodes")):
                words = next(lines, "").split()
                if len(words) < 4:
                    raise Unreadable(f"node {number} must have three coordinates: {' '.join(words)!r}")
                tags.append(whole(words[0]))
                places.append([real(word) for word in words[1:4]])
        elif line.strip() == "$ELM":
            for number in range(_count(lines, "elements")):
                row = [whole(word) for word in next(lines, "").split()]
                if len(row) < 5 or len(row) < 5 + row[4]:
                    raise Unreadable(f"element {number} is incomplete: {' '.join(map(str, row[:12]))!r}")
                cells.setdefault(row[1], []).append((row[2], row[3], row[5 : 5 + row[4]]))
    if not tags:
        raise Unreadable("it has no nodes")
    order = np.argsort(tags, kind="stable")
    numbers, points = np.array(tags)[order], np.array(places, np.float64)[order]
    blocks, ignored, notes = [], {}, []
    for kind, found in cells.items():
        if kind not in KINDS:
            ignored[{1: "line", 8: "line", 15: "vertex"}.get(kind, f"type {kind}")] = len(found)
            continue
        name, corners, count = KINDS[kind]
        if any(len(nodes) != count for _, _, nodes in found):
            raise Unreadable(f"an element of type {kind} must have {count} nodes")
        if count > corners:
            notes.append(corners_note(name))
        named = np.array([nodes[:corners] for _, _, nodes in found])
        index = np.searchsorted(numbers, named).clip(0, len(numbers) - 1)
        if (numbers[index] != named).any():
            raise Unreadable(f"an element names node {named[numbers[index] != named][0]}, which does not exist")
        groups, entities = (np.array([row[k] for row in found]) for k in (0, 1))
        blocks.append(Block(name, index, {"physical group": groups, "entity": entities}))
    return FileMesh(points, blocks, {}, ignored, notes)


def _count(lines, what: str) -> int:
    line = next(lines, "").strip()
    if not line.isdecimal():
        raise Unreadable(f"the number of {what} is {line!r}")
    return int(line)
