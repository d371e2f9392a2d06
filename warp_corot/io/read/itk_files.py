"""Formats of SimpleITK: NIfTI, MetaImage, NRRD, single DICOM files, and folders with DICOM series."""

from __future__ import annotations

import itertools
import os
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import SimpleITK

from .filemesh import LoadedVolume, Unreadable

#: ITK uses left-posterior-superior; half a turn about z gives NIfTI's right-anterior-superior.
RAS_FROM_LPS = np.diag([-1.0, -1.0, 1.0, 1.0])
TURNED = "positions are turned from left-posterior-superior to right-anterior-superior"
#: Maximum depth of subfolders that are searched.
MOST_FOLDERS = 1000
#: Slices are unevenly spaced if distances differ by more than this fraction of the usual distance [1].
UNEVEN = 1.0e-3
DESCRIPTION, MODALITY, POSITION = "0008|103e", "0008|0060", "0020|0032"


def read(path: Path) -> LoadedVolume:
    """The voxels of an image; for a folder, those of the largest series in it and its subfolders.

    Raises:
        Unreadable: With ITK's own message; the image does not have three dimensions and one number a voxel; or there is
            no series, or one slice only.
    """
    try:
        if path.is_dir():
            return _series(path)
        image = _voxels(SimpleITK.ReadImage(str(path)), [])
    except RuntimeError as error:
        # ITK names itself and its source files first; the reason comes last.
        raise Unreadable(re.split(r"(?:sitk::|ITK )ERROR:", str(error))[-1]) from None
    if path.name.lower().endswith((".nii", ".nii.gz")):
        # ITK converts lengths to mm; the header names the unit and the orientation.
        header = _header(str(path))
        unit, *codes = (int(header.GetMetaData(key)) for key in ("xyzt_units", "qform_code", "sform_code"))
        image = replace(image, unit="mm" if unit & 7 in (1, 2, 3) else None, notes=[])
        if any(codes):
            return image
        note = "the header gives no orientation: its axes are taken as right, anterior, superior"
        return replace(image, affine=np.diag([*header.GetSpacing()[:3], 1.0]), notes=[note])
    if path.suffix.lower() != ".dcm":
        return image
    if image.values.shape[2] < 2:
        raise Unreadable("it has a single slice; name the folder with the whole series")
    return replace(image, unit="mm")


def _voxels(image: Any, notes: list[str]) -> LoadedVolume:
    while image.GetDimension() > 3 and image.GetSize()[-1] == 1:
        image = image[..., 0]
    dimensions, numbers = image.GetDimension(), image.GetNumberOfComponentsPerPixel()
    if (dimensions, numbers) != (3, 1):
        raise Unreadable(f"it has {dimensions} dimensions and {numbers} numbers a voxel; it must have 3 and 1")
    affine = np.eye(4)
    affine[:3, :3] = np.array(image.GetDirection()).reshape(3, 3) * image.GetSpacing()
    affine[:3, 3] = image.GetOrigin()
    values = np.asarray(SimpleITK.GetArrayFromImage(image)).transpose(2, 1, 0)
    return LoadedVolume(values, RAS_FROM_LPS @ affine, [*notes, TURNED])


def _series(folder: Path) -> LoadedVolume:
    series: list[tuple[str, ...]] = []
    for below, _, names in itertools.islice(os.walk(folder), MOST_FOLDERS):
        if any(_may_be_slice(Path(below) / name) for name in names):
            made = SimpleITK.ImageSeriesReader
            series += [made.GetGDCMSeriesFileNames(below, number) for number in made.GetGDCMSeriesIDs(below)]
    series = [files for files in series if len(files)]
    if not series:
        raise Unreadable("it has none; name a file, or a folder with one")
    files = max(series, key=len)
    reader = SimpleITK.ImageSeriesReader()
    reader.SetFileNames(files)
    image = reader.Execute()
    header = _header(files[0])
    words = [header.GetMetaData(key).strip() for key in (MODALITY, DESCRIPTION) if header.HasMetaDataKey(key)]
    notes = [f"{len(files)} slices" + (f" ({', '.join(filter(None, words))})" if any(words) else "")]
    if len(series) > 1:
        notes.append(f"the largest of {len(series)} series in {folder} is used; for another, name its own folder")
    uneven = _unevenness(files)
    if uneven is not None:
        notes.append(f"slices are missing or unevenly spaced, by up to {uneven:.3g} mm")
    return replace(_voxels(image, notes), unit="mm")


def _may_be_slice(path: Path) -> bool:
    """Whether a file may be DICOM, by its mark or its extension. GDCM is slow for other files."""
    if path.suffix.lower() in ("", ".dcm", ".dicom", ".ima") or path.suffix[1:].isdecimal():
        return True
    try:
        with path.open("rb") as file:
            return file.read(132)[128:] == b"DICM"
    except OSError:
        return False


def _header(file: str) -> Any:
    reader = SimpleITK.ImageFileReader()
    reader.SetFileName(file)
    reader.ReadImageInformation()
    return reader


def _unevenness(files: tuple[str, ...]) -> float | None:
    """How much the distances of neighbouring slices differ from the usual one [mm]; None if they do not, or if the
    files give no positions."""
    places = []
    for header in map(_header, files):
        if not header.HasMetaDataKey(POSITION):
            return None
        places.append(header.GetOrigin())
    steps = np.linalg.norm(np.diff(np.array(places), axis=0), axis=1)
    if len(steps) < 2:
        return None
    off = float(np.abs(steps - np.median(steps)).max())
    return off if off > UNEVEN * np.median(steps) else None
