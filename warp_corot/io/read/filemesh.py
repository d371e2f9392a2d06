"""The content of a file: points, blocks of cells and numbers of regions, or the voxels of a scan; and its readers."""

from __future__ import annotations

import importlib
import importlib.util
import math
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from warp_corot.errors import InputError
from warp_corot.inputs.checks import checked_numbers, checked_vector, shown
from warp_corot.io.files.quiet import bounded, quietly

#: Numbers of corners of cells with volume, by kind.
SOLIDS = {"tetra": 4, "pyramid": 5, "wedge": 6, "hexahedron": 8}
#: Numbers of corners of cells of surfaces, by kind.
FACES = {"triangle": 3, "quad": 4}
CORNERS = {**SOLIDS, **FACES}
#: Arrays with more distinct numbers than this do not define node sets.
MOST_SETS = 32


class Unreadable(Exception):
    """A reader's reason for not reading a file."""


@dataclass(frozen=True)
class Block:
    """Cells of one kind.

    Attributes:
        kind: A key of `SOLIDS` or `FACES`.
        nodes: Their corners in VTK's order, int64 [n, corners].
        data: Numbers of cells by array name, int64 [n].
    """

    kind: str
    nodes: NDArray[np.int64]
    data: dict[str, NDArray[np.int64]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        corners = CORNERS.get(self.kind)
        if corners is not None and self.nodes.shape[1:] != (corners,):
            raise Unreadable(f"its cells of the kind {self.kind} have the shape {list(self.nodes.shape)}")


@dataclass(frozen=True)
class FileMesh:
    """The parts of a file from which bodies and surfaces are made.

    Attributes:
        points: Points in the file's unit, float64 [N, 3].
        blocks: Cells with volume and cells of surfaces; cells of higher order only with their corners.
        names: Meanings of the numbers in an array, by array and number.
        ignored: Number of the file's cells of other kinds (lines, vertices), by kind.
        notes: Notes for the user, one line each.
        node_sets: Named sets of nodes in the file, indices int64 [n].
        metres: Metres in the file's unit; None if the file does not say.
        up_axis: "X", "Y" or "Z"; None if the file does not say.
        objects: Names of parts that share no nodes, and the number of tetrahedra or triangles of each, in order, if the
            arrays of the blocks do not number them.
    """

    points: NDArray[np.float64]
    blocks: list[Block]
    names: dict[str, dict[int, str]] = field(default_factory=dict)
    ignored: dict[str, int] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    node_sets: dict[str, NDArray[np.int64]] = field(default_factory=dict)
    metres: float | None = None
    up_axis: str | None = None
    objects: list[tuple[str, int]] = field(default_factory=list)

    def __post_init__(self) -> None:
        if self.points.ndim != 2 or self.points.shape[1] != 3:
            raise Unreadable(f"its points have the shape {list(self.points.shape)}; it must be [N, 3]")

    @property
    def solids(self) -> list[Block]:
        """The blocks of cells with volume."""
        return [block for block in self.blocks if block.kind in SOLIDS and len(block.nodes)]

    @property
    def faces(self) -> list[Block]:
        """The blocks of triangles and quadrilaterals."""
        return [block for block in self.blocks if block.kind in FACES and len(block.nodes)]

    def kinds(self) -> str:
        """The kinds of cells, for messages."""
        found = {block.kind for block in self.blocks if len(block.nodes)} | {k for k, n in self.ignored.items() if n}
        return ", ".join(sorted(found)) or "none"


@dataclass(frozen=True)
class LoadedVolume:
    """The voxels of a file.

    Attributes:
        values: [nx, ny, nz], with the file's own number type.
        affine: Matrix from voxel indices to positions in ``unit``, float64 [4, 4]; right-anterior-superior if the
            format names directions.
        notes: Notes for the user, one line each.
        unit: "m", "cm", "mm", or None if the file does not say.
        name: Short name for a title.
        source: The file.
    """

    values: NDArray[Any]
    affine: NDArray[np.float64]
    notes: list[str] = field(default_factory=list)
    unit: str | None = None
    name: str = ""
    source: Path = Path()


def joined_meshes(parts: Iterable[tuple[str, FileMesh]], **about: Any) -> FileMesh:
    """Meshes that share no nodes, each with a name, as one file's; ``about`` replaces attributes of it."""
    points, blocks, objects, notes, offset = [np.empty((0, 3))], list[Block](), list[tuple[str, int]](), list[str](), 0
    sets, ignored = dict[str, list[NDArray[np.int64]]](), dict[str, int]()
    for name, mesh in parts:
        points.append(mesh.points)
        blocks += [replace(block, nodes=block.nodes + offset) for block in mesh.blocks]
        objects.append((name, sum(len(block.nodes) for block in mesh.blocks)))
        for known, nodes in mesh.node_sets.items():
            sets.setdefault(known, []).append(nodes + offset)
        for kind, count in mesh.ignored.items():
            ignored[kind] = ignored.get(kind, 0) + count
        notes += mesh.notes
        offset += len(mesh.points)
    of_all = {known: np.concatenate(nodes) for known, nodes in sets.items()}
    found = {"ignored": ignored, "notes": list(dict.fromkeys(notes)), "node_sets": of_all, "objects": objects}
    return FileMesh(np.concatenate(points), blocks, **found | about)


def mesh_of_triangles(points: NDArray[Any], triangles: NDArray[Any]) -> FileMesh:
    """Points [N, 3] and triangles [T, 3] as a file's."""
    block = Block("triangle", np.asarray(triangles, np.int64).reshape(-1, 3))
    return FileMesh(np.asarray(points, np.float64).reshape(-1, 3), [block])


def sets_of_numbers(name: str, values: NDArray[np.int64]) -> dict[str, NDArray[np.int64]]:
    """The node sets that an array of whole numbers, one a node, defines.

    An array of zeros and ones is one set with the array's name. An array with a few distinct numbers is one set for
    each number but zero, ``NAME_NUMBER``. An array of many numbers, for instance one that counts nodes, defines no set.

    Args:
        name: The array's name.
        values: Its numbers.
    """
    numbers = np.unique(values[values != 0])
    if len(numbers) > MOST_SETS:
        return {}
    if numbers.tolist() == [1]:
        return {name: np.flatnonzero(values)}
    return {f"{name}_{number}": np.flatnonzero(values == number) for number in numbers.tolist()}


def corners_note(kind: str, order: int | None = 2) -> str:
    """The note about cells of higher order, of which only the corners are used."""
    word = {2: "second-order", 3: "third-order"}.get(order or 0, "higher-order")
    return f"{word} cells ({kind}) are taken by their corners, with straight edges"


def whole_numbers(values: Any) -> NDArray[np.int64] | None:
    """Values as int64 [n]; None unless they are whole numbers, one a cell."""
    array = np.asarray(values)
    if array.ndim == 2 and array.shape[1] == 1:
        array = array[:, 0]
    if array.ndim != 1:
        return None
    if array.dtype.kind in "iub":
        return array.astype(np.int64)
    if array.dtype.kind == "f" and (np.abs(array) < 2**53).all() and (array == np.round(array)).all():
        return array.astype(np.int64)
    return None


# --- hexahedra, wedges and pyramids split into tetrahedra that fit their neighbours ----------------------------------

#: Faces of each kind of cell by its corners in VTK's order, counter-clockwise seen from outside.
OUTSIDES: dict[str, tuple[tuple[int, ...], ...]] = {
    "pyramid": ((0, 3, 2, 1), (0, 1, 4), (1, 2, 4), (2, 3, 4), (3, 0, 4)),
    "wedge": ((0, 2, 1), (3, 4, 5), (0, 1, 4, 3), (1, 2, 5, 4), (2, 0, 3, 5)),
    "hexahedron": ((0, 3, 2, 1), (4, 5, 6, 7), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7)),
}


