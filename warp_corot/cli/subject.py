"""What is simulated when INPUT is named, and defaults for what was not said about it."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..errors import InputError
from ..experiments import paper
from ..io.assets import find_asset
from ..io.formats import load_tets
from ..mesh import TetForest, TetMesh

if TYPE_CHECKING:
    from ..domain import Domain
    from ..mesh.bound import SurfaceMesh
    from .label_materials import LabelMaterial

#: Young's modulus over the weight of a column as high as the body: such bodies sag by roughly a tenth of their height.
STIFFNESS_PER_WEIGHT = 20.0
#: Meshes larger than this [m] are asked whether they are in millimetres.
LARGEST_PLAUSIBLE = 10.0
BOX_LEVEL = 6


@dataclass
class Subject:
    """A mesh and defaults for it.

    Attributes:
        mesh: The mesh, scaled.
        name: For titles.
        source: The file it came from, if one.
        young: Young's modulus [Pa]; None: from the body's weight.
        poisson: Poisson's ratio.
        density: [kg/m^3].
        fix: Expression for the nodes that are held.
        gravity: [m/s^2]; None: down the mesh's up axis.
        damping: [1/s].
        duration: [s].
        domain: What the mesh was made from, if from a surface or a scan.
        surface: The smooth surface of such a mesh.
        labels: Materials of its labels, if they were given.
        times: Seconds that its stages took.
        notes: What the user should know, a line each.
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
    labels: list[LabelMaterial] = field(default_factory=list)
    times: dict[str, float] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)

    @property
    def used(self) -> np.ndarray:
        """Nodes that some tetrahedron names, indices."""
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

    @property
    def held_share(self) -> float:
        """Share of the height that is held by default: round bodies, as organs are, would stand on a point."""
        return 0.02 if self.domain is None else 0.1

    def lowest_part(self) -> str:
        """An expression for the lowest part of the height."""
        up = self.mesh.up_axis.lower()
        return f"{up} <= {up}min + {self.held_share:g} * ({up}max - {up}min)"

    def young_from_weight(self, density: float, gravity: tuple[float, float, float] | None) -> float:
        """Young's modulus [Pa] with which the body sags visibly and stands, to two digits."""
        g = 9.81 if gravity is None else float(np.linalg.norm(gravity)) or 9.81
        return float(f"{STIFFNESS_PER_WEIGHT * density * g * self.height:.1e}")


def find_subject(name: str, scale: float | None) -> Subject:
    """The mesh that INPUT names.

    Args:
        name: "box", "warp:NAME" or a file.
        scale: Factor on its coordinates; None: 1, or the asset's own.

    Raises:
        InputError: No such mesh, or one that cannot be simulated.
    """
    if scale is not None and not (np.isfinite(scale) and scale > 0):
        raise InputError(f"scale is {scale:g}; it must be a positive number")
    if name == "box":
        return _box(1.0 if scale is None else scale)
    asset = find_asset(name)
    factor = scale if scale is not None else asset.scale if asset else 1.0
    loaded = load_tets(name, scale=factor)
    try:
        mesh = TetMesh(loaded.points, loaded.tets, up_axis=loaded.up_axis)
    except InputError as error:
        raise InputError(f"{loaded.source}: {error}") from None
    subject = Subject(mesh, loaded.name, loaded.source)
    if asset:
        subject.poisson, subject.density = asset.poisson, asset.density
        subject.damping, subject.duration = asset.damping, asset.duration
        if factor == asset.scale:
            subject.young, subject.fix = asset.young, asset.fix
    size = float(np.ptp(subject.bounds, axis=0).max())
    if size > LARGEST_PLAUSIBLE:
        subject.notes.append(f"the mesh is {size:.3g} m long; if its coordinates are in mm, add --scale 0.001")
    return subject


def _box(scale: float) -> Subject:
    mesh = TetForest.box(paper.CELLS, paper.CELL_SIZE * scale, BOX_LEVEL)
    return Subject(
        mesh,
        "box",
        young=paper.MATERIAL["young"],
        poisson=paper.MATERIAL["poisson"],
        density=paper.MATERIAL["density"],
        fix="z <= zmin",
        gravity=paper.GRAVITY,
        damping=paper.Settings.damping,
        duration=paper.SHORT_DURATION,
    )
