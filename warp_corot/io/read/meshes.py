"""Meshes of tetrahedra and surfaces of triangles from files: USD, mesh files, what trimesh reads, and Warp's assets."""

from __future__ import annotations

import importlib.util
import logging
import os
from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from warp_corot.errors import InputError
from warp_corot.inputs.checks import checked_number, checked_path
from warp_corot.io.files.quiet import bounded, quietly

from .filemesh import (
    FileMesh,
    LoadedVolume,
    checked_mesh,
    joined_meshes,
    mesh_of_triangles,
    read_mesh_file,
    split_solids,
    suffix_of,
    triangles_of,
)

# --- meshes in Warp's wheel, each with a suitable scale and material -------------------------------------------------


@dataclass(frozen=True)
class Asset:
    """A mesh with default values.

    Attributes:
        name: Short name, after ``warp:``.
        file: Path below Warp's package folder.
        young: Young's modulus [Pa].
        duration: Simulated time [s] after which it is nearly at rest.
        note: Explanation of the values.
        scale: Factor on the file's coordinates.
        poisson: Poisson's ratio.
        density: Mass density [kg/m³].
        fix_below: Nodes below this height are fixed: the scaled rest coordinate along y [m].
        damping: Mass-proportional damping [1/s].
    """

    name: str
    file: str
    young: float
    duration: float
    note: str
    scale: float = 0.1
    poisson: float = 0.45
    density: float = 1000.0
    fix_below: float = 0.01
    damping: float = 2.0

    @property
    def path(self) -> Path:
        """The path of the file.

        Raises:
            InputError: Warp is not installed, or lacks its examples.
        """
        spec = importlib.util.find_spec("warp")
        for folder in (spec and spec.submodule_search_locations) or ():
            if (candidate := Path(folder, self.file)).is_file():
                return candidate
        raise InputError(f"warp:{self.name}: {self.file} is not in the installed Warp package")


BUNNY = "the Stanford bunny, 16 cm long, of silicone gel"
BEAR = """a toy bear of 55 cm of soft silicone rubber: its back sags by 9 % of its height, its nose by 14 %, after \
some seconds of swaying"""
ASSETS = {
    "bunny": Asset("bunny", "examples/assets/bunny.usd", 3.0e4, 4.0, BUNNY),
    "bear": Asset("bear", "examples/assets/bear.usd", 1.0e5, 5.0, BEAR),
}


def find_asset(name: str | PathLike[str]) -> Asset | None:
    """The asset with the name ``warp:NAME``, or None for a name without ``warp:``.

    Raises:
        InputError: There is no such asset.
    """
    prefix, colon, rest = str(name).partition(":")
    if prefix != "warp" or not colon:
        return None
    if rest not in ASSETS:
        known = ", ".join(f"warp:{known}" for known in ASSETS)
        raise InputError(f"warp:{rest}: no such asset; it must be {known}")
    return ASSETS[rest]


# --- meshes of tetrahedra and of triangles ---------------------------------------------------------------------------

USD_SUFFIXES = (".usd", ".usda", ".usdc", ".usdz")
#: The mesh formats that messages name.
USUAL = (".msh", ".vtk", ".vtu", ".inp", ".mesh", ".node")
#: End of the note about split cells.
SPLIT = "split into tetrahedra"
#: Arrays that number the parts of a file that share no nodes.
OBJECTS = ("block", "instance")

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class LoadedMesh:
    """Tetrahedra or triangles from a file.

    Attributes:
        points: float64 [N, 3]: of tetrahedra [m], of a surface in the file's unit; an asset has a likely size then.
        cells: Tetrahedra [T, 4] or triangles [T, 3], int32, with the orientation in the file.
        metres: Length of the file's unit [m]; None if the file does not say.
        up_axis: "X", "Y" or "Z"; if the file does not say, None for a surface, and for tetrahedra "Z", the convention
            of the mesh generators that write them.
        name: Short name for a title.
        source: The file.
        notes: Notes for the user, one line each.
        objects: Names of the file's objects (parts that share no nodes: prims, blocks), and the number of cells of
            each, in order; empty if it has no parts.
        regions: Its regions, if the file numbers any.
        node_sets: Named sets of nodes in the file, indices int64 [n].
    """

    points: NDArray[np.float64]
    cells: NDArray[np.int32]
    metres: float | None
    up_axis: str | None
    name: str
    source: Path
    notes: list[str] = field(default_factory=list)
    objects: list[tuple[str, int]] = field(default_factory=list)
    regions: Regions | None = None
    node_sets: dict[str, NDArray[np.int64]] = field(default_factory=dict)

    @property
    def is_surface(self) -> bool:
        """Whether it has triangles."""
        return self.cells.shape[1] == 3


