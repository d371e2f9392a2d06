"""Materials by label or region in the form of ``--labels`` and ``--materials``:
``liver=3kPa:0.45,vessel@4+5=30kPa:0.45:1.06g/cm3``."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from warp_corot.domain.units import in_units
from warp_corot.errors import InputError
from warp_corot.materials.isotropic import Isotropic

from .options.defaults import LABEL

if TYPE_CHECKING:
    from warp_corot.discretization.elements import Mesh
    from warp_corot.io.read.regions import Regions
    from warp_corot.io.read.volumes import LoadedVolume
    from warp_corot.mesh import TetForest, TetMesh

_ENTRY = re.compile(r"\s*(?P<name>[^@=:]+?)\s*(?:@\s*(?P<numbers>\d+(?:\s*\+\s*\d+)*)\s*)?=(?P<values>.*)")


@dataclass(frozen=True)
class LabelMaterial:
    """A label and its material.

    Attributes:
        name: Name for the mesh and the summary.
        numbers: Numbers of its voxels; () if only a name was given.
        young: Young's modulus [Pa].
        poisson: Poisson's ratio, None if not given.
        density: Density [kg/m^3], None if not given.
    """

    name: str
    numbers: tuple[int, ...]
    young: float
    poisson: float | None
    density: float | None


def parse_labels(text: str, option: str = "--labels") -> list[LabelMaterial]:
    """The labels that an option names.

    Raises:
        InputError: Another form, or a label given twice.
    """
    found = [_entry(part, option) for part in text.split(",")]
    for what, given in (
        ("label", [entry.name for entry in found]),
        ("number", [str(number) for entry in found for number in entry.numbers]),
    ):
        twice = [value for value in given if given.count(value) > 1]
        if twice:
            raise InputError(f"{option} {text!r}: the {what} {twice[0]} is given twice")
    return found


def parse_pressure(text: str) -> float:
    """A pressure [Pa] from "3kPa", "0.1 MPa" or "500".

    Raises:
        InputError: Not a number, or another unit.
    """
    return _quantity(text, "Pa", "Young's modulus", "500, 3kPa or 0.1MPa")


def _entry(part: str, option: str, form: str | None = None) -> LabelMaterial:
    match = _ENTRY.fullmatch(part)
    values = match["values"].split(":") if match else []
    if not match or not 1 <= len(values) <= 3:
        raise InputError(form or f"{option} {part.strip()!r}: it must be {LABEL}, for example liver=3kPa:0.45")
    name = match["name"]
    numbers = tuple(int(number) for number in (match["numbers"] or "").split("+") if number)
    if not numbers and name.isdecimal():
        numbers = (int(name),)
    try:
        young = parse_pressure(values[0])
        poisson = _quantity(values[1], "", "Poisson's ratio", "0.45") if len(values) > 1 else None
        density = _quantity(values[2], "kg/m^3", "density", "1060 or 1.06g/cm3") if len(values) > 2 else None
        Isotropic(young, 0.0 if poisson is None else poisson, 1.0 if density is None else density)
    except InputError as error:
        said = f"{option} {part.strip()!r}" if form is None else form.split(": it must")[0]
        raise InputError(f"{said}: {error}") from None
    return LabelMaterial(name, numbers, young, poisson, density)


def _quantity(text: str, unit: str, what: str, such_as: str) -> float:
    try:
        value = in_units(text, unit)
    except InputError:
        value = math.nan
    if not math.isfinite(value):
        raise InputError(f"{what} is {text.strip()!r}; it must be a value like {such_as}")
    return value


def numbers_by_name(
    entries: Sequence[LabelMaterial], volume: LoadedVolume
) -> tuple[dict[str, tuple[int, ...]], str | None]:
    """The numbers of each label in a volume, and a note for the user.

    If only names are given, as many as the volume has labels, they are its labels in ascending order.

    Raises:
        InputError: Only some names have numbers, or there are more or fewer names than labels.
    """
    bare = [entry.name for entry in entries if not entry.numbers]
    if not bare:
        return {entry.name: entry.numbers for entry in entries}, None
    values = np.unique(volume.values)
    there = [number for number in values.tolist() if number != 0]
    if len(bare) != len(entries) or len(there) != len(bare):
        known = ", ".join(f"{number:g}" for number in there[:40]) or "none"
        raise InputError(
            f"{volume.source}: the number of label {bare[0]!r} is not known; it must be given, as in {bare[0]}@1=3kPa; "
            f"the volume's labels: {known}"
        )
    pairs = dict(zip(bare, there, strict=True))
    said = ", ".join(f"{name} is {number:g}" for name, number in pairs.items())
    return (
        {name: (number,) for name, number in pairs.items()},
        f"the volume's labels are taken in ascending order: {said} ({bare[0]}@NUMBER=... names others)",
    )


def of_regions(entries: Sequence[LabelMaterial], regions: Regions) -> tuple[tuple[str, ...], list[LabelMaterial]]:
    """A mesh's regions with the names in the entries, and an entry for each region that one names.

    Entries name regions by number if they have any, else by name; case does not matter.

    Raises:
        InputError: An entry names no region, or two name the same; the message lists the regions.
    """
    names, taken, found = list(regions.names), dict[int, str](), list[LabelMaterial]()
    for entry in entries:
        keys: Sequence[object] = regions.numbers if entry.numbers else [name.lower() for name in regions.names]
        wanted: Sequence[object] = entry.numbers or (entry.name.lower(),)
        missing = [key for key in wanted if key not in keys]
        if missing:
            known = ", ".join(
                name if name == str(number) else f"{name} ({number})"
                for name, number in zip(regions.names[:40], regions.numbers, strict=False)
            )
            rest = "; 0 is none of them and has --young, --poisson and --density" if missing[0] == 0 else ""
            raise InputError(
                f"--materials names {missing[0]!r}, not a region by {regions.array!r}; there are: {known}{rest}"
            )
        places = [keys.index(key) for key in wanted]
        if len(places) == 1 and not entry.name.isdecimal() and entry.name not in names:
            names[places[0]] = entry.name
        for place in places:
            if place in taken:
                raise InputError(f"--materials gives {names[place]} to both {taken[place]!r} and {entry.name!r}")
            taken[place] = entry.name
            found.append(replace(entry, name=names[place]))
    return tuple(names), found


def label_material(
    mesh: TetForest | TetMesh, entries: Sequence[LabelMaterial], young: float, poisson: float, density: float
) -> Isotropic:
    """The material of each element by its label.

    Args:
        mesh: A mesh with labels.
        entries: Materials by label.
        young: Young's modulus [Pa] of elements without a label, or whose label has no entry.
        poisson: Poisson's ratio of these elements, and of entries without one.
        density: Density [kg/m^3] of these elements, and of entries without one.
    """
    of_label = {name: number for number, name in enumerate(mesh.label_names, start=1)}
    table = np.repeat([[young], [poisson], [density]], len(mesh.label_names) + 1, axis=1)
    for entry in entries:
        own = (entry.poisson, poisson), (entry.density, density)
        table[:, of_label[entry.name]] = [entry.young, *(default if given is None else given for given, default in own)]
    assert mesh.labels is not None
    youngs, poissons, densities = table[:, mesh.labels]
    return Isotropic(youngs, poissons, densities)


def covers_all(mesh: TetForest | TetMesh, entries: Sequence[LabelMaterial]) -> bool:
    """Whether each element's label has an entry."""
    assert mesh.labels is not None
    named = {entry.name for entry in entries}
    return all(number and mesh.label_names[number - 1] in named for number in np.unique(mesh.labels).tolist())


def region_material(
    mesh: Mesh, inside: Callable[[str], np.ndarray], regions: Sequence[Sequence[str]], base: Isotropic
) -> Isotropic:
    """The material with those that ``--region`` gives to tetrahedra.

    Args:
        mesh: The body's mesh.
        inside: Which tetrahedra are in a patch, bool [T].
        regions: Pairs of a patch and ``YOUNG[:POISSON[:DENSITY]]``; the last one that contains a tetrahedron is used.
        base: The material of other tetrahedra, and the source of omitted values.

    Raises:
        InputError: Another form, or no tetrahedron in a region.
    """
    count = len(mesh.tets)
    values = [np.array(np.broadcast_to(value, count)) for value in (base.young, base.poisson, base.density)]
    for expression, text in regions:
        option = f"--region {expression!r} {text!r}"
        entry = _entry(f"region={text}", "--region", f"{option}: it must be PATCH YOUNG[:POISSON[:DENSITY]]")
        chosen = inside(expression)
        if not chosen.any():
            raise InputError(f"--region {expression!r}: there is no tetrahedron in it")
        for array, value in zip(values, (entry.young, entry.poisson, entry.density), strict=True):
            if value is not None:
                array[chosen] = value
    return Isotropic(*values)
