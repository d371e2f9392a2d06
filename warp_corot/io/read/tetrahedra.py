"""Tetrahedral meshes from files: USD and the formats of ``warp_corot.io.read``."""

import logging
import os
from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from warp_corot.errors import InputError
from warp_corot.inputs.checks import checked_number, checked_path

from .assets import find_asset
from .filemesh import FileImage, FileMesh, split_solids
from .files import read_mesh_file, suffix_of
from .regions import Regions, find_regions

USD_SUFFIXES = (".usd", ".usda", ".usdc", ".usdz")
#: Formats that only hold surfaces, see `warp_corot.io.read.surfaces`.
SURFACE_SUFFIXES = (".obj", ".stl", ".ply", ".off", ".glb", ".gltf")
#: The mesh formats that messages name.
USUAL = (".msh", ".vtk", ".vtu", ".inp", ".mesh", ".node")
#: End of the note about split cells.
SPLIT = "split into tetrahedra"
#: Arrays that number the parts of a file that share no nodes.
OBJECTS = ("block", "instance")

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class LoadedMesh:
    """A tetrahedral mesh from a file.

    Attributes:
        points: Rest positions, float64 [N, 3] [m].
        tets: Vertex indices, int32 [T, 4]; orientation as in the file.
        up_axis: "X", "Y" or "Z"; for formats without one, "Z", the convention of the mesh generators that write them.
        metres_per_unit: Length of the file's unit [m], before ``scale``.
        name: Short name for a title.
        source: The file.
        regions: Its regions, if the file numbers any.
        says_unit: Whether the file says its unit.
        notes: Notes for the user, one line each.
        node_sets: Named sets of nodes in the file, indices int64 [n].
        objects: Names of the file's parts that share no nodes (prims, blocks, instances), and the number of tetrahedra
            of each, in order; empty if the file has no parts.
    """

    points: NDArray[np.float64]
    tets: NDArray[np.int32]
    up_axis: str
    metres_per_unit: float
    name: str
    source: Path
    regions: Regions | None = None
    says_unit: bool = False
    notes: list[str] = field(default_factory=list)
    node_sets: dict[str, NDArray[np.int64]] = field(default_factory=dict)
    objects: list[tuple[str, int]] = field(default_factory=list)


def load_tets(
    path: str | PathLike[str],
    scale: float = 1.0,
    *,
    unit: str | float | None = None,
    regions: str | None = None,
    found: FileMesh | None = None,
) -> LoadedMesh:
    """Load the tetrahedra of a file, in metres.

    OpenUSD reads USD stages (unit, up axis and world transforms applied, several prims joined); VTK, Gmsh, meshio or
    readers of this package read other files, see `warp_corot.io.read`. Hexahedra, wedges and pyramids are
    split into tetrahedra that fit those of their neighbours; cells of higher order become linear ones on their corners.
    ``warp:NAME`` names an asset in Warp's wheel, see `warp_corot.io.read.assets`.

    Args:
        path: File, or asset name.
        scale: Factor on all coordinates, after the unit.
        unit: Unit of the coordinates, any length such as "mm" or "3.2cm", or metres as a number. None: the file's unit,
            or metres if it has none.
        regions: Name of the file's array of region numbers; None: the likeliest.
        found: The result of `read_tetrahedra`, if the file was read before.

    Returns:
        The mesh. Elements are not checked here (orientation, volume): `TetMesh` does that.

    Raises:
        InputError: The file does not exist, is not a mesh, has no tetrahedra, coordinates that are not finite or
            indices out of range, the scale is not positive, or there is no such array or unit; one line says which.
    """
    if not 0.0 < checked_number(scale, "scale") < np.inf:
        raise InputError(f"scale is {scale}; it must be a positive number")
    asset = find_asset(path)
    source = asset.path if asset else checked_path(path, "path")
    check_file(source, "mesh")
    mesh = read_tetrahedra(source) if found is None else found
    if not isinstance(mesh, FileMesh):
        raise InputError(f"{source}: has no tetrahedra (it holds an image)")
    if not mesh.solids:
        is_stage = source.suffix.lower() in USD_SUFFIXES
        kinds = "no TetMesh prim and no Mesh prim with tetraIndices" if is_stage else f"cell types: {mesh.kinds()}"
        raise InputError(f"{source}: has no tetrahedra ({kinds})")
    from warp_corot.domain.units import metres_per_unit  # late: domains read files

    check_finite(mesh.points, source)
    metres = 1.0 if mesh.metres is None else mesh.metres
    points = mesh.points * (scale * (metres if unit is None else metres_per_unit(unit)))
    check_finite(points, source)
    tets, cells, warped = split_solids(mesh.solids, mesh.points)
    if not len(tets):
        raise InputError(f"{source}: has no tetrahedra")
    notes = list(mesh.notes)
    others: dict[str, int] = {}
    for block in mesh.solids:
        if block.kind != "tetra":
            others[block.kind] = others.get(block.kind, 0) + len(block.nodes)
    if others:
        plurals = {"hexahedron": "hexahedra", "wedge": "wedges", "pyramid": "pyramids"}
        said = ", ".join(f"{count} {kind if count == 1 else plurals[kind]}" for kind, count in others.items())
        notes.append(f"{said} {'are' if sum(others.values()) > 1 else 'is'} {SPLIT}")
    if warped:
        notes.append(f"{warped} cells are so warped that their tetrahedra overlap or leave gaps")
    for note in notes:
        usual = found is not None or note.endswith(SPLIT)
        log.log(logging.INFO if usual else logging.WARNING, "%s: %s", source, note)
    try:
        numbered = find_regions(mesh, cells, regions)
    except InputError as error:
        raise InputError(f"{source}: {error}") from None
    return LoadedMesh(
        points,
        tets.astype(np.int32),
        mesh.up_axis or "Z",
        metres,
        asset.name if asset else short_name(source),
        source,
        numbered,
        mesh.metres is not None,
        notes,
        mesh.node_sets,
        mesh.objects or _objects(mesh, cells),
    )


