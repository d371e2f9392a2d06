"""The mesh of an input, and defaults for options that were not given."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from warp_corot.body.places import named_nodes
from warp_corot.errors import InputError
from warp_corot.io.read.tetrahedra import LoadedMesh
from warp_corot.mesh import TetForest, TetMesh

from .input_file import InputFile, offset_of, placed
from .label_materials import of_regions, parse_labels
from .multibody import merged_nodes
from .options.defaults import BOX_LEVEL, STIFFNESS_PER_WEIGHT

if TYPE_CHECKING:
    from warp_corot.domain import Domain
    from warp_corot.domain.fidelity import Fidelity
    from warp_corot.io.read.assets import Asset
    from warp_corot.io.write.skins import OwnSurface
    from warp_corot.mesh.surfaces.bound import SurfaceMesh

    from .label_materials import LabelMaterial

#: The box, the beam of Tagawa et al. 2013: its cubes, and their edge [m].
CELLS, CELL_SIZE = (1, 1, 3), 0.064


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

    def young_from_weight(self, density: float, gravity: tuple[float, float, float] | None) -> float:
        """Young's modulus [Pa] with which the body sags visibly and stands, to two digits."""
        g = 9.81 if gravity is None else float(np.linalg.norm(gravity)) or 9.81
        return float(f"{STIFFNESS_PER_WEIGHT * density * g * self.height:.1e}")

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
        return _box(1.0 if args.scale is None else args.scale, level, offset_of(args))
    loaded: LoadedMesh = placed(opened, args)
    points, tets = loaded.points, loaded.tets
    sets = {name: np.isin(np.arange(len(points)), nodes) for name, nodes in loaded.node_sets.items()}
    if args.join:
        points, tets, sets = _joined(loaded, sets, opened.notes)
    entries, found = parse_labels(args.materials, "--materials") if args.materials else [], loaded.regions
    try:
        if entries and found is None:
            raise InputError("its arrays number no regions, so that --materials has no effect")
        names, entries = of_regions(entries, found) if found is not None else ((), entries)
        labels = None if found is None else found.of_tet
        mesh = TetMesh(points, tets, up_axis=loaded.up_axis, labels=labels, label_names=names, node_sets=sets)
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


def _joined(
    loaded: LoadedMesh, sets: dict[str, np.ndarray], notes: list[str]
) -> tuple[np.ndarray, np.ndarray, dict[str, np.ndarray]]:
    """Points, tetrahedra and node sets, with coincident nodes merged.

    Raises:
        InputError: There are no coincident nodes.
    """
    points, tets, place = merged_nodes(loaded.points, loaded.tets)
    merged = len(place) - len(points)
    if not merged and not loaded.objects:
        raise InputError(f"{loaded.source}: no two nodes coincide, so that --join has no effect")
    if merged:
        notes.append(f"{merged} nodes coincide with others and are merged")
    return points, tets, {name: np.bincount(place, mask, len(points)) > 0 for name, mask in sets.items()}


def _listed(names: Sequence[str]) -> str:
    return ", ".join(names[:12]) + (", ..." if len(names) > 12 else "")


def _box(scale: float, level: int, offset: np.ndarray) -> InputMesh:
    x, y, z = offset.tolist()
    return box_subject(TetForest.box(CELLS, CELL_SIZE * scale, level, origin=(x, y, z)))


def box_subject(mesh: TetForest) -> InputMesh:
    """A box with its defaults."""
    return InputMesh(
        mesh,
        "box",
        young=500.0,
        poisson=0.49,
        density=10.0,
        fix="z <= zmin",
        gravity=(0.0, -9.8, 0.0),
        damping=15.0,
        duration=4.0,
    )