def split_solids(
    blocks: Iterable[Block], points: NDArray[np.float64]
) -> tuple[NDArray[np.int64], NDArray[np.int64], int]:
    """The tetrahedra of cells with volume.

    Tetrahedra do not change. The tetrahedra of any other cell have the cell's orientation: positive if its volume is
    positive. Tetrahedra with a repeated corner, from cells with merged corners, are left out.

    Args:
        blocks: Cells with volume, whose corners are all in ``points``.
        points: [N, 3].

    Returns:
        Tetrahedra int64 [T, 4]; the cell that contains each, numbered block after block, int64 [T]; and the number of
        cells so warped that some of their tetrahedra lie outside them.
    """
    tets, cells, first, warped = [np.empty((0, 4), np.int64)], [np.empty(0, np.int64)], 0, 0
    for block in blocks:
        if block.kind == "tetra":
            made, whose = block.nodes, np.arange(len(block.nodes))
        else:
            # Cones from the lowest node over the triangles of the faces without it.
            nodes, outsides = block.nodes, OUTSIDES[block.kind]
            parts = [nodes[:, None, face] if len(face) == 3 else _halves(nodes[:, face]) for face in outsides]
            triangles, lowest = np.concatenate(parts, axis=1), nodes.min(axis=1)
            away = (triangles != lowest[:, None, None]).all(axis=2)
            whose = np.nonzero(away)[0]
            made = np.concatenate([triangles[away], lowest[whose, None]], axis=1)
            made, folded = _wound_alike(made, whose, len(block.nodes), points)
            warped += folded
            whole = (np.diff(np.sort(made, axis=1), axis=1) > 0).all(axis=1)
            made, whose = made[whole], whose[whole]
        tets.append(made)
        cells.append(whose + first)
        first += len(block.nodes)
    return np.concatenate(tets), np.concatenate(cells), warped


