"""The mesh of an input, with its labels, and defaults for options that were not given."""

from __future__ import annotations

import argparse
import re
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from warp_corot.body.controls import named_nodes
from warp_corot.domain.units import in_units
from warp_corot.errors import InputError
from warp_corot.inputs.stopwatch import WATCH
from warp_corot.io.read.meshes import LoadedMesh
from warp_corot.materials.isotropic import Isotropic
from warp_corot.mesh import TetForest, TetMesh
from warp_corot.mesh.lattice import checked_level

from .input_file import InputFile, merged_nodes, offset_of, placed
from .options import BOX_LEVEL, CUBES_OF_LEVEL, LABEL, TETS

if TYPE_CHECKING:
    from warp_corot.domain import Domain
    from warp_corot.domain.fidelity import Fidelity
    from warp_corot.io.read.filemesh import LoadedVolume
    from warp_corot.io.read.meshes import Asset, Regions
    from warp_corot.io.write.skins import OwnSurface
    from warp_corot.mesh import SurfaceMesh

#: The box, the beam of Tagawa et al. 2013: its cubes, and their edge [m].
CELLS, CELL_SIZE = (1, 1, 3), 0.064
#: Its defaults.
BOX: dict[str, Any] = {"young": 500.0, "poisson": 0.49, "density": 10.0, "fix": "z <= zmin"}
BOX |= {"gravity": (0.0, -9.8, 0.0), "damping": 15.0, "duration": 4.0}


@dataclass
class InputMesh:
    """A mesh and its defaults.

    Attributes:
        mesh: The mesh, scaled.
        name: Name for titles.
        source: Its file, if any.
        young: Young's modulus [Pa]; None: from the body's weight.
        poisson: Poisson's ratio.
        density: Density [kg/m^3].
        fix: Expression for the fixed nodes.
        gravity: Acceleration [m/s^2]; None: down the mesh's up axis.
        damping: Rate of mass-proportional damping [1/s].
        duration: Simulated time [s].
        domain: Its domain, if it was made from a surface or a scan.
        surface: The smooth surface of a mesh made from a domain.
        fidelity: The comparison of the mesh with the domain.
        skin: The user's own surface, drawn in place of the smooth one.
        labels: Materials of its labels, if they were given.
        times: Times of its stages [s].
        notes: Notes for the user, one line each.
    """

    mesh: TetMesh | TetForest
    name: str
    source: Path | None = None
    young: float | None = None
    poisson: float = 0.45
    density: float = 1000.0
    fix: str | None = None
    gravity: tuple[float, float, float] | None = None
    damping: float = 2.0
    duration: float = 4.0
    domain: Domain | None = None
    surface: SurfaceMesh | None = None
    fidelity: Fidelity | None = None
    skin: OwnSurface | None = None
    labels: list[LabelMaterial] = field(default_factory=list)
    times: dict[str, float] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)

    @property
    def used(self) -> np.ndarray:
        """Indices of nodes that belong to a tetrahedron."""
        return np.unique(self.mesh.tets)

    @property
    def bounds(self) -> np.ndarray:
        """Lowest and highest coordinates of the body [m], [2, 3]."""
        points = self.mesh.points[self.used] if self.surface is None else self.surface.points
        return np.stack([points.min(axis=0), points.max(axis=0)])

    @property
    def height(self) -> float:
        """Extent along the up axis [m]."""
        lowest, highest = self.bounds[:, "XYZ".index(self.mesh.up_axis)]
        return float(highest - lowest)

    def drawn(self, are_cut: bool = False) -> OwnSurface | SurfaceMesh | None:
        """The user's own surface, unless the body can be cut, or the smooth one; None: that of its tetrahedra."""
        return self.surface if are_cut or self.skin is None else self.skin

    def take(self, asset: Asset, args: argparse.Namespace) -> None:
        """Use an asset's defaults, as far as they suit the options: its fixed nodes support a body of its size
        that is at least as stiff as the asset."""
        self.poisson, self.density = asset.poisson, asset.density
        self.damping, self.duration = asset.damping, asset.duration
        if args.unit is None and args.scale in (None, asset.scale):
            self.young = asset.young
            if args.young is None or args.young >= asset.young:
                self.fix = f"y < {float(f'{asset.fix_below + offset_of(args)[1]:.9g}'):g}"


