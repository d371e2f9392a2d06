"""Shapes of ``--tool`` and the paths of ``--tool-path``."""

from __future__ import annotations

import argparse
import csv
import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from warp_corot.contact.shapes import Box, Capsule, Cylinder, Shape, Sphere
from warp_corot.contact.tool import Tool
from warp_corot.cutting.blade import Blade
from warp_corot.domain.units import in_units
from warp_corot.errors import InputError

#: Shapes by name, each with the names of the lengths that it takes.
SHAPES: dict[str, tuple[Callable[..., Shape], str]] = {
    "sphere": (Sphere, "r"),
    "capsule": (Capsule, "rl"),
    "cylinder": (Cylinder, "rl"),
    "box": (lambda *size, **more: Box(size, **more), "xyz"),
}
FORMS = "sphere:r=R, capsule:r=R,l=L, cylinder:r=R,l=L or box:x=X,y=Y,z=Z, for example capsule:r=4mm,l=100mm"
#: Columns of a path, and their units.
POSITION = {"time": "s", "x": "m", "y": "m", "z": "m"}
COLUMNS = POSITION | dict.fromkeys(("qx", "qy", "qz", "qw"), "")
KNOWN = "time, x, y, z, and for turns also qx, qy, qz, qw"
_HEADER = re.compile(r"\s*([A-Za-z_]+)\s*(?:[\[(]\s*([^\])]+?)\s*[\])])?\s*")

Floats = npt.NDArray[np.float64]
AnyTool = TypeVar("AnyTool", bound=Tool)


@dataclass(frozen=True)
class ToolShape:
    """A shape as ``--tool`` names it: the option's text, the lengths [m], and Coulomb's coefficient if it has one."""

    text: str
    kind: str
    lengths: tuple[float, ...]
    options: dict[str, Any]

    def __str__(self) -> str:
        return self.text

    def make(self) -> Shape:
        """The shape at the origin.

        Raises:
            InputError: A length is not positive, or the friction is negative.
        """
        return SHAPES[self.kind][0](*self.lengths, **self.options)


def tool_shape(text: str) -> ToolShape:
    """A shape from the text of ``--tool``, for ``add_argument(type=...)``."""
    kind, _, rest = text.partition(":")
    kind = kind.strip().lower()
    try:
        if kind not in SHAPES:
            raise InputError(f"{kind!r} is not a shape")
        names = SHAPES[kind][1]
        pairs = [[part.strip() for part in word.split("=", 1)] for word in rest.split(",")]
        given = {pair[0].lower(): pair[-1] for pair in pairs}
        friction = given.pop("friction", None)
        if set(given) != set(names) or len(pairs) != len(names) + (friction is not None):
            raise InputError(f"a {kind} has {', '.join(names)}, each once")
        lengths = tuple(in_units(given[name], "m") for name in names)
        shape = ToolShape(text, kind, lengths, {} if friction is None else {"friction": float(friction)})
        shape.make()
    except (InputError, ValueError) as error:
        raise argparse.ArgumentTypeError(f"{text!r}: {error}; it must be {FORMS}") from None
    return shape


def make_tool(shape: ToolShape, path: Path) -> Tool:
    """A tool that moves along the path in a file; with a single row it stays there.

    Raises:
        InputError: The file cannot be read, or its rows are not a path.
    """
    return _moved(Tool(shape.make()), path)


def make_blade(path: Path, length: float) -> Blade:
    """A straight blade of this length [m] that moves along the path in a file; see ``make_tool``."""
    return _moved(Blade([(0.0, 0.0, -0.5 * length), (0.0, 0.0, 0.5 * length)]), path)


def _moved(tool: AnyTool, path: Path) -> AnyTool:
    times, positions, turns = read_tool_path(path)
    try:
        if len(times) == 1:
            tool.move(positions[0], None if turns is None else turns[0])
        else:
            tool.follow(times, positions, turns)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    return tool


def read_tool_path(path: Path) -> tuple[Floats, Floats, Floats | None]:
    """Times [s], [K], positions [m], [K, 3], and quaternions (x, y, z, w), [K, 4], or None without.

    The first row names the columns, with optional units ("x [mm]"); without names there are four or eight columns in
    the order of `COLUMNS`. A value may also have its own unit.

    Raises:
        InputError: No such file, other columns, a value that is not a finite number, or times that do not increase.
    """
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            rows = [(number, row) for number, row in enumerate(csv.reader(file), 1) if any(map(str.strip, row))]
    except FileNotFoundError:
        raise InputError(f"{path}: no such file (--tool-path)") from None
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{path}: cannot be read as CSV ({error})") from None
    if not rows:
        raise InputError(f"{path}: is empty; it must have rows of {KNOWN}")
    first = rows[0][1]
    units = dict.fromkeys(list(COLUMNS)[: len(first)], 1.0)
    if first[0].strip()[:1].isalpha():
        units, rows = _named_columns(first, path), rows[1:]
    elif len(first) not in (len(POSITION), len(COLUMNS)):
        raise InputError(f"{path}: has {len(first)} columns without names; they must be {KNOWN}")
    if not rows:
        raise InputError(f"{path}: has names of columns and no rows; it must have one at least")
    values = np.array([_values(row, units, f"{path}: line {number}") for number, row in rows])
    of = dict(zip(units, values.T, strict=True))
    late = np.flatnonzero(np.diff(of["time"]) <= 0.0)
    if len(late):
        before, after = of["time"][late[0] : late[0] + 2]
        line = rows[late[0] + 1][0]
        raise InputError(f"{path}: line {line}: time is {after:g} s after {before:g} s; times must increase")
    turns = np.stack([of[name] for name in ("qx", "qy", "qz", "qw")], axis=1) if "qw" in of else None
    return of["time"], np.stack([of[axis] for axis in "xyz"], axis=1), turns


def _named_columns(row: list[str], path: Path) -> dict[str, float]:
    """The columns that a row names, each with its unit in SI units.

    Raises:
        InputError: Other names or units, or one is missing.
    """
    found: dict[str, float] = {}
    for word in row:
        match = _HEADER.fullmatch(word)
        name = match[1].lower() if match else word
        name = "time" if name == "t" else name
        if not match or name not in COLUMNS or name in found:
            raise InputError(f"{path}: has a column {word.strip()!r}; its columns must be {KNOWN}")
        try:
            found[name] = in_units(f"1 {match[2]}", COLUMNS[name]) if match[2] and name in POSITION else 1.0
        except InputError as error:
            raise InputError(f"{path}: column {word.strip()!r}: {error}") from None
    needed = COLUMNS if found.keys() - POSITION else POSITION
    missing = [name for name in needed if name not in found]
    if missing:
        raise InputError(f"{path}: has no column {missing[0]!r}; its columns must be {KNOWN}")
    return found


def _values(row: list[str], units: dict[str, float], where: str) -> list[float]:
    """The values of a row in SI units."""
    if len(row) != len(units):
        raise InputError(f"{where} has {len(row)} values; it must have {len(units)}")
    found = []
    for text, (name, unit) in zip(row, units.items(), strict=True):
        try:
            found.append(unit * float(text))
        except ValueError:  # it has a unit of its own
            try:
                found.append(in_units(text, COLUMNS[name]))
            except InputError:
                found.append(math.nan)
        if not math.isfinite(found[-1]):
            raise InputError(f"{where}: {name} is {text.strip()!r}; it must be a finite number")
    return found