def triangles_of(blocks: Iterable[Block]) -> NDArray[np.int64]:
    """The triangles of surface cells, int64 [T, 3]."""
    found = [np.empty((0, 3), np.int64)]
    for block in blocks:
        found.append(block.nodes if block.kind == "triangle" else _halves(block.nodes).reshape(-1, 3))
    return np.concatenate(found)


def _halves(quads: NDArray[np.int64]) -> NDArray[np.int64]:
    """Two triangles for each quadrilateral, with the same orientation, [n, 2, 3]."""
    start = np.argmin(quads, axis=1)
    turned = np.take_along_axis(quads, (start[:, None] + np.arange(4)) % 4, axis=1)
    return turned[:, [[0, 1, 2], [0, 2, 3]]]


def _wound_alike(
    tets: NDArray[np.int64], whose: NDArray[np.int64], count: int, points: NDArray[np.float64]
) -> tuple[NDArray[np.int64], int]:
    """The tetrahedra oriented so that their cells' volumes are positive, and the number of cells with both signs."""
    x = points[tets]
    volumes = np.linalg.det(x[:, 1:] - x[:, :1]) if len(tets) else np.empty(0)
    total = np.bincount(whose, volumes, count)
    size = np.bincount(whose, np.abs(volumes), count)
    turned = (total < 0.0)[whose]
    tets = tets.copy()
    tets[turned] = tets[turned][:, [0, 1, 3, 2]]
    return tets, int(np.count_nonzero(size - np.abs(total) > 1e-6 * size))


# --- readers by format, and the message if none can read a file ------------------------------------------------------


@dataclass(frozen=True)
class Reader:
    """A module of this folder with a function that reads a path.

    Attributes:
        name: Its name in messages.
        module: The module of this folder whose ``read`` it is.
        package: The Python package that it needs, if any.
        extra: The extra that installs this package, as in ``pip install "warp-corot[EXTRA]"``.
    """

    name: str
    module: str
    package: str | None = None
    extra: str | None = None


