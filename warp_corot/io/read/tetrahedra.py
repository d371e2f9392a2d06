"""Tetrahedral meshes from files: USD and the formats of ``warp_corot.io.read``."""

import logging
import os
from dataclasses import dataclass, field, replace
from os import PathLike
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from warp_corot.errors import InputError
from warp_corot.inputs.checks import checked_number, checked_path

from .assets import find_asset
from .filemesh import FileMesh
from .files import read_mesh_file, suffix_of
from .regions import Regions, find_regions
from .split import split_solids

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
        found: The result of `read_mesh_file`, if the file was read before.

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
    is_stage = source.suffix.lower() in USD_SUFFIXES
    loaded = _of_stage(source, regions) if is_stage else _of_file(source, regions, found)
    points, tets, metres = loaded.points, loaded.tets, loaded.metres_per_unit
    if len(tets) == 0:
        raise InputError(f"{source}: has no tetrahedra")
    if tets.min() < 0 or tets.max() >= len(points):
        row, column = np.argwhere((tets < 0) | (tets >= len(points)))[0]
        raise InputError(
            f"{source}: tetrahedron {row} names point {tets[row, column]} but the points are 0 to {len(points) - 1}"
        )
    from warp_corot.domain.units import metres_per_unit  # late: domains read files

    points = points * (scale if unit is None else scale * metres_per_unit(unit) / metres)
    check_finite(points, source)
    for note in loaded.notes:
        usual = found is not None or note.endswith(SPLIT)
        log.log(logging.INFO if usual else logging.WARNING, "%s: %s", source, note)
    return replace(loaded, points=points, name=asset.name if asset else loaded.name)


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


def unknown_format(source: Path) -> InputError:
    """The error for an extension that no reader takes."""
    return InputError(
        f"{source}: unknown format {source.suffix or '(no extension)'}; it must be {', '.join(USD_SUFFIXES)}, "
        f"{', '.join(USUAL)}, another mesh file, a surface such as .stl or a scan such as .nii.gz"
    )


def _of_stage(path: Path, regions: str | None) -> LoadedMesh:
    from warp_corot.io.read.usd.tetrahedra import read_usd_tets

    read = read_usd_tets(path)
    if regions is not None:
        raise InputError(f"{path}: there is no array {regions!r} that numbers regions; USD stages have none")
    objects = read.prims if len(read.prims) > 1 else []
    return LoadedMesh(
        read.points,
        read.tets,
        read.up_axis,
        read.metres,
        _short_name(path),
        path,
        says_unit=True,
        node_sets=read.node_sets,
        objects=objects,
    )


def _short_name(path: Path) -> str:
    # UTF-8 in every locale; characters that cannot be shown become question marks.
    return os.fsencode(path.stem).decode("utf-8", "replace")


def _of_file(path: Path, regions: str | None, found: FileMesh | None) -> LoadedMesh:
    if path.suffix.lower() in SURFACE_SUFFIXES:
        raise InputError(f"{path}: is not a mesh of tetrahedra but a surface, which Domain.from_surface reads")
    if suffix_of(path) is None:
        raise unknown_format(path)
    mesh = read_mesh_file(path) if found is None else found
    if not isinstance(mesh, FileMesh):
        raise InputError(f"{path}: has no tetrahedra (it holds an image)")
    if not mesh.solids:
        raise InputError(f"{path}: has no tetrahedra (cell types: {mesh.kinds()})")
    check_finite(mesh.points, path)
    tets, cells, warped = split_solids(mesh.solids, mesh.points)
    notes = list(mesh.notes)
    others = {block.kind: 0 for block in mesh.solids if block.kind != "tetra"}
    for block in mesh.solids:
        if block.kind in others:
            others[block.kind] += len(block.nodes)
    if others:
        plurals = {"hexahedron": "hexahedra", "wedge": "wedges", "pyramid": "pyramids"}
        said = ", ".join(f"{count} {kind if count == 1 else plurals[kind]}" for kind, count in others.items())
        notes.append(f"{said} {'are' if sum(others.values()) > 1 else 'is'} {SPLIT}")
    if warped:
        notes.append(f"{warped} cells are so warped that their tetrahedra overlap or leave gaps")
    try:
        numbered = find_regions(mesh, cells, regions)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    return LoadedMesh(
        mesh.points,
        tets.astype(np.int32),
        "Z",
        1.0,
        _short_name(path),
        path,
        numbered,
        notes=notes,
        node_sets=mesh.node_sets,
        objects=_objects(mesh, cells),
    )


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
