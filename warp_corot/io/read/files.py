"""The readers for each file format, and the message if none can read a file."""

from __future__ import annotations

import importlib
import importlib.util
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from warp_corot.errors import InputError
from warp_corot.io.files.quiet import bounded, quietly

from .filemesh import FileImage, FileMesh


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


def read_mesh_file(path: Path) -> FileMesh | FileImage:
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
        if isinstance(found, FileImage):
            return found
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
