"""Text formats: input files (.inp) of Abaqus, CalculiX, FreeCAD and Gmsh, and TetGen's pairs of files."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from .filemesh import CORNERS, Block, FileMesh, Unreadable, corners_note, real, whole

# --- abaqus ----------------------------------------------------------------------------------------------------------

#: Kinds by the number of nodes in an element type's name.
SOLIDS = {4: "tetra", 10: "tetra", 5: "pyramid", 13: "pyramid", 6: "wedge", 15: "wedge"}
SOLIDS |= {8: "hexahedron", 20: "hexahedron", 27: "hexahedron"}
SHELLS = {3: "triangle", 6: "triangle", 4: "quad", 8: "quad", 9: "quad"}
SOLID = re.compile(r"(?:[DA]?C3D|SC)(\d+)")
SHELL = re.compile(r"(?:STRI|SFM3D|R3D|M3D|F3D|DS|CPS|CPE|S)(\d+)")
#: Maximum depth of included files.
DEEPEST = 8
#: Names of the arrays with the numbers of sets and of instances.
SETS, INSTANCES = "element set", "instance"


@dataclass
class Card:
    """A keyword with its parameters and the data lines after it."""

    keyword: str
    given: dict[str, str]
    lines: list[str]

    def numbers(self) -> list[list[str]]:
        """The data as words by line; a comma at the end of a line has no meaning."""
        return [[word.strip() for word in line.rstrip(", \t").split(",")] for line in self.lines]


@dataclass
class AbaqusPart:
    """Nodes, elements and sets of a part; a file without parts is one part."""

    nodes: dict[int, list[float]] = field(default_factory=dict)
    elements: dict[str, list[list[int]]] = field(default_factory=dict)  # kind -> rows of number and corners
    of_lines: dict[str, list[int]] = field(default_factory=dict)
    sets: dict[str, list[int]] = field(default_factory=dict)
    sections: list[str] = field(default_factory=list)
    node_sets: dict[str, list[int]] = field(default_factory=dict)


def read_abaqus(path: Path) -> FileMesh:
    """The elements of all instances, with sets as arrays of numbers, and node sets, including those of element sets.

    Regions are the sets to which sections give a material; without sections, those in which elements are listed;
    without these, the other sets, the smallest one if several contain an element.

    Raises:
        Unreadable: Inconsistent nodes or elements, or an included file that does not exist.
    """
    parts: dict[str, AbaqusPart] = {"": AbaqusPart()}
    instances: list[tuple[str, str, NDArray[np.float64]]] = []
    of_instances: list[tuple[str, str, list[int]]] = []
    here, names = parts[""], {"": ""}
    notes: list[str] = []
    ignored: dict[str, int] = {}
    for card in _cards(path, 0):
        word, given = card.keyword, card.given
        if word == "PART":
            here = parts.setdefault(given.get("NAME", "").upper(), AbaqusPart())
        elif word == "ENDPART":
            here = parts[""]
        elif word == "INSTANCE":
            name, part = given.get("NAME", ""), given.get("PART", "").upper()
            if part not in parts:
                raise Unreadable(f"the instance {name!r} is of part {part!r}, which does not exist")
            instances.append((name, part, _placed(card)))
            here = parts[part]
        elif word == "ENDINSTANCE":
            here = parts[""]
        elif word == "NODE":
            for row in card.numbers():
                here.nodes[whole(row[0])] = [*((real(word) if word else 0.0) for word in row[1:4]), 0.0, 0.0, 0.0][:3]
            if given.get("NSET"):
                members = here.node_sets.setdefault(_known(names, given["NSET"]), [])
                members.extend(whole(row[0]) for row in card.numbers())
        elif word == "ELEMENT":
            _elements(card, here, ignored, notes)
        elif word == "ELSET":
            placed = _part_of(instances, given.get("INSTANCE", ""))
            owner = here if placed is None else parts[placed]
            name = given.get("ELSET", "")
            owner.sets.setdefault(_known(names, name), []).extend(_members(card, owner.of_lines | owner.sets, names))
        elif word == "NSET":
            instance, name = given.get("INSTANCE", ""), _known(names, given.get("NSET", ""))
            placed = _part_of(instances, instance)
            if placed is None:
                here.node_sets.setdefault(name, []).extend(_members(card, here.node_sets, names))
            else:
                of_instances.append((name, instance.upper(), _members(card, parts[placed].node_sets, names)))
        elif word in ("SOLIDSECTION", "SHELLSECTION"):
            here.sections.append(_known(names, given.get("ELSET", "")))
    if not instances or parts[""].nodes:
        instances.insert(0, ("", "", np.eye(4)))
    return _joined_parts(parts, instances, of_instances, ignored, list(dict.fromkeys(notes)))


def _cards(path: Path, depth: int) -> Iterator[Card]:
    """The keywords of a file and of its included files."""
    card: Card | None = None
    unfinished = False
    for line in path.read_text("utf-8", "replace").splitlines():
        if line.startswith("**") or not line.strip():
            continue
        if line.lstrip().startswith("*") or (unfinished and card):
            if unfinished and card:
                card.given |= _parameters(line)
            else:
                if card:
                    yield card
                keyword, _, rest = line.strip()[1:].partition(",")
                card = Card(re.sub(r"\s", "", keyword).upper(), _parameters(rest), [])
            unfinished = line.rstrip().endswith(",")
            if card.keyword == "INCLUDE" and not unfinished:
                other = path.parent / card.given.get("INPUT", "")
                if depth >= DEEPEST or not other.is_file():
                    raise Unreadable(f"it includes {card.given.get('INPUT', '')!r}, which does not exist")
                yield from _cards(other, depth + 1)
                card = None
        elif card:
            card.lines.append(line)
    if card:
        yield card


def _parameters(text: str) -> dict[str, str]:
    found = {}
    for part in text.split(","):
        name, _, value = part.partition("=")
        if name.strip():
            found[re.sub(r"\s", "", name).upper()] = value.strip().strip('"')
    return found


def _known(names: dict[str, str], name: str) -> str:
    """A set's name in its first spelling: case does not matter."""
    return names.setdefault(name.upper(), name)


