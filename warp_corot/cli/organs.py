"""Bodies from surfaces and scans: the processing of an input that has no tetrahedra."""

from __future__ import annotations

import argparse
import warnings
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from warp_corot.errors import InputError
from warp_corot.inputs.stopwatch import WATCH
from warp_corot.io.read.surfaces import LoadedSurface
from warp_corot.mesh import TetForest
from warp_corot.mesh.lattice import checked_level

from .exit_status import as_options
from .input_file import InputFile, offset_of, placed
from .input_mesh import InputMesh
from .label_materials import LabelMaterial, numbers_by_name, parse_labels
from .options.defaults import CUBES_OF_LEVEL, MAX_LEVEL_FOR_ERROR, TETS

if TYPE_CHECKING:
    from warp_corot.domain import Domain
    from warp_corot.domain.fidelity import Fidelity
    from warp_corot.io.read.volumes import LoadedVolume
    from warp_corot.io.write.skins import OwnSurface
    from warp_corot.mesh import SurfaceMesh

#: With a surface error or a level instead of a number of tetrahedra: the default number for each root cube in a cube of
#: the body's length, which gives the size of root cubes.
TETS_PER_CUBE = 30
#: With a surface error: the number of further levels for details between nodes.
DETAIL = 6
#: Root cubes extend beyond the body by this fraction of its length.
MARGIN = 1.0e-3
#: Names of Python's arguments on the command line.
ARGUMENTS = {
    name: f"--{name.replace('_', '-')}"
    for name in ("unit", "cell_size", "max_level", "surface_error", "min_layers", "smoothing")
} | {"target_elements": "--tets"}
#: A scan with more distinct values, or with negative ones, holds intensities, not labels.
MOST_LABELS = 256
#: Number of voxels that are checked for this.
LOOKED_AT = 10**6


def find_organ(opened: InputFile, args: argparse.Namespace) -> InputMesh:
    """Mesh the body that a surface or a scan encloses.

    Args:
        opened: The input, a surface or a scan.
        args: The command's arguments.

    Raises:
        InputError: It encloses no body, or an option is out of its range.
    """
    with as_options(ARGUMENTS):
        started = WATCH.clock()
        entries: list[LabelMaterial] = []
        domain = domain_of(opened, args, entries)
        meshing = WATCH.clock()
        mesh = _mesh(args, domain)
        surface = mesh.surface()
        done = WATCH.clock()
        measured = _measured(args, mesh, domain, surface)
        skin = _own_surface(opened, args, domain)
    asset, loaded = opened.asset, opened.loaded
    assert loaded is not None
    subject = InputMesh(
        mesh,
        loaded.name.encode(errors="replace").decode(),
        opened.source,
        domain=domain,
        surface=surface,
        fidelity=measured,
        skin=skin,
        labels=entries,
        times={"domain": meshing - started, "mesh": done - meshing, "measuring": WATCH.clock() - done},
        notes=opened.notes,
    )
    if asset:
        subject.take(asset, args)
    return subject


def domain_of(opened: InputFile, args: argparse.Namespace, entries: list[LabelMaterial]) -> Domain:
    """The domain of a surface or a scan; ``entries`` are filled with the materials of its labels."""
    return _scan(opened, args, entries) if opened.kind == "scan" else _surface(opened, args)


def fineness_of(args: argparse.Namespace, domain: Domain) -> dict[str, Any]:
    """The arguments of ``from_domain`` for a level."""
    size = args.cell_size
    if size is None:
        size = float(np.ptp(domain.bounds, axis=0).max()) * (1.0 + MARGIN) / CUBES_OF_LEVEL
    checked_level(args.level, "--level")
    return {"cell_size": size, "max_level": args.level, "surface_error": args.surface_error, "device": args.device}


def _surface(opened: InputFile, args: argparse.Namespace) -> Domain:
    from warp_corot.domain import Domain

    return Domain.from_surface(placed(opened, args), unit=opened.unit, device=args.device)


def _scan(opened: InputFile, args: argparse.Namespace, entries: list[LabelMaterial]) -> Domain:
    """The domain of a scan; ``entries`` are filled with the materials of its labels."""
    from warp_corot.domain import Domain

    volume, unit = placed(opened, args), opened.unit
    if args.threshold is None:
        volume = _without_nan(volume, opened.notes)
    option, text = ("--labels", args.labels) if args.labels is not None else ("--materials", args.materials)
    numbers: dict[str, Any] | None = None
    if text is not None:
        entries += parse_labels(text, option)
        numbers, said = numbers_by_name(entries, volume)
        opened.notes += [said] if said else []
        if option == "--materials":
            # The other labels are part of the body, too.
            named = {number for of_name in numbers.values() for number in of_name}
            numbers |= {f"{n:g}": (n,) for n in np.unique(volume.values).tolist() if n != 0 and n not in named}
    elif args.threshold is not None:
        inside = (volume.values >= args.threshold.low) & (volume.values <= args.threshold.high)
        volume = replace(volume, values=inside.astype(np.uint8))
    else:
        _see_labels(volume)
    smoothing = args.smoothing or 0.0
    up = args.up or "Z"
    return Domain.from_labels(volume, labels=numbers, unit=unit, smoothing=smoothing, up_axis=up, device=args.device)


