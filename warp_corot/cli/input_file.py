"""The input: read once, classified by its content, placed by unit, scale and up axis, and divided into bodies."""

from __future__ import annotations

import argparse
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from warp_corot.domain.units import length, likely_unit, metres_per_unit, unlikely_size
from warp_corot.errors import InputError
from warp_corot.io.read import FileMesh
from warp_corot.io.read.filemesh import LoadedVolume
from warp_corot.io.read.meshes import (
    Asset,
    LoadedMesh,
    check_file,
    find_asset,
    load_surface,
    load_tets,
    read_file,
)

from .options import NEEDS, TETS


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
    loaded: LoadedMesh | LoadedVolume | None = None
    notes: list[str] = field(default_factory=list)
    unit: str | float | None = None

    @property
    def source(self) -> Path:
        """The file."""
        return self.asset.path if self.asset else Path(self.name)


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
        return InputFile(name, "scan", loaded=found)
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
    loaded = opened.loaded
    if opened.kind == "tets":
        loaded = load_tets(opened.name, unit=1.0, regions=args.regions_by, found=opened.found)
        opened = replace(opened, loaded=loaded)
    if isinstance(loaded, LoadedMesh):
        named: str | float | None = loaded.metres
        size = longest_side(loaded.points[np.unique(loaded.cells)])
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
    if isinstance(loaded, LoadedMesh) and not loaded.is_surface:
        scale = (asset.scale if asset and as_asset else scale) * metres_per_unit(opened.unit or 1.0)
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


# --- an option without effect on this input is refused, with the reason ----------------------------------------------


def refuse_options(args: argparse.Namespace, opened: InputFile) -> None:
    """Check that every given option has an effect.

    Raises:
        InputError: An option has none; the message names it and its purpose.
    """
    for name, needed in NEEDS.items():
        if getattr(args, name) is not None and not getattr(args, needed):
            raise InputError(f"--{name.replace('_', '-')} is for --{needed}, which is not given")
    is_scan = opened.kind == "scan"
    regions = opened.found is not None and any(block.data for block in opened.found.solids)
    is_organ, is_forest = opened.kind in ("surface", "scan"), opened.kind != "tets"
    organs, forests, numbered = "surfaces and scans", "box, surfaces and scans", "tetrahedra whose file numbers regions"
    rules = {
        "skin": (opened.kind == "surface" or (is_scan and args.skin == "marched"), "surfaces"),
        "level": (is_forest, forests),
        "rotation_level": (is_forest, forests),
        "unit": (opened.kind != "box", "files"),
        "up": (opened.kind != "box", "files"),
        "join": (not is_forest or len(getattr(opened.loaded, "objects", ())) > 1, "several objects and tetrahedra"),
        "labels": (is_scan, "scans"),
        "smoothing": (is_scan, "scans"),
        "threshold": (is_scan and args.labels is args.materials is None, "scans without --labels and --materials"),
        "tets": (is_organ, organs),
        "min_layers": (is_organ, organs),
        "draw_tets": (is_organ, organs),
        "materials": ((is_scan and args.labels is None) or regions, f"scans without --labels and {numbered}"),
        "regions_by": (args.materials is not None and regions, f"--materials on {numbered}"),
        "draw_labels": (is_scan or regions, f"scans and {numbered}"),
    }
    for name, (applies, purpose) in rules.items():
        if getattr(args, name, None) not in (None, False) and not applies:
            instead = "; use --scale" if name == "unit" else ""
            raise InputError(f"--{name.replace('_', '-')} is for {purpose}, and {args.input} is not one{instead}")
    if opened.kind != "box" and args.level is not None and args.tets is not None:
        raise InputError("--level is given, with which --tets has no effect")
    if args.labels is not None and args.young is not None:
        raise InputError("--young is given, but --labels gives each label its own")
    if args.draw_labels and args.labels is None and args.materials is None:
        raise InputError("--draw-labels draws the labels that --labels or --materials names")


# --- several bodies of one file --------------------------------------------------------------------------------------

#: More objects are joined: otherwise each would be a body with its own mesh.
MOST_BODIES = 32
#: Minimum number of tetrahedra of each of several bodies that share a number.
FEWEST_TETS = 100
#: Points of an object that are closer than this fraction of its length are merged.
SAME = 1.0e-6


def bodies_in(opened: InputFile, args: argparse.Namespace) -> list[tuple[InputFile, argparse.Namespace]]:
    """The bodies of an input with their options.

    The objects of a surface's file are separate bodies if each is closed, none is a cavity of another, and
    ``--join`` is not given. They share the number of tetrahedra by volume. Prims, blocks and instances of
    tetrahedra are separate bodies, too.
    """
    loaded = opened.loaded
    several = isinstance(loaded, LoadedMesh) and 2 <= len(loaded.objects) <= MOST_BODIES
    if args.join or not several:
        return [(opened, args)]
    assert isinstance(loaded, LoadedMesh)
    parts, shares = _parts(loaded), np.zeros(0)
    if loaded.is_surface:
        from warp_corot.domain.closing import close_surface

        try:
            whole, *closed = (close_surface(part.points, part.cells) for part in (loaded, *parts))
        except InputError:
            return [(opened, args)]
        if whole.cavities or any(part.caps for part in closed):
            return [(opened, args)]
        shares = np.array([part.volume for part in closed])
        shares /= shares.sum()
    names = ", ".join(part.name for part in parts[:8]) + (", ..." if len(parts) > 8 else "")
    opened.notes.append(f"{len(parts)} separate bodies: {names} (--join makes them one)")
    found = []
    for place, part in enumerate(parts):
        own = argparse.Namespace(**vars(args))
        if len(shares) and args.level is None:
            own.tets = max(FEWEST_TETS, int((args.tets or TETS) * shares[place]))
        found.append((replace(opened, loaded=part, notes=opened.notes if place == 0 else []), own))
    return found


def _parts(loaded: LoadedMesh) -> list[LoadedMesh]:
    """The objects of a file, which share no nodes."""
    cells, parts = loaded.cells, list[LoadedMesh]()
    ends = np.cumsum([count for _, count in loaded.objects])
    for (name, count), chosen in zip(loaded.objects, np.split(np.arange(len(cells)), ends[:-1]), strict=True):
        if not count:
            continue
        used, renumbered = np.unique(cells[chosen], return_inverse=True)
        own = np.asarray(renumbered.reshape(-1, cells.shape[1]), dtype=np.int32)
        sets = {known: np.flatnonzero(np.isin(used, nodes)) for known, nodes in loaded.node_sets.items()}
        regions = loaded.regions and replace(loaded.regions, of_tet=loaded.regions.of_tet[chosen])
        sets = {known: nodes for known, nodes in sets.items() if len(nodes)}
        about: dict[str, Any] = {"regions": regions, "node_sets": sets, "notes": [] if parts else loaded.notes}
        parts.append(replace(loaded, points=loaded.points[used], cells=own, name=name, objects=[], **about))
    return parts


def merged_nodes(
    points: npt.NDArray[np.float64], tets: npt.NDArray[np.int32]
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.int32], npt.NDArray[np.int64]]:
    """Tetrahedra with coincident nodes merged, and the new node of each point."""
    step = SAME * longest_side(points) or 1.0
    _, kept, place = np.unique(np.round(points / step), axis=0, return_index=True, return_inverse=True)
    return points[kept], place.reshape(-1)[tets].astype(np.int32), place.reshape(-1)