def _part_of(instances: list[tuple[str, str, NDArray[np.float64]]], instance: str) -> str | None:
    return next((part for name, part, _ in instances if name.upper() == instance.upper() and instance), None)


def _placed(card: Card) -> NDArray[np.float64]:
    """An instance's affine [4, 4]: a translation, then a rotation about the axis between two points."""
    rows = [[(real(word) if word else 0.0) for word in row] for row in card.numbers()]
    affine = np.eye(4)
    if rows:
        affine[:3, 3] = [*rows[0], 0.0, 0.0, 0.0][:3]
    if len(rows) > 1 and len(rows[1]) == 7:
        start, axis, angle = np.array(rows[1][:3]), np.subtract(rows[1][3:6], rows[1][:3]), np.deg2rad(rows[1][6])
        x, y, z = axis / (np.linalg.norm(axis) or 1.0)
        cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        rotation = np.eye(4)
        rotation[:3, :3] += np.sin(angle) * cross + (1.0 - np.cos(angle)) * cross @ cross
        rotation[:3, 3] = start - rotation[:3, :3] @ start
        affine = rotation @ affine
    return affine


def _elements(card: Card, part: AbaqusPart, ignored: dict[str, int], notes: list[str]) -> None:
    name = card.given.get("TYPE", "").upper()
    solid, shell = SOLID.match(name), SHELL.match(name)
    count = int(solid[1]) if solid else 6 if name == "STRI65" else int(shell[1][0]) if shell else 0
    kind = SOLIDS.get(count) if solid else SHELLS.get(count) if shell else None
    if kind is None:
        ignored[name] = ignored.get(name, 0) + len(card.lines)
        return
    if name == "C3D15V":
        count = 18
    words = [whole(word) for row in card.numbers() for word in row if word]
    if len(words) % (count + 1):
        raise Unreadable(f"elements of type {name} have {len(words)} numbers, not a multiple of {count + 1}")
    corners = CORNERS[kind]
    if count > corners:
        notes.append(corners_note(kind))
    rows = [words[k : k + 1 + corners] for k in range(0, len(words), count + 1)]
    part.elements.setdefault(kind, []).extend(rows)
    if card.given.get("ELSET"):
        part.of_lines.setdefault(card.given["ELSET"], []).extend(row[0] for row in rows)


