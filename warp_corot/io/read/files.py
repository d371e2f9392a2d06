"""The readers for each file format, and the message if none can read a file."""

from __future__ import annotations

import importlib.util
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from warp_corot.errors import InputError
from warp_corot.io.files.isolated import read_isolated

from .filemesh import FileImage, FileMesh


@dataclass(frozen=True)
class Reader:
    """A module of this folder with a function ``read(path)``.

    Attributes:
        name: Its name in messages.
        module: The module's name in this folder.
        package: The Python package that it needs, if any.
        extra: The extra that installs this package, as in ``pip install "warp-corot[EXTRA]"``.
    """

    name: str
    module: str
    package: str | None = None
    extra: str | None = None


VTK = Reader("VTK", "vtk_files", "vtkmodules", "mesh")
GMSH = Reader("Gmsh", "gmsh_files", "gmsh", "gmsh")
MESHIO = Reader("meshio", "meshio_files", "meshio", "mesh")
ABAQUS = Reader("the reader of Abaqus input files", "abaqus")
NETGEN = Reader("the reader of NetGen's files", "netgen")
TETGEN = Reader("the reader of TetGen's files", "tetgen")

#: Readers by extension, starting with the most complete one.
READERS: dict[str, tuple[Reader, ...]] = {
    ".msh": (GMSH, MESHIO),
    ".mesh": (GMSH, MESHIO),
    ".meshb": (GMSH, MESHIO),
    ".unv": (GMSH,),
    ".bdf": (GMSH, MESHIO),
    ".nas": (GMSH, MESHIO),
    ".fem": (MESHIO,),
    ".vtk": (VTK, MESHIO),
    ".vtu": (VTK, MESHIO),
    ".vtp": (VTK,),
    ".vtm": (VTK,),
    ".vtmb": (VTK,),
    ".vts": (VTK,),
    ".vtr": (VTK,),
    ".pvtu": (VTK,),
    ".pvtp": (VTK,),
    ".vtkhdf": (VTK,),
    ".inp": (ABAQUS,),
    ".node": (TETGEN,),
    ".ele": (TETGEN,),
    ".vol": (NETGEN,),
    ".vol.gz": (NETGEN,),
    ".xdmf": (MESHIO,),
    ".xmf": (MESHIO,),
    ".e": (MESHIO,),
    ".ex2": (MESHIO,),
    ".exo": (MESHIO,),
    ".med": (MESHIO,),
    ".cgns": (MESHIO,),
    ".h5m": (MESHIO,),
    ".avs": (MESHIO,),
    ".su2": (MESHIO,),
    ".f3grid": (MESHIO,),
    ".mdpa": (MESHIO,),
    ".post": (MESHIO,),
    ".dato": (MESHIO,),
    ".ugrid": (MESHIO,),
    ".tec": (MESHIO,),
    ".xml": (MESHIO,),
}
#: The extensions of mesh files.
SUFFIXES = tuple(READERS)
#: Longer reasons are truncated.
LONGEST_REASON = 200


def suffix_of(path: Path) -> str | None:
    """The file's extension if it is that of a mesh file, else None."""
    name = path.name.lower()
    return next((suffix for suffix in sorted(SUFFIXES, key=len, reverse=True) if name.endswith(suffix)), None)


def read_mesh_file(path: Path) -> FileMesh | FileImage:
    """Read a mesh file.

    Readers are tried one after the other, each in a separate process, until one can read the file.

    Args:
        path: A file with one of the extensions `SUFFIXES`.

    Returns:
        Points and cells; or the voxels of a VTK file with an image.

    Raises:
        InputError: No installed reader can read it; one line with the readers' own reasons.
    """
    suffix = suffix_of(path)
    if suffix is None:
        raise InputError(f"{path}: unknown format {path.suffix or '(no extension)'}; it must be {', '.join(SUFFIXES)}")
    reasons, missing = [], []
    for reader in READERS[suffix]:
        if reader.package and importlib.util.find_spec(reader.package) is None:
            missing.append(reader)
            continue
        found, reason = read_isolated(f"{__package__}.{reader.module}", path)
        if isinstance(found, FileImage):
            return found
        if found is not None and len(found.points):
            return _checked(found, path)
        if found is not None:
            reason = "it finds no nodes in it"
        if reason:
            reasons.append(f"{reader.name}: {shortened(reason)}")
    cures = " or ".join(f'pip install "warp-corot[{reader.extra}]"' for reader in missing)
    if not reasons and missing:
        raise InputError(f"{path}: reading {suffix} files needs: {cures}")
    also = f"; {missing[0].name} might read it: {cures}" if missing else ""
    raise InputError(f"{path}: is not a {suffix} file that can be read ({'; '.join(reasons)}){also}")


def shortened(reason: object) -> str:
    """A reader's reason in one line."""
    words = " ".join(str(reason).split()).rstrip(".")
    return words if len(words) <= LONGEST_REASON else words[: LONGEST_REASON - 4] + " ..."


def _checked(mesh: FileMesh, path: Path) -> FileMesh:
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
