"""The input: read once, classified by its content, and placed by unit, scale and up axis."""

from __future__ import annotations

import argparse
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from warp_corot.domain.units import LARGEST, likely_unit, metres_per_unit
from warp_corot.errors import InputError
from warp_corot.io.read import FileMesh, read_mesh_file
from warp_corot.io.read.assets import Asset, find_asset
from warp_corot.io.read.files import suffix_of
from warp_corot.io.read.surfaces import UP_AXES, LoadedSurface, load_surface
from warp_corot.io.read.tetrahedra import USD_SUFFIXES, LoadedMesh, check_file, load_tets, unknown_format
from warp_corot.io.read.volumes import LoadedVolume, is_volume, load_volume, volume_of_image

#: Larger meshes [m] get a note that they may be in millimetres.
LARGEST_PLAUSIBLE = 10.0


@dataclass
class Opened:
    """An input that has been read.

    Attributes:
        name: The argument INPUT.
        kind: "box", "tets", "surface" or "scan".
        asset: The asset with this name, if any.
        found: The content of its mesh file, if it is one.
        surface: Its triangles, if it is a surface.
        volume: Its voxels, if it is a scan.
        tets: Its tetrahedra in the file's unit [m if it has one], for one of several bodies in the file.
        notes: Notes for the user, one line each.
        size: Longest side in the file's unit of everything in it, for one of several bodies.
    """

    name: str
    kind: str
    asset: Asset | None = None
    found: FileMesh | None = None
    surface: LoadedSurface | None = None
    volume: LoadedVolume | None = None
    tets: LoadedMesh | None = None
    notes: list[str] = field(default_factory=list)
    size: float | None = None

    @property
    def source(self) -> Path:
        """The file."""
        return self.asset.path if self.asset else Path(self.name)

    @property
    def has_regions(self) -> bool:
        """Whether its cells have numbers that may distinguish regions."""
        return self.found is not None and any(block.data for block in self.found.solids)


def open_input(name: str) -> Opened:
    """Read the input.

    Raises:
        InputError: No such file or asset, an unknown format, a file that cannot be read, or a file with nothing that
            makes a body.
    """
    if name == "box":
        return Opened(name, "box")
    if "://" in name:
        raise InputError(f"{name}: is a web address; the input must be a file on this machine")
    asset = find_asset(name)
    path = asset.path if asset else Path(name)
    if path.is_dir() or is_volume(path):
        return Opened(name, "scan", volume=load_volume(path))
    if asset is None:
        check_file(path, "mesh")
    suffix = path.suffix.lower()
    if suffix in USD_SUFFIXES:
        from warp_corot.io.read.usd.look import has_mesh

        drawn = asset.is_surface if asset else has_mesh(path)
        return Opened(name, "surface", asset, surface=load_surface(name)) if drawn else Opened(name, "tets", asset)
    if suffix in UP_AXES:
        return Opened(name, "surface", asset, surface=load_surface(name))
    if suffix_of(path) is None:
        raise unknown_format(path)
    found = read_mesh_file(path)
    if not isinstance(found, FileMesh):
        return Opened(name, "scan", volume=volume_of_image(path, found))
    if found.solids:
        return Opened(name, "tets", found=found)
    if found.faces:
        return Opened(name, "surface", found=found, surface=load_surface(name, found=found))
    raise InputError(f"{path}: has no tetrahedra and no triangles (cell types: {found.kinds()})")