def _members(card: Card, sets: dict[str, list[int]], names: dict[str, str]) -> list[int]:
    """Numbers of the elements or nodes in a set: listed, in ranges, or by other sets."""
    rows = card.numbers()
    if "GENERATE" in card.given:
        found: list[int] = []
        for row in rows:
            first, last, step = [*(whole(word) for word in row), 1][:3]
            if step < 1 or (last - first) // step > 10**8:
                raise Unreadable(f"a set's range is {', '.join(row)}")
            found += range(first, last + 1, step)
        return found
    found = []
    for word in (word for row in rows for word in row if word):
        if re.fullmatch(r"\d+", word):
            found.append(int(word))
        else:
            name = names.get(word.upper(), word)
            found += sets.get(name, [])
    return found


def _joined_parts(
    parts: dict[str, AbaqusPart],
    instances: list[tuple[str, str, NDArray]],
    of_instances: list[tuple[str, str, list[int]]],
    ignored: dict[str, int],
    notes: list[str],
) -> FileMesh:
    points: list[NDArray[np.float64]] = [np.empty((0, 3))]
    blocks: list[Block] = []
    numbers: dict[str, int] = {}
    sets: dict[str, list[NDArray[np.int64]]] = {}
    offset = 0
    for place, (instance, name, affine) in enumerate(instances, start=1):
        part = parts[name]
        tags = np.array(sorted(part.nodes), np.int64)
        own = np.array([part.nodes[tag] for tag in tags.tolist()], np.float64).reshape(-1, 3)
        set_of = _regions(part, numbers)
        for kind, rows in part.elements.items():
            table = np.array(rows, np.int64)
            index = np.searchsorted(tags, table[:, 1:]).clip(0, max(len(tags) - 1, 0))
            if not len(tags) or (tags[index] != table[:, 1:]).any():
                row, column = np.argwhere(tags[index] != table[:, 1:])[0] if len(tags) else (0, 0)
                raise Unreadable(f"element {table[row, 0]} names node {table[row, 1 + column]}, which does not exist")
            data = {SETS: np.array([set_of.get(tag, 0) for tag in table[:, 0].tolist()], np.int64)}
            if len(instances) > 1:
                data[INSTANCES] = np.full(len(table), place)
            blocks.append(Block(kind, index + offset, data))
        points.append(own @ affine[:3, :3].T + affine[:3, 3])
        mine = {known: members for known, owner, members in of_instances if owner == instance.upper()}
        for known, members in (_nodes_of_sets(part) | part.node_sets | mine).items():
            found = np.intersect1d(np.array(members, np.int64), tags)
            sets.setdefault(known, []).append(np.searchsorted(tags, found) + offset)
        offset += len(own)
    if not blocks and not offset:
        raise Unreadable("it has no *NODE and no *ELEMENT")
    names = {SETS: {number: name for name, number in numbers.items()}}
    if len(instances) > 1:
        names[INSTANCES] = {k: name or f"instance {k}" for k, (name, _, _) in enumerate(instances, start=1)}
    joined = {known: np.concatenate(parts_of) for known, parts_of in sets.items() if sum(map(len, parts_of))}
    return FileMesh(np.concatenate(points), blocks, names, ignored, notes, joined)


def _nodes_of_sets(part: AbaqusPart) -> dict[str, list[int]]:
    """The nodes of the elements in each element set."""
    corners = {row[0]: row[1:] for rows in part.elements.values() for row in rows}
    sets = part.of_lines | part.sets
    return {name: [node for tag in members for node in corners.get(tag, ())] for name, members in sets.items()}


def _regions(part: AbaqusPart, numbers: dict[str, int]) -> dict[int, int]:
    """The number of each element's set."""
    sets = {**part.of_lines, **part.sets}
    with_section = {name: sets[name] for name in part.sections if name in sets}
    chosen = with_section or part.of_lines or dict(sorted(part.sets.items(), key=lambda item: -len(item[1])))
    found: dict[int, int] = {}
    for name, members in chosen.items():
        number = numbers.setdefault(name, len(numbers) + 1)
        found |= dict.fromkeys(members, number)
    return found


# --- tetGen: .node with points and .ele with tetrahedra --------------------------------------------------------------


def read_tetgen(path: Path) -> FileMesh:
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
