"""Materials by label, as ``--labels`` gives them: ``liver=3kPa:0.45,vessel@4+5=30kPa:0.45:1060``."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..errors import InputError
from ..materials import Isotropic

if TYPE_CHECKING:
    from ..mesh import TetForest

PASCALS = {"": 1.0, "Pa": 1.0, "kPa": 1e3, "MPa": 1e6, "GPa": 1e9}
FORM = "NAME[@NUMBER[+NUMBER...]]=YOUNG[:POISSON[:DENSITY]]"
_ENTRY = re.compile(r"\s*(?P<name>[^@=:]+?)\s*(?:@\s*(?P<numbers>\d+(?:\s*\+\s*\d+)*)\s*)?=(?P<values>.*)")


@dataclass(frozen=True)
class LabelMaterial:
    """A label and what its tissue is like.

    Attributes:
        name: For the mesh and the summary.
        numbers: Of its voxels; () where only a name was given.
        young: Young's modulus [Pa].
        poisson: Poisson's ratio, None where it was left out.
        density: [kg/m^3], as ``poisson``.
    """

    name: str
    numbers: tuple[int, ...]
    young: float
    poisson: float | None
    density: float | None


def parse_labels(text: str) -> list[LabelMaterial]:
    """The labels that an option names.

    Raises:
        InputError: Not of that form, or a label given twice.
    """
    found = [_entry(part) for part in text.split(",")]
    for what, given in (
        ("label", [entry.name for entry in found]),
        ("number", [str(number) for entry in found for number in entry.numbers]),
    ):
        twice = [value for value in given if given.count(value) > 1]
        if twice:
            raise InputError(f"--labels {text!r}: the {what} {twice[0]} is given twice")
    return found


def parse_pressure(text: str) -> float:
    """A pressure [Pa], such as "3kPa", "0.1 MPa" or "500".

    Raises:
        InputError: No number, or another unit.
    """
    match = re.fullmatch(r"\s*([-+]?[\d.]+(?:[eE][-+]?\d+)?)\s*([A-Za-z]*)\s*", text)
    try:
        return float(match[1]) * PASCALS[match[2]]  # type: ignore[index]
    except (TypeError, KeyError, ValueError):
        raise InputError(
            f"{text.strip()!r} is no Young's modulus; it must be one such as 500, 3kPa or 0.1MPa"
        ) from None


def _entry(part: str) -> LabelMaterial:
    match = _ENTRY.fullmatch(part)
    values = match["values"].split(":") if match else []
    if not match or not 1 <= len(values) <= 3:
        raise InputError(f"--labels {part.strip()!r}: it must be {FORM}, such as liver=3kPa:0.45")
    name = match["name"]
    numbers = tuple(int(number) for number in (match["numbers"] or "").split("+") if number)
    if not numbers and name.isdecimal():
        numbers = (int(name),)
    try:
        young = parse_pressure(values[0])
        rest = [_number(value, what) for value, what in zip(values[1:], ("Poisson's ratio", "density"), strict=False)]
        poisson, density = [*rest, None, None][:2]
        Isotropic(young, 0.0 if poisson is None else poisson, 1.0 if density is None else density)
    except InputError as error:
        raise InputError(f"--labels {part.strip()!r}: {error}") from None
    return LabelMaterial(name, numbers, young, poisson, density)


def _number(text: str, what: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise InputError(f"{text.strip()!r} is no {what}; it must be a number")
    return value


def numbers_by_name(entries: Sequence[LabelMaterial], path: Path) -> tuple[dict[str, tuple[int, ...]], str | None]:
    """The numbers of each label in a volume, and what to say of it.

    Where names alone are given, and as many as the volume has labels, they are its labels in ascending order.

    Raises:
        InputError: Some names have numbers and some not, or there are more or fewer names than labels.
    """
    bare = [entry.name for entry in entries if not entry.numbers]
    if not bare:
        return {entry.name: entry.numbers for entry in entries}, None
    from ..io.volumes import load_volume

    values = np.unique(load_volume(path).values)
    there = [number for number in values.tolist() if number != 0]
    if len(bare) != len(entries) or len(there) != len(bare):
        known = ", ".join(f"{number:g}" for number in there[:40]) or "none"
        raise InputError(
            f"{path}: which label {bare[0]!r} is, is not known; say its number, as in {bare[0]}@1=3kPa; the volume's "
            f"labels: {known}"
        )
    pairs = dict(zip(bare, there, strict=True))
    said = ", ".join(f"{name} is {number:g}" for name, number in pairs.items())
    return (
        {name: (number,) for name, number in pairs.items()},
        f"the volume's labels are taken in ascending order: {said} (say {bare[0]}@NUMBER=... for others)",
    )


def label_material(mesh: TetForest, entries: Sequence[LabelMaterial], poisson: float, density: float) -> Isotropic:
    """The material of each element by its label; ``poisson`` and ``density`` where a label leaves them out."""
    of_label = {name: number for number, name in enumerate(mesh.label_names, start=1)}
    table = np.ones((3, len(mesh.label_names) + 1))
    for entry in entries:
        own = (entry.poisson, poisson), (entry.density, density)
        table[:, of_label[entry.name]] = [entry.young, *(default if given is None else given for given, default in own)]
    assert mesh.labels is not None
    young, poissons, densities = table[:, mesh.labels]
    return Isotropic(young, poissons, densities)