def find_subject(opened: InputFile, args: argparse.Namespace) -> InputMesh:
    """The mesh of an input.

    Args:
        opened: The input: "box" or tetrahedra.
        args: The command's arguments.

    Raises:
        InputError: A mesh that cannot be simulated, or options that do not suit it.
    """
    if opened.kind == "box":
        level = BOX_LEVEL if args.level is None else args.level
        x, y, z = offset_of(args).tolist()
        box = TetForest.box(CELLS, CELL_SIZE * (args.scale or 1.0), level, origin=(x, y, z))
        return InputMesh(box, "box", **BOX)
    loaded: LoadedMesh = placed(opened, args)
    points, tets = loaded.points, loaded.cells
    sets = {name: np.isin(np.arange(len(points)), nodes) for name, nodes in loaded.node_sets.items()}
    if args.join:
        points, tets, place = merged_nodes(loaded.points, loaded.cells)
        if merged := len(place) - len(points):
            opened.notes.append(f"{merged} nodes coincide with others and are merged")
        elif not loaded.objects:
            raise InputError(f"{loaded.source}: no two nodes coincide, so that --join has no effect")
        sets = {name: np.bincount(place, mask, len(points)) > 0 for name, mask in sets.items()}
    entries, found = parse_labels(args.materials, "--materials") if args.materials else [], loaded.regions
    names, labels = tuple[str, ...](), None
    try:
        if entries and found is None:
            raise InputError("its arrays number no regions, so that --materials has no effect")
        if found is not None:
            (names, entries), labels = of_regions(entries, found), found.of_tet
        mesh = TetMesh(points, tets, up_axis=loaded.up_axis or "Z", labels=labels, label_names=names, node_sets=sets)
    except InputError as error:
        raise InputError(f"{loaded.source}: {error}") from None
    subject = InputMesh(mesh, loaded.name, loaded.source, labels=entries, notes=opened.notes)
    entries[:] = [entry for entry in entries if mesh.elements_of(entry.name).any()]
    if sets:
        subject.notes.append(f"its sets of nodes, for --fix and the like: {_listed(list(named_nodes(mesh)))}")
    if found is not None and not args.materials:
        shown = _listed(found.names)
        subject.notes.append(f"its regions by {found.array!r}: {shown} (--materials gives each its own)")
    asset = opened.asset
    if asset:
        subject.take(asset, args)
    if not args.join and not loaded.objects and len(tets) > 1 and np.unique(tets).size == tets.size:
        subject.notes.append("no two tetrahedra share a node (--join merges nodes that coincide)")
    return subject


def _listed(names: Sequence[str]) -> str:
    return ", ".join(names[:12]) + (", ..." if len(names) > 12 else "")


# --- surfaces and scans, which have no tetrahedra --------------------------------------------------------------------

#: Root cubes extend beyond the body by this fraction of its length.
MARGIN = 1.0e-3
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
    started = WATCH.clock()
    entries: list[LabelMaterial] = []
    from warp_corot.domain import Domain
    from warp_corot.domain.fidelity import fidelity
    from warp_corot.io.write.skins import OwnSurface

    if opened.kind == "scan":
        domain = _scan(opened, args, entries)
    else:
        domain = Domain.from_surface(placed(opened, args), unit=opened.unit, device=args.device)
    meshing = WATCH.clock()
    if args.level is not None:
        checked_level(args.level, "--level")
        size = float(np.ptp(domain.bounds, axis=0).max()) * (1.0 + MARGIN) / CUBES_OF_LEVEL
        mesh = TetForest.from_domain(domain, size, max_level=args.level, device=args.device)
    else:
        count = TETS if args.tets is None else args.tets
        layers = {} if args.min_layers is None else {"min_layers": args.min_layers}
        try:
            mesh = TetForest.from_domain(domain, target_elements=count, device=args.device, **layers)
        except InputError as error:
            said = count < 1 or "target_elements" in str(error)
            raise InputError(f"{'' if said else f'with --tets {count}, '}{error}") from None
    surface = mesh.surface()
    done = WATCH.clock()
    measured, skin = fidelity(mesh, domain, surface=surface), None
    for doubt in measured.doubts():
        said = doubt.replace("more tetrahedra", f"more tetrahedra (--tets {2 * len(mesh.tets)})")
        warnings.warn(said, stacklevel=2)
    asset, loaded = opened.asset, opened.loaded
    assert loaded is not None
    if isinstance(loaded, LoadedMesh) and args.skin != "marched":
        skin = OwnSurface.of_domain(opened.source, loaded, domain.bounds, offset_of(args))
        if skin is None:
            opened.notes.append("the surface was changed when it was closed: the marched one is drawn")
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


