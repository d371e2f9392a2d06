"""Scans: volumes of voxels from NIfTI and MGH (nibabel), MetaImage, NRRD and DICOM (SimpleITK) and VTK image files."""

from __future__ import annotations

import importlib.util
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from warp_corot.errors import InputError
from warp_corot.inputs.checks import checked_numbers, checked_vector, shown
from warp_corot.io.files.quiet import bounded, quietly

from .filemesh import FileImage
from .files import read_with


@dataclass(frozen=True)
class LoadedVolume:
    """A volume from a file.

    Attributes:
        values: [nx, ny, nz], with the file's own number type.
        affine: Matrix from voxel indices to positions in ``unit``, float64 [4, 4]; right-anterior-superior if the
            format names directions.
        unit: "m", "cm", "mm", or None if the file does not say.
        name: Short name for a title.
        source: The file.
        notes: Notes for the user, one line each.
    """

    values: NDArray[Any]
    affine: NDArray[np.float64]
    unit: str | None
    name: str
    source: Path
    notes: list[str] = field(default_factory=list)


def is_volume(path: Path) -> bool:
    """Whether a file is a scan, by its extension."""
    return any(path.name.lower().endswith(suffix) for suffix in READERS)


def load_volume(path: str | PathLike[str]) -> LoadedVolume:
    """Read a scan: .nii, .nii.gz, .mgz, .mgh, .mha, .mhd, .nrrd, .nhdr, .vti, an image in a .vtk, or DICOM: a .dcm
    with several slices, or the largest series in a folder.

    Raises:
        InputError: The file does not exist, has another format, cannot be read, is not three-dimensional, has more than
            one number a voxel, or the library for the format is not installed; one line says which.
    """
    source = Path(path)
    if not source.exists():
        raise InputError(f"{source}: no such file")
    suffix = next((known for known in READERS if source.name.lower().endswith(known)), None)
    if suffix is None and not source.is_dir():
        raise InputError(
            f"{source}: unknown format {source.suffix or '(no extension)'}; it must be {', '.join(READERS)}"
        )
    try:
        image, unit = _read_dicom(source) if source.is_dir() else READERS[suffix or ""](source)
    except ImportError:
        extra = "mesh" if suffix in (".vti", ".vtk") else "scans"
        what = f"{suffix} files" if suffix and not source.is_dir() else "DICOM series"
        raise InputError(f'{source}: reading {what} needs: pip install "warp-corot[{extra}]"') from None
    name = source.name[: len(source.name) - len(suffix or "")] if not source.is_dir() else source.resolve().name
    return volume_of_image(source, image, unit, name)


def volume_of_image(source: Path, image: FileImage, unit: str | None = None, name: str | None = None) -> LoadedVolume:
    """The volume of a file's voxels.

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
    return LoadedVolume(values, image.affine, unit, source.stem if name is None else name, source, image.notes)


def _read_nifti(path: Path) -> tuple[FileImage, str | None]:
    values, affine, header = _through_nibabel(path, "NIfTI")
    try:
        said = header.get_xyzt_units()[0]
    except KeyError:  # a number that the format does not define
        said = "unknown"
    # For a header without spacing, the format prescribes the unit matrix.
    if not (np.asarray(header.get_zooms(), dtype=np.float64)[:3] > 0.0).all():
        affine[:3, :3] = 0.0
    notes = []
    if not header["sform_code"] and not header["qform_code"]:
        notes.append("the header gives no orientation: its axes are taken as right, anterior, superior")
    if said == "micron":
        affine[:3], said = 1e-3 * affine[:3], "mm"
    return FileImage(values, affine, notes), {"meter": "m", "mm": "mm"}.get(said)


def _read_mgh(path: Path) -> tuple[FileImage, str | None]:
    values, affine, _ = _through_nibabel(path, path.suffix)
    return FileImage(values, affine, []), "mm"  # by definition of FreeSurfer's format


def _through_nibabel(path: Path, kind: str) -> tuple[NDArray[Any], NDArray[np.float64], Any]:
    """Values, affine and header."""
    import nibabel

    try:
        with quietly(), bounded(path):
            image: Any = nibabel.load(path)
            values = np.asanyarray(image.dataobj)
    except Exception as error:
        raise _unreadable(path, kind, error) from None
    return values, np.array(image.affine, dtype=np.float64), image.header


def _read_itk(path: Path) -> tuple[FileImage, str | None]:
    return _from_library("SimpleITK", "itk_files", path, path.suffix), None


def _read_dicom(path: Path) -> tuple[FileImage, str | None]:
    image = _from_library("SimpleITK", "itk_files", path, "DICOM")
    if path.is_file() and image.values.shape[2] < 2:
        raise InputError(f"{path}: has a single slice; name the folder with the whole series")
    return image, "mm"


def _read_vti(path: Path) -> tuple[FileImage, str | None]:
    return _from_library("vtkmodules", "vtk_files", path, path.suffix), None


def _from_library(package: str, module: str, path: Path, kind: str) -> FileImage:
    """An image from a reader that needs a package."""
    if importlib.util.find_spec(package) is None:
        raise ImportError(package)
    image, reason = read_with(module, path)
    if image is None and reason is None:
        raise InputError(f"{path}: is a folder without a DICOM series; it must be a file or a folder with one")
    if not isinstance(image, FileImage):
        raise _unreadable(path, kind, reason or "it holds a mesh, not an image")
    return image


def _unreadable(path: Path, kind: str, why: object) -> InputError:
    words = " ".join(str(why).split())
    return InputError(f"{path}: is not a {kind} file that can be read{f' ({words[:160]})' if words else ''}")


#: The reader of each extension, which returns the voxels, and their unit if the file says it.
READERS: dict[str, Callable[[Path], tuple[FileImage, str | None]]] = {
    ".nii.gz": _read_nifti,
    ".nii": _read_nifti,
    ".mgz": _read_mgh,
    ".mgh": _read_mgh,
    ".mha": _read_itk,
    ".mhd": _read_itk,
    ".nrrd": _read_itk,
    ".nhdr": _read_itk,
    ".dcm": _read_dicom,
    ".vti": _read_vti,
}


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