def placed_tets(opened: Opened, args: argparse.Namespace) -> LoadedMesh:
    """The tetrahedra in metres.

    Raises:
        InputError: See `load_tets`.
    """
    loaded = opened.tets or loaded_tets(opened, args)
    asset, scale = opened.asset, 1.0 if args.scale is None else args.scale
    if asset and args.scale is None and args.unit is None:
        scale = asset.scale
    points = loaded.points * scale
    size = opened.size * scale if opened.size else longest_side(points[np.unique(loaded.tets)])
    if args.unit is None and not loaded.says_unit:
        likely = likely_unit(size / scale)
        if likely and args.scale is None:
            points = points * metres_per_unit(likely)
            opened.notes.append(_guessed(likely, size))
        elif size > LARGEST_PLAUSIBLE:
            opened.notes.append(f"the mesh is {size:.3g} m long; if its coordinates are in mm, add --unit mm")
    opened.notes += loaded.notes
    return replace(loaded, points=points + offset_of(args), up_axis=args.up or loaded.up_axis)


def loaded_tets(opened: Opened, args: argparse.Namespace) -> LoadedMesh:
    """All tetrahedra of an input, before scale and offset.

    Raises:
        InputError: See `load_tets`.
    """
    return load_tets(opened.name, unit=_unit(args), regions=args.regions_by, found=opened.found)


def offset_of(args: argparse.Namespace) -> np.ndarray:
    """The initial displacement of a body [m], [3]."""
    return np.zeros(3) if args.offset is None else np.array(args.offset, dtype=np.float64)


def placed_surface(opened: Opened, args: argparse.Namespace) -> tuple[LoadedSurface, str | None]:
    """The triangles, scaled, and their unit if it is not the file's own."""
    loaded = opened.surface
    assert loaded is not None
    unit, scale = args.unit, 1.0 if args.scale is None else args.scale
    own_notes = loaded.notes
    if opened.asset and (args.unit is not None or args.scale is not None):
        # The requested size replaces the asset's own scale.
        scale, own_notes = scale / opened.asset.scale, []
    if unit is None and loaded.metres is None and args.scale is None:
        size = opened.size or longest_side(loaded.points[np.unique(loaded.triangles)])
        unit = likely_unit(size)
        if unit:
            opened.notes.append(_guessed(unit, size))
        elif LARGEST_PLAUSIBLE < size <= LARGEST:  # for larger ones, there is a warning
            opened.notes.append(f"the body is taken to be {size:.3g} m long: the file names no unit (--unit)")
    notes = [*own_notes, *([f"scaled by {args.scale:g}, as asked for"] if args.scale is not None else [])]
    points = loaded.points * scale + offset_of(args) / (metres_per_unit(unit) if unit else loaded.metres or 1.0)
    return replace(loaded, points=points, up_axis=args.up or loaded.up_axis, notes=notes), unit


def placed_volume(opened: Opened, args: argparse.Namespace) -> tuple[LoadedVolume, str | None]:
    """The voxels, scaled, and their unit if it is not the file's own."""
    loaded = opened.volume
    assert loaded is not None
    unit, scale = args.unit, 1.0 if args.scale is None else args.scale
    if unit is None and loaded.unit is None:
        size = float((np.array(loaded.values.shape) * np.linalg.norm(loaded.affine[:3, :3], axis=0)).max())
        unit = likely_unit(size, scan=True)
        if unit:
            opened.notes.append(_guessed(unit, size, "scan"))
    affine = np.diag([scale, scale, scale, 1.0]) @ loaded.affine
    affine[:3, 3] += offset_of(args) / metres_per_unit(unit or loaded.unit or 1.0)
    notes = [*loaded.notes, *([f"scaled by {args.scale:g}, as asked for"] if args.scale is not None else [])]
    return replace(loaded, affine=affine, notes=notes), unit


def _unit(args: argparse.Namespace) -> float | None:
    return None if args.unit is None else metres_per_unit(args.unit)


def longest_side(points: np.ndarray) -> float:
    """The longest side of the box around points."""
    with np.errstate(invalid="ignore"):
        return float(np.ptp(points, axis=0).max()) if len(points) else 0.0


def _guessed(unit: str, size: float, what: str = "body") -> str:
    return (
        f"the coordinates are taken to be in {unit}: the file names no unit, and the {what} is {size:.4g} units long "
        "(--unit names another)"
    )