def _scan(opened: InputFile, args: argparse.Namespace, entries: list[LabelMaterial]) -> Domain:
    """The domain of a scan; ``entries`` are filled with the materials of its labels."""
    from warp_corot.domain import Domain

    volume, unit = placed(opened, args), opened.unit
    if args.threshold is None and volume.values.dtype.kind == "f" and (missing := np.isnan(volume.values)).any():
        opened.notes.append(f"{np.count_nonzero(missing)} voxels are not a number and count as outside")
        volume = replace(volume, values=np.where(missing, 0.0, volume.values))
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
        values = np.ravel(volume.values)
        there = np.unique(values[:: max(1, len(values) // LOOKED_AT)])
        fractions, cure = (
            there[there != np.round(there)],
            "give --threshold LOW[:HIGH] for the voxels that make up the body",
        )
        if len(fractions):
            raise InputError(
                f"{volume.source}: has values such as {fractions[0]:g}, as probabilities and intensities do, not "
                f"labels; {cure}"
            )
        if np.isfinite(there).all() and (len(there) > MOST_LABELS or there[0] < 0):
            raise InputError(
                f"{volume.source}: has {len(there)} different values or more, {there[0]:g} to {there[-1]:g}, as "
                f"intensities do, not labels; {cure}, or --labels"
            )
    smoothing = args.smoothing or 0.0
    up = args.up or "Z"
    return Domain.from_labels(volume, labels=numbers, unit=unit, smoothing=smoothing, up_axis=up, device=args.device)


# --- materials by label or region ------------------------------------------------------------------------------------

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


def _entry(part: str, option: str, form: str | None = None) -> LabelMaterial:
    match = _ENTRY.fullmatch(part)
    values = match["values"].split(":") if match else []
    if not match or not 1 <= len(values) <= 3:
        raise InputError(form or f"{option} {part.strip()!r}: it must be {LABEL}, for example liver=3kPa:0.45")
    name = match["name"]
    numbers = tuple(int(number) for number in (match["numbers"] or "").split("+") if number)
    if not numbers and name.isdecimal():
        numbers = (int(name),)
    found: list[Any] = [None, None]
    try:
        found = [in_units(value, unit) for value, unit in zip(values, ("Pa", "", "kg/m^3"), strict=False)] + found
        young, poisson, density = found[:3]
        Isotropic(young, poisson or 0.0, 1.0 if density is None else density)
    except InputError as error:
        said = f"{option} {part.strip()!r}" if form is None else form.split(": it must")[0]
        raise InputError(f"{said}: {error}") from None
    return LabelMaterial(name, numbers, young, poisson, density)


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


def region_entries(
    inside: Callable[[str], np.ndarray], regions: Sequence[Sequence[str]]
) -> list[tuple[np.ndarray, LabelMaterial]]:
    """The tetrahedra, bool [T], and the material of each ``--region``.

    Args:
        inside: Which tetrahedra are in a patch, bool [T].
        regions: Pairs of a patch and ``YOUNG[:POISSON[:DENSITY]]``.

    Raises:
        InputError: Another form, or no tetrahedron in a region.
    """
    found = []
    for expression, text in regions:
        option = f"--region {expression!r} {text!r}"
        entry = _entry(f"region={text}", "--region", f"{option}: it must be PATCH YOUNG[:POISSON[:DENSITY]]")
        found.append((inside(expression), entry))
        if not found[-1][0].any():
            raise InputError(f"--region {expression!r}: there is no tetrahedron in it")
    return found


def mixed_material(base: Isotropic, chosen: Sequence[tuple[np.ndarray, LabelMaterial]], count: int) -> Isotropic:
    """A material with others in some of ``count`` tetrahedra.

    Args:
        base: The material of other tetrahedra, and the source of omitted values.
        chosen: Tetrahedra, bool [T], and their material; the last one that contains a tetrahedron is used.
    """
    values = [np.array(np.broadcast_to(value, count)) for value in (base.young, base.poisson, base.density)]
    for inside, entry in chosen:
        for array, value in zip(values, (entry.young, entry.poisson, entry.density), strict=True):
            if value is not None:
                array[inside] = value
    return Isotropic(*values)