VTK = Reader("VTK", "vtk_files", "vtkmodules", "mesh")
MESHIO = Reader("meshio", "meshio_files")
ITK = Reader("SimpleITK", "itk_files", "SimpleITK", "scans")
BY_MESHIO = (
    *(".msh", ".mesh", ".meshb", ".bdf", ".nas", ".fem", ".inp", ".node", ".ele", ".vol", ".vol.gz", ".xdmf", ".xmf"),
    *(".e", ".ex2", ".exo", ".med", ".cgns", ".h5m", ".avs", ".su2", ".f3grid", ".mdpa", ".post", ".dato", ".ugrid"),
    *(".tec", ".xml"),
)
#: Readers by extension, starting with the most complete one.
READERS: dict[str, tuple[Reader, ...]] = {
    **dict.fromkeys(BY_MESHIO, (MESHIO,)),
    **dict.fromkeys((".vtk", ".vtu"), (VTK, MESHIO)),
    **dict.fromkeys((".vtp", ".vtm", ".vtmb", ".vts", ".vtr", ".pvtu", ".pvtp", ".vtkhdf"), (VTK,)),
}
#: Readers of scans by extension.
SCANS: dict[str, tuple[Reader, ...]] = {
    **dict.fromkeys((".nii.gz", ".nii", ".mha", ".mhd", ".nrrd", ".nhdr", ".dcm"), (ITK,)),
    ".vti": (VTK,),
}
#: The extensions of all these files.
SUFFIXES = (*READERS, *SCANS)
#: Errors whose texts are no sentences.
WORDLESS = (LookupError, AttributeError, TypeError, StopIteration, AssertionError)
#: Longer reasons are truncated.
LONGEST_REASON = 200


def suffix_of(path: Path) -> str | None:
    """The file's extension if it is that of a mesh file or a scan, else None."""
    name = path.name.lower()
    return next((suffix for suffix in sorted(SUFFIXES, key=len, reverse=True) if name.endswith(suffix)), None)


def read_mesh_file(path: Path) -> FileMesh | LoadedVolume:
    """Read a mesh file, a scan, or a folder with a DICOM series.

    Readers are tried one after the other until one can read the file.

    Args:
        path: A file with one of the extensions `SUFFIXES`, or a folder.

    Returns:
        Points and cells; or the voxels of a scan.

    Raises:
        InputError: No installed reader can read it; one line with the readers' own reasons.
    """
    suffix = "DICOM" if path.is_dir() else suffix_of(path)
    if suffix is None:
        raise InputError(f"{path}: unknown format {path.suffix or '(no extension)'}; it must be {', '.join(SUFFIXES)}")
    reasons, missing = [], []
    for reader in (READERS | SCANS).get(suffix, (ITK,)):
        if reader.package and importlib.util.find_spec(reader.package) is None:
            missing.append(reader)
            continue
        found, reason = read_with(reader.module, path)
        if isinstance(found, LoadedVolume):
            return _checked_volume(found, path)
        if found is not None and len(found.points):
            return checked_mesh(found, path)
        if found is not None:
            reason = "it finds no nodes in it"
        if reason:
            reasons.append(f"{reader.name}: {shortened(reason)}")
    cures = " or ".join(f'pip install "warp-corot[{reader.extra}]"' for reader in missing)
    if not reasons and missing:
        raise InputError(f"{path}: reading {suffix} files needs: {cures}")
    also = f"; {missing[0].name} might read it: {cures}" if missing else ""
    what = "is a folder without a DICOM series" if path.is_dir() else f"is not a {suffix} file"
    raise InputError(f"{path}: {what} that can be read ({'; '.join(reasons)}){also}")


def read_with(module: str, path: Path) -> tuple[Any, str | None]:
    """Let a reader read a file, without output of its library and with memory for no more than the file can need.

    Args:
        module: See `Reader`.
        path: The file.

    Returns:
        The reader's result, or None; and the reason for None, which is None, too, if that is the reader's result.
    """
    try:
        with quietly(), bounded(path):
            return importlib.import_module(f".{module}", __package__).read(path), None
    except MemoryError:
        return None, "it asks for more memory than such a file can need"
    except ModuleNotFoundError as error:
        return None, f"it needs the package {error.name}: pip install {error.name}"
    except (Exception, SystemExit) as error:
        words = "" if isinstance(error, SystemExit) else " ".join(str(error).split())
        return None, words if words and not isinstance(error, WORDLESS) else f"{type(error).__name__} {words}".strip()


