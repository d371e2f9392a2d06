"""Materials by label or region, as ``--labels`` and ``--materials`` give them, such as
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

if TYPE_CHECKING:
    from warp_corot.discretization.elements import Mesh
    from warp_corot.io.read.regions import Regions
    from warp_corot.io.read.volumes import LoadedVolume
    from warp_corot.mesh import TetForest, TetMesh

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


def parse_labels(text: str, option: str = "--labels") -> list[LabelMaterial]:
    """The labels that an option names.

    Raises:
        InputError: Not of that form, or a label given twice.
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
    """A pressure [Pa], such as "3kPa", "0.1 MPa" or "500".

    Raises:
        InputError: No number, or another unit.
    """
    return _quantity(text, "Pa", "Young's modulus", "500, 3kPa or 0.1MPa")


def _entry(part: str, option: str, form: str | None = None) -> LabelMaterial:
    match = _ENTRY.fullmatch(part)
    values = match["values"].split(":") if match else []
    if not match or not 1 <= len(values) <= 3:
        raise InputError(form or f"{option} {part.strip()!r}: it must be {FORM}, such as liver=3kPa:0.45")
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
        raise InputError(f"{text.strip()!r} is no {what}; it must be one such as {such_as}")
    return value


def numbers_by_name(
    entries: Sequence[LabelMaterial], volume: LoadedVolume
) -> tuple[dict[str, tuple[int, ...]], str | None]:
    """The numbers of each label in a volume, and what to say of it.

    Where names alone are given, and as many as the volume has labels, they are its labels in ascending order.

    Raises:
        InputError: Some names have numbers and some not, or there are more or fewer names than labels.
    """
    bare = [entry.name for entry in entries if not entry.numbers]
    if not bare:
        return {entry.name: entry.numbers for entry in entries}, None
    values = np.unique(volume.values)
    there = [number for number in values.tolist() if number != 0]
    if len(bare) != len(entries) or len(there) != len(bare):
        known = ", ".join(f"{number:g}" for number in there[:40]) or "none"
        raise InputError(
            f"{volume.source}: which label {bare[0]!r} is, is not known; say its number, as in {bare[0]}@1=3kPa; the "
            f"volume's labels: {known}"
        )
    pairs = dict(zip(bare, there, strict=True))
    said = ", ".join(f"{name} is {number:g}" for name, number in pairs.items())
    return (
        {name: (number,) for name, number in pairs.items()},
        f"the volume's labels are taken in ascending order: {said} (say {bare[0]}@NUMBER=... for others)",
    )


def of_regions(entries: Sequence[LabelMaterial], regions: Regions) -> tuple[tuple[str, ...], list[LabelMaterial]]:
    """A mesh's regions by the names that entries give them, and an entry for each region that one names.

    Entries name regions by number where they give any, else by name; case does not count.

    Raises:
        InputError: An entry names no region, or two name the same; the message lists those there are.
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
            raise InputError(f"--materials names {missing[0]!r}, no region by {regions.array!r}; there are: {known}")
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
        young: Young's modulus [Pa] of elements of no label, or of one that has no entry.
        poisson: Poisson's ratio of these, and where an entry leaves it out.
        density: Density [kg/m^3], likewise.
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
    """The material where ``--region`` gives tetrahedra one of their own.

    Args:
        mesh: The body's.
        inside: Which tetrahedra are in a patch, bool [T].
        regions: Pairs of a patch and ``YOUNG[:POISSON[:DENSITY]]``; the last one that holds a tetrahedron counts.
        base: What the others are made of, and what values that are left out come from.

    Raises:
        InputError: Not of that form, or no tetrahedron in a region.
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
