"""The input: read once, classified by its content, and placed by unit, scale and up axis."""

from __future__ import annotations

import argparse
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from warp_corot.domain.units import length, likely_unit, metres_per_unit, unlikely_size
from warp_corot.errors import InputError
from warp_corot.io.read import FileMesh
from warp_corot.io.read.assets import Asset, find_asset
from warp_corot.io.read.surfaces import LoadedSurface, load_surface, read_file
from warp_corot.io.read.tetrahedra import LoadedMesh, check_file, load_tets
from warp_corot.io.read.volumes import LoadedVolume, volume_of_image


@dataclass
class InputFile:
    """An input that has been read.

    Attributes:
        name: The argument INPUT.
        kind: "box", "tets", "surface" or "scan".
        asset: The asset with this name, if any.
        found: The content of its file, unless it is a scan.
        loaded: Its triangles or voxels; its tetrahedra, see `with_unit`.
        notes: Notes for the user, one line each.
        unit: The unit of its coordinates; see `with_unit`. None: that of the asset.
    """

    name: str
    kind: str
    asset: Asset | None = None
    found: FileMesh | None = None
    loaded: LoadedMesh | LoadedSurface | LoadedVolume | None = None
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
    if asset is None and not path.is_dir():
        check_file(path, "mesh")
    found = read_file(path)
    if not isinstance(found, FileMesh):
        return InputFile(name, "scan", loaded=volume_of_image(path, found))
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
    loaded = opened.loaded
    if opened.kind == "tets":
        given = None if args.unit is None else metres_per_unit(args.unit)
        loaded = load_tets(opened.name, unit=given, regions=args.regions_by, found=opened.found)
        opened = replace(opened, loaded=loaded)
    if isinstance(loaded, LoadedMesh):
        size, named = _longest(loaded.points, loaded.tets), 1.0 if loaded.says_unit else None
    elif isinstance(loaded, LoadedSurface):
        size, named = _longest(loaded.points, loaded.triangles), loaded.metres
    elif isinstance(loaded, LoadedVolume):
        steps = np.linalg.norm(loaded.affine[:3, :3], axis=0)
        size, named = float((loaded.values.shape * steps).max()), loaded.unit
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


def placed(opened: InputFile, args: argparse.Namespace) -> Any:
    """The content, scaled and moved: tetrahedra in metres, triangles and voxels in `InputFile.unit`."""
    loaded, asset, offset = opened.loaded, opened.asset, offset_of(args)
    scale = 1.0 if args.scale is None else args.scale
    as_asset = asset is not None and args.scale is None and args.unit is None
    if isinstance(loaded, LoadedMesh):
        if args.unit is None and not loaded.says_unit and not asset:
            scale *= metres_per_unit(opened.unit or 1.0)
        scale = asset.scale if asset and as_asset else scale
        opened.notes += loaded.notes
        return replace(loaded, points=loaded.points * scale + offset, up_axis=args.up or loaded.up_axis)
    assert loaded is not None
    notes = [*loaded.notes, *([f"scaled by {args.scale:g}, as asked for"] if args.scale is not None else [])]
    if isinstance(loaded, LoadedVolume):
        affine = np.diag([scale, scale, scale, 1.0]) @ loaded.affine
        affine[:3, 3] += offset / metres_per_unit(opened.unit or 1.0)
        return replace(loaded, affine=affine, notes=notes)
    if asset and not as_asset:  # the requested size replaces the asset's own scale
        scale, notes = scale / asset.scale, notes[len(loaded.notes) :]
    points = loaded.points * scale + offset / metres_per_unit(opened.unit or loaded.metres or 1.0)
    return replace(loaded, points=points, up_axis=args.up or loaded.up_axis, notes=notes)


def offset_of(args: argparse.Namespace) -> np.ndarray:
    """The initial displacement of a body [m], [3]."""
    return np.zeros(3) if args.offset is None else np.array(args.offset, dtype=np.float64)


def longest_side(points: np.ndarray) -> float:
    """The longest side of the box around points."""
    with np.errstate(invalid="ignore"):
        return float(np.ptp(points, axis=0).max()) if len(points) else 0.0


def _longest(points: np.ndarray, cells: np.ndarray) -> float:
    """The longest side of the box around the points that cells name."""
    return longest_side(points[np.unique(cells)])