def _opened(
    path: str | PathLike[str], kind: str, found: FileMesh | None
) -> tuple[FileMesh, Path, str, float, list[str]]:
    """What a file holds, if its points are finite; the file, its short name, and an asset's scale and note."""
    asset = find_asset(path)
    source = asset.path if asset else checked_path(path, "path")
    check_file(source, kind)
    mesh = read_file(source, kind) if found is None else found
    if not isinstance(mesh, FileMesh):
        raise InputError(f"{source}: has no {'triangles' if kind == 'surface' else 'tetrahedra'} (it holds an image)")
    check_finite(mesh.points, source)
    if asset is None:
        # UTF-8 in every locale; characters that cannot be shown become question marks.
        return mesh, source, os.fsencode(source.stem).decode("utf-8", "replace"), 1.0, []
    return mesh, source, asset.name, asset.scale, [f"scaled by {asset.scale:g}: {asset.note}"]


def load_tets(
    path: str | PathLike[str],
    scale: float = 1.0,
    *,
    unit: str | float | None = None,
    regions: str | None = None,
    found: FileMesh | None = None,
) -> LoadedMesh:
    """Load the tetrahedra of a file, in metres.

    OpenUSD reads USD stages (unit, up axis and world transforms applied, several prims joined); VTK or meshio read
    other files. Hexahedra, wedges and pyramids are split into tetrahedra that fit those of their neighbours; cells of
    higher order become linear ones on their corners. ``warp:NAME`` names an asset in Warp's wheel, see `Asset`.

    Args:
        path: File, or asset name.
        scale: Factor on all coordinates, after the unit.
        unit: Unit of the coordinates, any length such as "mm" or "3.2cm", or metres as a number. None: the file's unit,
            or metres if it has none.
        regions: Name of the file's array of region numbers; None: the likeliest.
        found: The result of `read_file`, if the file was read before.

    Returns:
        The mesh. Elements are not checked here (orientation, volume): `TetMesh` does that.

    Raises:
        InputError: The file does not exist, is not a mesh, has no tetrahedra, coordinates that are not finite or
            indices out of range, the scale is not positive, or there is no such array or unit; one line says which.
    """
    if not 0.0 < checked_number(scale, "scale") < np.inf:
        raise InputError(f"scale is {scale}; it must be a positive number")
    mesh, source, name, _, _ = _opened(path, "mesh", found)
    if not mesh.solids:
        is_stage = source.suffix.lower() in USD_SUFFIXES
        kinds = "no TetMesh prim and no Mesh prim with tetraIndices" if is_stage else f"cell types: {mesh.kinds()}"
        raise InputError(f"{source}: has no tetrahedra ({kinds})")
    from warp_corot.domain.units import metres_per_unit  # late: domains read files

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
    about = (mesh.up_axis or "Z", name, source, notes, mesh.objects or _objects(mesh, cells), numbered, mesh.node_sets)
    return LoadedMesh(points, tets.astype(np.int32), mesh.metres, *about)


def load_surface(path: str | PathLike[str], *, found: FileMesh | None = None) -> LoadedMesh:
    """Read all triangles of a file, placed by its scene; polygons are cut into fans.

    Args:
        path: A file, or ``warp:NAME`` for one in Warp's wheel.
        found: The result of `read_file`, if the file was read before.

    Raises:
        InputError: The file does not exist, has another format, cannot be read, or has no triangles; one line says
            which.
    """
    mesh, source, title, scale, scaled = _opened(path, "surface", found)
    if mesh.solids:
        raise InputError(f"{source}: has cells with volume, which TetMesh.load reads; it must have only triangles")
    blocks = sorted(mesh.faces, key=lambda block: int(block.data.get("block", np.zeros(1))[0]))
    triangles = triangles_of(blocks)
    if not len(triangles):
        raise InputError(f"{source}: has no triangles")
    used, renumbered = np.unique(triangles, return_inverse=True)
    objects: dict[str, int] = {}
    for number, name in mesh.names.get("block", {}).items():
        own = [block for block in blocks if number in block.data.get("block", ())]
        if own:
            objects[name if name not in objects else f"{name} {number}"] = len(triangles_of(own))
    about = (mesh.up_axis, title, source, [*mesh.notes, *scaled], mesh.objects or list(objects.items()))
    cells = renumbered.reshape(-1, 3).astype(np.int32)
    return LoadedMesh(mesh.points[used] * scale, cells, mesh.metres, *about)


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


# --- surfaces: through trimesh, of USD stages, and of mesh files -----------------------------------------------------

#: Formats read with trimesh, and the usual up axis if the format names none; glTF's is in its standard.
UP_AXES = {".obj": "Y", ".stl": "Z", ".ply": "Z", ".off": "Z", ".glb": "Y", ".gltf": "Y"}
GLTF = (".glb", ".gltf")