def shortened(reason: object) -> str:
    """A reader's reason in one line."""
    words = " ".join(str(reason).split()).rstrip(".")
    return words if len(words) <= LONGEST_REASON else words[: LONGEST_REASON - 4] + " ..."


def checked_mesh(mesh: FileMesh, path: Path) -> FileMesh:
    """The mesh, after a check that its cells only name existing points.

    Raises:
        InputError: A cell or a set names a point that does not exist.
    """
    points = mesh.points
    for name, nodes in mesh.node_sets.items():
        if len(nodes) and not 0 <= nodes.min() <= nodes.max() < len(points):
            raise InputError(f"{path}: the set {name!r} names points that do not exist")
    for block in mesh.blocks:
        bad = np.argwhere((block.nodes < 0) | (block.nodes >= len(points)))
        if len(bad):
            row, column = bad[0]
            cell = "tetrahedron" if block.kind == "tetra" else block.kind
            raise InputError(
                f"{path}: {cell} {row} names point {block.nodes[row, column]} but the points are 0 to {len(points) - 1}"
            )
    return mesh


# --- scans -----------------------------------------------------------------------------------------------------------


def load_volume(path: str | PathLike[str]) -> LoadedVolume:
    """Read a scan: .nii, .nii.gz, .mha, .mhd, .nrrd, .nhdr, .vti, an image in a .vtk, or DICOM: a .dcm
    with several slices, or the largest series in a folder.

    Raises:
        InputError: The file does not exist, has another format, cannot be read, is not three-dimensional, has more than
            one number a voxel, or the library for the format is not installed; one line says which.
    """
    source = Path(path)
    if not source.exists():
        raise InputError(f"{source}: no such file")
    if suffix_of(source) is None and not source.is_dir():
        known = ", ".join(SCANS)
        raise InputError(f"{source}: unknown format {source.suffix or '(no extension)'}; it must be {known}")
    image = read_mesh_file(source)
    if not isinstance(image, LoadedVolume):
        raise InputError(f"{source}: holds a mesh; it must be an image")
    return image


def _checked_volume(image: LoadedVolume, source: Path) -> LoadedVolume:
    """The volume of a file's voxels, with its name.

    Raises:
        InputError: See `load_volume`.
    """
    values = image.values
    while values.ndim > 3 and values.shape[-1] == 1:
        values = values[..., 0]
    if values.ndim != 3:
        raise InputError(f"{source}: has shape {values.shape}; it must be a volume [nx, ny, nz] of single numbers")
    if values.dtype.kind not in "biuf":
        raise InputError(
            f"{source}: has voxels of type {values.dtype}, as colours or vectors do; it must be one number"
        )
    if not values.size:
        raise InputError(f"{source}: has no voxels, its shape is {values.shape}")
    name = source.resolve().name if source.is_dir() else source.name.removesuffix(suffix_of(source) or "")
    return replace(image, values=values, name=name, source=source)


def affine_of(spacing: Any, origin: Any) -> NDArray[np.float64]:
    """The matrix [4, 4] from voxel indices to positions.

    Raises:
        InputError: Spacing is not three positive numbers, or origin is not three finite ones.
    """
    steps = checked_numbers(spacing, "spacing", "[3]")
    if steps.shape != (3,) or not all(math.isfinite(s) and s > 0.0 for s in steps):
        raise InputError(f"spacing is {shown(spacing)}; it must be three positive numbers, one an axis")
    start = np.zeros(3) if origin is None else checked_vector(origin, "origin")
    affine = np.diag([*steps, 1.0])
    affine[:3, 3] = start
    return affine
