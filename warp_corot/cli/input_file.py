"""The input: read once, classified by its content, and placed by unit, scale and up axis."""

from __future__ import annotations

import argparse
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from warp_corot.domain.units import length, likely_unit, metres_per_unit, unlikely_size
from warp_corot.errors import InputError
from warp_corot.io.read import FileMesh
from warp_corot.io.read.assets import Asset, find_asset
from warp_corot.io.read.surfaces import LoadedSurface, load_surface, read_file
from warp_corot.io.read.tetrahedra import LoadedMesh, check_file, load_tets
from warp_corot.io.read.volumes import LoadedVolume, is_volume, load_volume, volume_of_image


@dataclass
class InputFile:
    """An input that has been read.

    Attributes:
        name: The argument INPUT.
        kind: "box", "tets", "surface" or "scan".
        asset: The asset with this name, if any.
        found: The content of its file, unless it is a scan.
        surface: Its triangles, if it is a surface.
        volume: Its voxels, if it is a scan.
        tets: Its tetrahedra; see `with_unit`.
        notes: Notes for the user, one line each.
        unit: The unit of its coordinates; see `with_unit`. None: that of the asset.
    """

    name: str
    kind: str
    asset: Asset | None = None
    found: FileMesh | None = None
    surface: LoadedSurface | None = None
    volume: LoadedVolume | None = None
    tets: LoadedMesh | None = None
    notes: list[str] = field(default_factory=list)
    unit: str | float | None = None

    @property
    def source(self) -> Path:
        """The file."""
        return self.asset.path if self.asset else Path(self.name)

    @property
    def has_regions(self) -> bool:
        """Whether its cells have numbers that may distinguish regions."""
        return self.found is not None and any(block.data for block in self.found.solids)


def open_input(name: str) -> InputFile:
    """Read the input.

    Raises:
        InputError: No such file or asset, an unknown format, a file that cannot be read, or a file with nothing that
            makes a body.
    """
    if name == "box":
        return InputFile(name, "box")
    if "://" in name:
        raise InputError(f"{name}: is a web address; the input must be a file on this machine")
    asset = find_asset(name)
    path = asset.path if asset else Path(name)
    if path.is_dir() or is_volume(path):
        return InputFile(name, "scan", volume=load_volume(path))
    if asset is None:
        check_file(path, "mesh")
    found = read_file(path)
    if not isinstance(found, FileMesh):
        return InputFile(name, "scan", volume=volume_of_image(path, found))
    if found.solids:
        return InputFile(name, "tets", asset, found)
    if found.faces:
        return InputFile(name, "surface", asset, found, load_surface(name, found=found))
    raise InputError(f"{path}: has no tetrahedra and no triangles (cell types: {found.kinds()})")


def with_unit(opened: InputFile, args: argparse.Namespace) -> InputFile:
    """The input with the unit of its coordinates, and with its tetrahedra if it has any [m, or in that unit if the file
    and ``--unit`` name none].

    ``--unit`` and ``--scale`` decide without a word. Otherwise the first note says which unit the coordinates are taken
    in if the file names none, or that a body is of unlikely size.

    Raises:
        InputError: ``--scale`` is not positive, or see `load_tets`.
    """
    if args.scale is not None and not 0.0 < args.scale < np.inf:
        raise InputError(f"scale is {args.scale:g}; it must be a positive number")
    named: str | float | None = None
    if opened.kind == "tets":
        given = None if args.unit is None else metres_per_unit(args.unit)
        tets = load_tets(opened.name, unit=given, regions=args.regions_by, found=opened.found)
        size, named = _longest(tets.points, tets.tets), 1.0 if tets.says_unit else None
        opened = replace(opened, tets=tets)
    elif opened.surface is not None:
        size, named = _longest(opened.surface.points, opened.surface.triangles), opened.surface.metres
    elif opened.volume is not None:
        steps = np.linalg.norm(opened.volume.affine[:3, :3], axis=0)
        size, named = float((opened.volume.values.shape * steps).max()), opened.volume.unit
    else:
        return opened
    if args.unit is not None or args.scale is not None or opened.asset:
        return replace(opened, unit=args.unit or named or (None if opened.asset else "m"))
    unit = named or likely_unit(size, scan=opened.kind == "scan")
    metres = metres_per_unit(unit)
    doubt = (unlikely_size(size * metres, metres) or "").replace("unit=", "--unit ")
    if not named:
        unlikely = ", which is unlikely" if doubt else ""
        doubt = (
            f"names no unit: its {size:.4g} units are taken as {unit}, so that it is {length(size * metres)} long"
            f"{unlikely} (--unit names another)"
        )
    if doubt:
        opened.notes.insert(0, f"{opened.source}: {doubt}")
    return replace(opened, unit=unit)


def placed_tets(opened: InputFile, args: argparse.Namespace) -> LoadedMesh:
    """The tetrahedra in metres."""
    loaded, asset = opened.tets, opened.asset
    assert loaded is not None
    scale = 1.0 if args.scale is None else args.scale
    if asset and args.scale is None and args.unit is None:
        scale = asset.scale
    if args.unit is None and not loaded.says_unit and not asset:
        scale *= metres_per_unit(opened.unit or 1.0)
    opened.notes += loaded.notes
    return replace(loaded, points=loaded.points * scale + offset_of(args), up_axis=args.up or loaded.up_axis)


def offset_of(args: argparse.Namespace) -> np.ndarray:
    """The initial displacement of a body [m], [3]."""
    return np.zeros(3) if args.offset is None else np.array(args.offset, dtype=np.float64)


def placed_surface(opened: InputFile, args: argparse.Namespace) -> LoadedSurface:
    """The triangles, scaled and moved, in `InputFile.unit`."""
    loaded = opened.surface
    assert loaded is not None
    scale = 1.0 if args.scale is None else args.scale
    own_notes = loaded.notes
    if opened.asset and (args.unit is not None or args.scale is not None):
        # The requested size replaces the asset's own scale.
        scale, own_notes = scale / opened.asset.scale, []
    notes = [*own_notes, *([f"scaled by {args.scale:g}, as asked for"] if args.scale is not None else [])]
    points = loaded.points * scale + offset_of(args) / metres_per_unit(opened.unit or loaded.metres or 1.0)
    return replace(loaded, points=points, up_axis=args.up or loaded.up_axis, notes=notes)


def placed_volume(opened: InputFile, args: argparse.Namespace) -> LoadedVolume:
    """The voxels, scaled and moved, in `InputFile.unit`."""
    loaded = opened.volume
    assert loaded is not None
    scale = 1.0 if args.scale is None else args.scale
    affine = np.diag([scale, scale, scale, 1.0]) @ loaded.affine
    affine[:3, 3] += offset_of(args) / metres_per_unit(opened.unit or 1.0)
    notes = [*loaded.notes, *([f"scaled by {args.scale:g}, as asked for"] if args.scale is not None else [])]
    return replace(loaded, affine=affine, notes=notes)


def longest_side(points: np.ndarray) -> float:
    """The longest side of the box around points."""
    with np.errstate(invalid="ignore"):
        return float(np.ptp(points, axis=0).max()) if len(points) else 0.0


def _longest(points: np.ndarray, cells: np.ndarray) -> float:
    """The longest side of the box around the points that cells name."""
    return longest_side(points[np.unique(cells)])