def _without_nan(volume: LoadedVolume, notes: list[str]) -> LoadedVolume:
    """The volume with 0, which is outside, in place of values that are not numbers."""
    if volume.values.dtype.kind != "f" or not (missing := np.isnan(volume.values)).any():
        return volume
    notes.append(f"{np.count_nonzero(missing)} voxels are not a number and count as outside")
    return replace(volume, values=np.where(missing, 0.0, volume.values))


def _see_labels(volume: LoadedVolume) -> None:
    """Check that a scan holds labels.

    Raises:
        InputError: It holds intensities.
    """
    values = np.ravel(volume.values)
    found = np.unique(values[:: max(1, len(values) // LOOKED_AT)])
    fractions = found[found != np.round(found)]
    if len(fractions):
        raise InputError(
            f"{volume.source}: has values such as {fractions[0]:g}, as probabilities and intensities do, not labels; "
            "give --threshold LOW[:HIGH] for the voxels that make up the body"
        )
    if np.isfinite(found).all() and (len(found) > MOST_LABELS or found[0] < 0):
        raise InputError(
            f"{volume.source}: has {len(found)} different values or more, {found[0]:g} to {found[-1]:g}, as "
            "intensities do, not labels; give --threshold LOW[:HIGH] for the voxels that make up the body, or --labels"
        )


def _mesh(args: argparse.Namespace, domain: Domain) -> TetForest:
    if args.level is not None:
        return TetForest.from_domain(domain, **fineness_of(args, domain))
    count = args.tets
    if count is None and args.max_level is None and args.surface_error is None:
        count = TETS
    size, level, detail = args.cell_size, args.max_level, 0
    if count is None:
        detail = DETAIL
        if size is None:
            cubes = max(1, round((TETS / TETS_PER_CUBE) ** (1.0 / 3.0)))
            size = float(np.ptp(domain.bounds, axis=0).max()) * (1.0 + MARGIN) / cubes
        if level is None:
            level = MAX_LEVEL_FOR_ERROR
    layers = {} if args.min_layers is None else {"min_layers": args.min_layers}
    try:
        return TetForest.from_domain(
            domain,
            size,
            max_level=level,
            surface_error=args.surface_error,
            target_elements=count,
            detail=detail,
            device=args.device,
            **layers,
        )
    except InputError as error:
        unsaid = count is not None and count >= 1 and args.surface_error is None and "target_elements" not in str(error)
        with_tets = f"with --tets {count}, " if unsaid else ""
        raise InputError(f"{with_tets}{error}") from None


def _own_surface(opened: InputFile, args: argparse.Namespace, domain: Domain) -> OwnSurface | None:
    """The input surface, if it is to be drawn."""
    if not isinstance(opened.loaded, LoadedSurface) or args.skin == "marched":
        return None
    from warp_corot.io.write.skins import OwnSurface

    found = OwnSurface.of_domain(opened.source, opened.loaded, domain.bounds, offset_of(args))
    if found is None:
        opened.notes.append("the surface was changed when it was closed: the marched one is drawn")
    return found


def _measured(args: argparse.Namespace, mesh: TetForest, domain: Domain, surface: SurfaceMesh) -> Fidelity:
    """Measure how well the mesh approximates the body, and warn of deviations."""
    from warp_corot.domain.fidelity import fidelity
    from warp_corot.domain.units import length

    found = fidelity(mesh, domain, surface=surface)
    more, through = 2 * len(mesh.tets), ""
    if found.needed > more:
        more = int(float(f"{found.needed:.1e}"))
        through = ", of which one fits through the thinnest walls"
    for doubt in found.doubts():
        said = doubt.replace("more tetrahedra", f"more tetrahedra (--tets {more}{through})")
        warnings.warn(said.replace("tetrahedra in all", "tetrahedra in all (--tets)"), stacklevel=2)
    off = max(found.distance_95)
    if args.surface_error is not None and off > args.surface_error:
        helps = (
            "a larger --tets"
            if args.tets is not None
            else f"--{'max-' * (args.level is None)}level {int(mesh.levels.max()) + 3}"
        )
        warnings.warn(
            f"--surface-error is {length(args.surface_error)}, and 95 % of the surface are within {length(off)}; "
            f"{helps} would bring it nearer",
            stacklevel=2,
        )
    return found