def read_tetrahedra(path: Path) -> FileMesh | FileImage:
    """The content of a mesh file; of a USD stage, its tetrahedra.

    Raises:
        InputError: Another format, or it cannot be read.
    """
    suffix = path.suffix.lower()
    if suffix in USD_SUFFIXES:
        from warp_corot.io.read.usd.meshes import read_usd_tets

        return read_usd_tets(path)
    if suffix in SURFACE_SUFFIXES:
        raise InputError(f"{path}: is not a mesh of tetrahedra but a surface, which Domain.from_surface reads")
    if suffix_of(path) is None and not path.is_dir():
        raise InputError(
            f"{path}: unknown format {path.suffix or '(no extension)'}; it must be {', '.join(USD_SUFFIXES)}, "
            f"{', '.join(USUAL)}, another mesh file, a surface such as .stl or a scan such as .nii.gz"
        )
    return read_mesh_file(path)


def short_name(path: Path) -> str:
    """The name of a file for a title: UTF-8 in every locale; characters that cannot be shown become question marks."""
    return os.fsencode(path.stem).decode("utf-8", "replace")


def check_file(source: Path, kind: str) -> None:
    """Check that a file exists and is not empty.

    Args:
        source: The file.
        kind: The expected kind of file, for the message.

    Raises:
        InputError: A folder, no such file, an empty one, or one that cannot be read.
    """
    if source.is_dir():
        raise InputError(f"{source}: is a folder; it must be a {kind} file")
    if not source.exists():
        raise InputError(f"{source}: no such file")
    try:
        with source.open("rb") as file:
            if not file.read(1):
                raise InputError(f"{source}: is empty")
    except OSError as error:
        raise InputError(f"{source}: cannot be read ({error.strerror})") from None


def check_finite(points: NDArray[np.float64], source: Path) -> None:
    """Check that all coordinates are finite.

    Raises:
        InputError: A point's coordinates are not finite; the message names the first such point.
    """
    finite = np.isfinite(points).all(axis=1)
    if not finite.all():
        bad = int(np.argmin(finite))
        raise InputError(f"{source}: point {bad} has coordinates {points[bad].tolist()}; they must be finite")


def _objects(mesh: FileMesh, cells: NDArray[np.int64]) -> list[tuple[str, int]]:
    """The blocks or instances of a file, with the number of tetrahedra of each; empty unless there are several."""
    for array in OBJECTS:
        if mesh.names.get(array) and all(array in block.data for block in mesh.solids):
            of_tet = np.concatenate([block.data[array] for block in mesh.solids])[cells]
            # Readers give the cells part by part.
            starts = np.flatnonzero(np.diff(of_tet, prepend=of_tet[:1] - 1))
            numbers = of_tet[starts].tolist()
            if len(numbers) == len(set(numbers)) > 1:
                counts = np.diff([*starts, len(of_tet)]).tolist()
                return [(mesh.names[array][number], count) for number, count in zip(numbers, counts, strict=True)]
    return []