def read_file(path: Path, kind: str = "") -> FileMesh | LoadedVolume:
    """What a file holds: cells with volume, or else triangles, or the voxels of a VTK file with an image.

    Args:
        path: The file.
        kind: "mesh": of a USD stage, its tetrahedra. "surface": of a USD stage, the triangles of its Mesh prims. "":
            what there is.

    Raises:
        InputError: Another format, or it cannot be read.
    """
    suffix = path.suffix.lower()
    if suffix in USD_SUFFIXES:
        from warp_corot.io.read.usd.meshes import read_usd_surface, read_usd_tets

        tets = None if kind == "surface" else read_usd_tets(path)
        return tets if tets and (tets.solids or kind == "mesh") else checked_mesh(read_usd_surface(path), path)
    if suffix in UP_AXES:
        if kind == "mesh":
            raise InputError(f"{path}: is not a mesh of tetrahedra but a surface, which Domain.from_surface reads")
        about = {"metres": 1.0, "up_axis": UP_AXES[suffix]} if suffix in GLTF else {}
        placed = [(node, mesh.copy().apply_transform(matrix)) for mesh, matrix, node, _ in placed_meshes(path)]
        parts = [(node, mesh_of_triangles(mesh.vertices, mesh.faces)) for node, mesh in placed]
        return checked_mesh(joined_meshes(parts, **about), path)
    if suffix_of(path) is None and not path.is_dir():
        known = ", ".join((*UP_AXES, *USD_SUFFIXES))
        if kind != "surface":
            usual = ", ".join((*USD_SUFFIXES, *USUAL))
            known = f"{usual}, another mesh file, a surface such as .stl or a scan such as .nii.gz"
        raise InputError(f"{path}: unknown format {path.suffix or '(no extension)'}; it must be {known}")
    return read_mesh_file(path)


def placed_meshes(path: Path, **options: Any) -> list[tuple[Any, NDArray[Any], str, str]]:
    """The meshes of a file that trimesh reads, each with its place in the scene [4, 4], the name of its node there, and
    its own; those of its first mesh come first.

    Args:
        path: The file.
        options: More arguments of trimesh's ``load_scene``.

    Raises:
        InputError: trimesh cannot read it.
    """
    import trimesh

    try:
        options |= {"split_objects": True} if path.suffix.lower() == ".obj" else {}
        with quietly(), bounded(path):
            scene = trimesh.load_scene(path, process=False, **options)
        order = list(scene.geometry)
        found = [(*scene.graph.get(node), str(node)) for node in scene.graph.nodes_geometry]
        found.sort(key=lambda each: (order.index(each[1]), each[2]))
        placed = [(scene.geometry[name], np.asarray(matrix), node, name) for matrix, name, node in found]
        return [each for each in placed if isinstance(each[0], trimesh.Trimesh)]
    except Exception as error:
        why = " ".join(str(error).split())[:120]
        raise InputError(f"{path}: is not a {path.suffix} file that trimesh can read triangles from ({why})") from None


# --- the array that numbers a file's regions, and their names --------------------------------------------------------

#: Usual names of arrays of region numbers, likeliest first; other arrays qualify if they have few distinct numbers.
LIKELY = ("physical group", "material", "element set", "region", "label", "tissue", "attribute", "part", "block")
#: Arrays with more distinct numbers do not number regions.
MOST = 1000


@dataclass(frozen=True)
class Regions:
    """Regions of tetrahedra.

    Attributes:
        array: The file's array of region numbers.
        names: Their names.
        numbers: Their numbers in the file.
        of_tet: Each tetrahedron's region, its index in ``names`` plus one, 0 for none, int32 [T].
    """

    array: str
    names: tuple[str, ...]
    numbers: tuple[int, ...]
    of_tet: NDArray[np.int32]


def find_regions(mesh: FileMesh, cells: NDArray[np.int64], wanted: str | None = None) -> Regions | None:
    """The regions of the tetrahedra of a file.

    Args:
        mesh: The content of the file.
        cells: The cell of each tetrahedron, int64 [T], see `split_solids`.
        wanted: The array to use; None: the likeliest that distinguishes cells or gives them a name.

    Returns:
        The regions; None if no array numbers any.

    Raises:
        InputError: The requested array does not exist; the message lists the arrays.
    """
    known = dict.fromkeys(name for block in mesh.solids for name in block.data)
    if wanted is not None and wanted not in known:
        raise InputError(f"there is no array {wanted!r} of whole numbers; there are: {', '.join(known) or 'none'}")
    likely = {name: [place for place, usual in enumerate(LIKELY) if usual in name.lower()] for name in known}
    ordered = sorted(known, key=lambda name: (min(likely[name], default=len(LIKELY)), name.lower()))
    for name in ordered if wanted is None else [wanted]:
        values = np.concatenate([block.data.get(name, np.zeros(len(block.nodes), np.int64)) for block in mesh.solids])
        there, said = np.unique(values), mesh.names.get(name, {})
        # Zero without a name means none: a cell of no physical group or set.
        numbers = [number for number in there.tolist() if number != 0 or number in said]
        if wanted is None and not (1 <= len(numbers) <= MOST and (len(np.unique(values[cells])) > 1 or said)):
            continue
        names: list[str] = []
        for number in numbers:
            own = said.get(number, str(number))
            names.append(own if own not in names else f"{own} ({number})")
        place = np.zeros(len(there), np.int32)
        place[np.searchsorted(there, numbers)] = np.arange(1, len(numbers) + 1)
        return Regions(name, tuple(names), tuple(numbers), place[np.searchsorted(there, values[cells])])
    return None
