"""Shapes of ``--tool`` and the paths of ``--tool-path``."""

from __future__ import annotations

import argparse
import csv
import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from warp_corot.contact.shapes import Box, Capsule, Cylinder, Shape, Sphere
from warp_corot.contact.tool import Tool
from warp_corot.cutting.blade import Blade
from warp_corot.domain.units import in_units
from warp_corot.errors import InputError

#: Lengths that each shape needs.
LENGTHS = {"sphere": ("r",), "capsule": ("r", "l"), "cylinder": ("r", "l"), "box": ("x", "y", "z")}
FORMS = "sphere:r=R, capsule:r=R,l=L, cylinder:r=R,l=L or box:x=X,y=Y,z=Z, for example capsule:r=4mm,l=100mm"
#: Columns of a path, and their units.
POSITION = {"time": "s", "x": "m", "y": "m", "z": "m"}
TURN = ("qx", "qy", "qz", "qw")
COLUMNS = f"{', '.join(POSITION)}, and for turns also {', '.join(TURN)}"
_HEADER = re.compile(r"\s*([A-Za-z_]+)\s*(?:[\[(]\s*([^\])]+?)\s*[\])])?\s*")

Floats = npt.NDArray[np.float64]
AnyTool = TypeVar("AnyTool", bound=Tool)


@dataclass(frozen=True)
class ToolShape:
    """A shape as ``--tool`` names it.

    Attributes:
        text: The option's text.
        kind: A key of `LENGTHS`.
        lengths: By their names [m].
        friction: Coulomb's coefficient; None: that of all contacts.
    """

    text: str
    kind: str
    lengths: dict[str, float]
    friction: float | None

    def __str__(self) -> str:
        return self.text

    def make(self) -> Shape:
        """The shape at the origin.

        Raises:
            InputError: A length is not positive, or the friction is negative.
        """
        at = self.lengths
        if self.kind == "sphere":
            return Sphere(at["r"], friction=self.friction)
        if self.kind == "box":
            return Box((at["x"], at["y"], at["z"]), friction=self.friction)
        return (Capsule if self.kind == "capsule" else Cylinder)(at["r"], at["l"], friction=self.friction)


def tool_shape(text: str) -> ToolShape:
    """A shape from the text of ``--tool``, for ``add_argument(type=...)``."""
    kind, _, rest = text.partition(":")
    kind = kind.strip().lower()
    try:
        if kind not in LENGTHS:
            raise InputError(f"{kind!r} is not a shape")
        values = dict(_pair(word) for word in rest.split(","))
        friction = values.pop("friction", None)
        lengths = {name: in_units(value, "m") for name, value in values.items()}
        if set(lengths) != set(LENGTHS[kind]) or len(values) + (friction is not None) != rest.count(",") + 1:
            raise InputError(f"a {kind} has {', '.join(LENGTHS[kind])}, each once")
        shape = ToolShape(text, kind, lengths, None if friction is None else float(friction))
        shape.make()
    except (InputError, ValueError) as error:
        raise argparse.ArgumentTypeError(f"{text!r}: {error}; it must be {FORMS}") from None
    return shape


def _pair(word: str) -> tuple[str, str]:
    name, equals, value = word.partition("=")
    if not equals:
        raise InputError(f"{word!r} is not NAME=VALUE")
    return name.strip().lower(), value.strip()


def make_tool(shape: ToolShape, path: Path) -> Tool:
    """A tool that moves along the path in a file; with a single row it stays there.

    Raises:
        InputError: The file cannot be read, or its rows are not a path.
    """
    return _moved(Tool(shape.make()), path)


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


def make_blade(path: Path, length: float) -> Blade:
    """A straight blade of this length [m] that moves along the path in a file; see ``make_tool``."""
    return _moved(Blade([(0.0, 0.0, -0.5 * length), (0.0, 0.0, 0.5 * length)]), path)


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
        raise InputError(f"{path}: is empty; it must have rows of {COLUMNS}")
    columns = _columns(rows[0][1], path)
    if columns is None:
        names, units = _unnamed(len(rows[0][1]), path)
    else:
        (names, units), rows = columns, rows[1:]
    if not rows:
        raise InputError(f"{path}: has names of columns and no rows; it must have one at least")
    values = np.array([_row(number, row, names, units, path) for number, row in rows])
    of = {name: values[:, place] for place, name in enumerate(names)}
    times = of["time"]
    for (number, _), before, after in zip(rows[1:], times, times[1:], strict=False):
        if not after > before:
            raise InputError(f"{path}: line {number}: time is {after:g} s after {before:g} s; times must increase")
    turns = np.stack([of[name] for name in TURN], axis=1) if "qw" in of else None
    return times, np.stack([of[axis] for axis in "xyz"], axis=1), turns


def _columns(row: list[str], path: Path) -> tuple[list[str], list[str]] | None:
    """Names and units of the columns; None if the row has values.

    Raises:
        InputError: Other names, or one is missing.
    """
    if _is_value(row[0]):
        return None
    names, units = [], []
    for word in row:
        match = _HEADER.fullmatch(word)
        name = match[1].lower() if match else word
        name = "time" if name == "t" else name
        if not match or name not in (*POSITION, *TURN) or name in names:
            raise InputError(f"{path}: has a column {word.strip()!r}; its columns must be {COLUMNS}")
        names.append(name)
        units.append(match[2] or POSITION.get(name, ""))
        try:
            _factor(units[-1], POSITION.get(name, ""))
        except InputError as error:
            raise InputError(f"{path}: column {word.strip()!r}: {error}") from None
    missing = [name for name in POSITION if name not in names]
    missing += [name for name in TURN if name not in names and any(other in names for other in TURN)]
    if missing:
        raise InputError(f"{path}: has no column {missing[0]!r}; its columns must be {COLUMNS}")
    return names, units


def _unnamed(count: int, path: Path) -> tuple[list[str], list[str]]:
    names = [*POSITION, *TURN]
    if count not in (len(POSITION), len(names)):
        raise InputError(f"{path}: has {count} columns without names; they must be {COLUMNS}")
    return names[:count], [POSITION.get(name, "") for name in names[:count]]


def _is_value(text: str) -> bool:
    try:
        in_units(text, "s")
    except InputError:
        return text.strip()[:1].isdigit()
    return True


def _row(number: int, row: list[str], names: list[str], units: list[str], path: Path) -> list[float]:
    """The values of a row in SI units."""
    if len(row) != len(names):
        raise InputError(f"{path}: line {number} has {len(row)} values; it must have {len(names)}")
    found = []
    for text, name, unit in zip(row, names, units, strict=True):
        base = POSITION.get(name)
        try:
            has_unit = not _is_plain(text)
            value = in_units(text, base) if base and has_unit else float(text) * _factor(unit, base or "")
        except (InputError, ValueError):
            value = math.nan
        if not math.isfinite(value):
            raise InputError(f"{path}: line {number}: {name} is {text.strip()!r}; it must be a finite number")
        found.append(value)
    return found


def _is_plain(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _factor(unit: str, base: str) -> float:
    return 1.0 if unit == base or not base else in_units(f"1 {unit}", base)
