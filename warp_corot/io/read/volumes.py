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
from warp_corot.io.files.isolated import read_isolated
from warp_corot.io.files.quiet import bounded, quietly

from .filemesh import from_bytes


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
        values, affine, unit, notes = _read_dicom(source) if source.is_dir() else READERS[suffix or ""](source)
    except ImportError:
        extra = "mesh" if suffix in (".vti", ".vtk") else "scans"
        what = f"{suffix} files" if suffix and not source.is_dir() else "DICOM series"
        raise InputError(f'{source}: reading {what} needs: pip install "warp-corot[{extra}]"') from None
    name = source.name[: len(source.name) - len(suffix or "")] if not source.is_dir() else source.resolve().name
    return _checked(values, affine, unit, notes, name, source)


def volume_of_image(path: Path, arrays: dict[str, NDArray[Any]]) -> LoadedVolume:
    """The volume of an image in a VTK file.

    Raises:
        InputError: See `load_volume`.
    """
    values, affine, unit, notes = _of_image(arrays)
    return _checked(values, affine, unit, notes, path.stem, path)


def _checked(
    values: NDArray[Any], affine: NDArray[np.float64], unit: str | None, notes: list[str], name: str, source: Path
) -> LoadedVolume:
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
    return LoadedVolume(values, affine, unit, name, source, notes)


def _read_nifti(path: Path) -> tuple[NDArray[Any], NDArray[np.float64], str | None, list[str]]:
    import nibabel

    try:
        with quietly(), bounded(path):
            image: Any = nibabel.load(path)
            values = np.asanyarray(image.dataobj)
    except Exception as error:
        raise _unreadable(path, "NIfTI", error) from None
    said = _nifti_unit(image.header)
    unit = {"meter": "m", "mm": "mm"}.get(said)
    spacing = np.asarray(image.header.get_zooms(), dtype=np.float64)[:3]
    affine = np.array(image.affine, dtype=np.float64)
    # For a header without spacing, the format prescribes the unit matrix.
    if not (spacing > 0.0).all():
        affine[:3, :3] = 0.0
    notes = []
    if not image.header["sform_code"] and not image.header["qform_code"]:
        notes.append("the header gives no orientation: its axes are taken as right, anterior, superior")
    if said == "micron":
        affine[:3], unit = 1e-3 * affine[:3], "mm"
    return values, affine, unit, notes


def _nifti_unit(header: Any) -> str:
    try:
        return header.get_xyzt_units()[0]
    except KeyError:  # a number that the format does not define
        return "unknown"


def _read_mgh(path: Path) -> tuple[NDArray[Any], NDArray[np.float64], str | None, list[str]]:
    import nibabel

    try:
        with quietly(), bounded(path):
            image: Any = nibabel.load(path)
            values = np.asanyarray(image.dataobj)
    except Exception as error:
        raise _unreadable(path, path.suffix, error) from None
    # FreeSurfer's format is in mm by definition.
    return values, np.array(image.affine, dtype=np.float64), "mm", []


def _read_itk(path: Path) -> tuple[NDArray[Any], NDArray[np.float64], str | None, list[str]]:
    return _of_image(_isolated("SimpleITK", "itk_files", path, path.suffix))


def _read_dicom(path: Path) -> tuple[NDArray[Any], NDArray[np.float64], str | None, list[str]]:
    values, affine, _, notes = _of_image(_isolated("SimpleITK", "itk_files", path, "DICOM"))
    if path.is_file() and values.shape[2] < 2:
        raise InputError(f"{path}: has a single slice; name the folder with the whole series")
    return values, affine, "mm", notes


def _read_vti(path: Path) -> tuple[NDArray[Any], NDArray[np.float64], str | None, list[str]]:
    return _of_image(_isolated("vtkmodules", "vtk_files", path, path.suffix))


def _isolated(package: str, module: str, path: Path, kind: str) -> dict[str, NDArray[Any]]:
    """The arrays of an image, from a reader that needs a package and runs in a separate process."""
    if importlib.util.find_spec(package) is None:
        raise ImportError(package)
    arrays, reason = read_isolated(f"warp_corot.io.read.{module}", path)
    if arrays is None and reason is None:
        raise InputError(f"{path}: is a folder without a DICOM series; it must be a file or a folder with one")
    if arrays is None or "image" not in arrays:
        raise _unreadable(path, kind, reason or "it holds a mesh, not an image")
    return arrays


def _of_image(
    arrays: dict[str, NDArray[Any]],
) -> tuple[NDArray[Any], NDArray[np.float64], str | None, list[str]]:
    return arrays["values"], arrays["affine"], None, from_bytes(arrays["image"])


def _unreadable(path: Path, kind: str, why: object) -> InputError:
    words = " ".join(str(why).split())
    return InputError(f"{path}: is not a {kind} file that can be read{f' ({words[:160]})' if words else ''}")


#: The reader of each extension.
READERS: dict[str, Callable[[Path], tuple[NDArray[Any], NDArray[np.float64], str | None, list[str]]]] = {
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
