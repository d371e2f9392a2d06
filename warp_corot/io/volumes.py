"""Scans: volumes of voxels from NIfTI (nibabel), MetaImage and NRRD (SimpleITK) and VTK image files."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError

#: ITK's directions are left-posterior-superior; turned half round z they are NIfTI's right-anterior-superior.
RAS_FROM_LPS = np.diag([-1.0, -1.0, 1.0, 1.0])


@dataclass(frozen=True)
class LoadedVolume:
    """A volume as it came from a file.

    Attributes:
        values: [nx, ny, nz], of the file's own number type.
        affine: From voxel indices to positions in ``unit``, float64 [4, 4]; right-anterior-superior where the format
            names directions.
        unit: "m", "cm", "mm", or None if the file does not say.
        name: Short name, fit for a title.
        source: The file it was read from.
        notes: What the user should know, a line each.
    """

    values: NDArray[Any]
    affine: NDArray[np.float64]
    unit: str | None
    name: str
    source: Path
    notes: list[str] = field(default_factory=list)


def load_volume(path: str | PathLike[str]) -> LoadedVolume:
    """Reads a scan: .nii, .nii.gz, .mha, .mhd, .nrrd or .vti.

    Raises:
        InputError: No such file, another format, not readable, not three-dimensional, more than one number a voxel, or
            the library that reads the format is not installed; one line that says which.
    """
    source = Path(path)
    if source.is_dir():
        raise InputError(f"{source}: is a folder, should be a volume file")
    if not source.exists():
        raise InputError(f"{source}: no such file")
    suffix = next((known for known in READERS if source.name.lower().endswith(known)), None)
    if suffix is None:
        raise InputError(
            f"{source}: unknown format {source.suffix or '(no extension)'}, should be {', '.join(READERS)}"
        )
    try:
        values, affine, unit, notes = READERS[suffix](source)
    except ImportError:
        extra = "vti" if suffix == ".vti" else "scans"
        raise InputError(f'{source}: reading {suffix} files needs: pip install "warp-corot[{extra}]"') from None
    while values.ndim > 3 and values.shape[-1] == 1:
        values = values[..., 0]
    if values.ndim != 3:
        raise InputError(f"{source}: has shape {values.shape}, should be a volume [nx, ny, nz] of single numbers")
    return LoadedVolume(values, affine, unit, source.name[: -len(suffix)], source, notes)


def _read_nifti(path: Path) -> tuple[NDArray[Any], NDArray[np.float64], str | None, list[str]]:
    import nibabel

    try:
        image: Any = nibabel.load(path)
        values = np.asanyarray(image.dataobj)
    except Exception as error:
        raise _unreadable(path, "NIfTI", error) from None
    unit = {"meter": "m", "mm": "mm"}.get(image.header.get_xyzt_units()[0])
    spacing = np.asarray(image.header.get_zooms(), dtype=np.float64)[:3]
    affine = np.array(image.affine, dtype=np.float64)
    # The format's fallback for a header without spacing is the unit matrix.
    if not (spacing > 0.0).all():
        affine[:3, :3] = 0.0
    notes = []
    if not image.header["sform_code"] and not image.header["qform_code"]:
        notes.append("the header gives no orientation: its axes are taken as right, anterior, superior")
    if image.header.get_xyzt_units()[0] == "micron":
        affine[:3], unit = 1e-3 * affine[:3], "mm"
    return values, affine, unit, notes


def _read_itk(path: Path) -> tuple[NDArray[Any], NDArray[np.float64], str | None, list[str]]:
    import SimpleITK

    loud = SimpleITK.ProcessObject.GetGlobalWarningDisplay()
    SimpleITK.ProcessObject.SetGlobalWarningDisplay(False)
    try:
        image = SimpleITK.ReadImage(str(path))
    except Exception as error:
        raise _unreadable(path, path.suffix, error) from None
    finally:
        SimpleITK.ProcessObject.SetGlobalWarningDisplay(loud)
    dimensions, numbers = image.GetDimension(), image.GetNumberOfComponentsPerPixel()
    if (dimensions, numbers) != (3, 1):
        raise InputError(f"{path}: has {dimensions} dimensions and {numbers} numbers a voxel, should have 3 and 1")
    affine = np.eye(4)
    affine[:3, :3] = np.array(image.GetDirection()).reshape(3, 3) * image.GetSpacing()
    affine[:3, 3] = image.GetOrigin()
    notes = ["positions are turned from left-posterior-superior to right-anterior-superior"]
    return SimpleITK.GetArrayFromImage(image).transpose(2, 1, 0), RAS_FROM_LPS @ affine, None, notes


def _read_vti(path: Path) -> tuple[NDArray[Any], NDArray[np.float64], str | None, list[str]]:
    from vtkmodules.util.numpy_support import vtk_to_numpy
    from vtkmodules.vtkCommonCore import vtkObject
    from vtkmodules.vtkCommonMisc import vtkErrorCode
    from vtkmodules.vtkIOXML import vtkXMLImageDataReader

    loud = vtkObject.GetGlobalWarningDisplay()
    vtkObject.GlobalWarningDisplayOff()
    try:
        reader = vtkXMLImageDataReader()
        reader.SetFileName(str(path))
        readable = bool(reader.CanReadFile(str(path)))
        if readable:
            reader.Update()
    finally:
        vtkObject.SetGlobalWarningDisplay(loud)
    if not readable or reader.GetErrorCode():
        raise _unreadable(path, ".vti", vtkErrorCode.GetStringFromErrorCode(reader.GetErrorCode()))
    grid = reader.GetOutput()
    extent = np.array(grid.GetExtent()).reshape(3, 2)
    at_points = grid.GetPointData().GetNumberOfArrays() > 0
    data = grid.GetPointData() if at_points else grid.GetCellData()
    array = data.GetScalars()
    if array is None and data.GetNumberOfArrays() == 1:
        array = data.GetArray(0)
    shape = extent[:, 1] - extent[:, 0] + (1 if at_points else 0)
    if array is None or array.GetNumberOfTuples() != np.prod(shape):
        names = ", ".join(str(data.GetArrayName(k)) for k in range(data.GetNumberOfArrays())) or "none"
        raise _unreadable(path, ".vti", f"no whole array of scalars chosen; its arrays: {names}")
    if array.GetNumberOfComponents() != 1:
        raise InputError(f"{path}: has {array.GetNumberOfComponents()} numbers a voxel, should be one")
    # Copies: VTK's memory goes with its reader.
    values = np.array(vtk_to_numpy(array).reshape(tuple(shape), order="F"), order="F")
    matrix = grid.GetIndexToPhysicalMatrix()
    affine = np.array([[matrix.GetElement(i, j) for j in range(4)] for i in range(4)])
    first = extent[:, 0] + (0.0 if at_points else 0.5)
    affine[:3, 3] += affine[:3, :3] @ first
    notes = [] if at_points else ["the numbers are those of cells: voxel centres lie between the grid's points"]
    return values, affine, None, notes


def _unreadable(path: Path, kind: str, why: object) -> InputError:
    words = " ".join(str(why).split())
    return InputError(f"{path}: is not a {kind} file that can be read{f' ({words[:160]})' if words else ''}")


#: What reads which extension.
READERS: dict[str, Callable[[Path], tuple[NDArray[Any], NDArray[np.float64], str | None, list[str]]]] = {
    ".nii.gz": _read_nifti,
    ".nii": _read_nifti,
    ".mha": _read_itk,
    ".mhd": _read_itk,
    ".nrrd": _read_itk,
    ".vti": _read_vti,
}


def affine_of(spacing: Any, origin: Any) -> NDArray[np.float64]:
    """The matrix [4, 4] from voxel indices to positions.

    Raises:
        InputError: Spacing that is not three positive numbers, origin that is not three finite ones.
    """
    steps = np.asarray(spacing, dtype=np.float64)
    if steps.shape != (3,) or not all(math.isfinite(s) and s > 0.0 for s in steps):
        raise InputError(f"spacing is {spacing!r}; it must be three positive numbers, one an axis")
    start = np.zeros(3) if origin is None else np.asarray(origin, dtype=np.float64)
    if start.shape != (3,) or not np.isfinite(start).all():
        raise InputError(f"origin is {origin!r}; it must be three finite numbers")
    affine = np.diag([*steps, 1.0])
    affine[:3, 3] = start
    return affine
