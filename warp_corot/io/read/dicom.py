"""DICOM series: a folder of slices, or a file with all of them, by SimpleITK."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from warp_corot.errors import InputError

#: Folders below the one that is named that are looked into at most.
MOST_FOLDERS = 1000
DESCRIPTION, MODALITY, UNEVEN = "0008|103e", "0008|0060", "ITK_non_uniform_sampling_deviation"


def read_series(folder: Path) -> tuple[Any, list[str]]:
    """The largest series in a folder and the folders below it.

    Returns:
        An image of SimpleITK's, and notes for the user.

    Raises:
        InputError: There is none, or SimpleITK cannot read it.
    """
    import SimpleITK

    loud = SimpleITK.ProcessObject.GetGlobalWarningDisplay()
    SimpleITK.ProcessObject.SetGlobalWarningDisplay(False)
    try:
        series = _all_series(SimpleITK, folder)
        if not series:
            raise InputError(f"{folder}: is a folder without a DICOM series, should be a file or such a folder")
        files = max(series, key=len)
        reader = SimpleITK.ImageSeriesReader()
        reader.SetFileNames(files)
        image = reader.Execute()
        notes = [f"{len(files)} slices{_described(SimpleITK, files[0])}"]
    except RuntimeError as error:
        words = " ".join(str(error).split())
        raise InputError(f"{folder}: is not a DICOM series that can be read ({words[-160:]})") from None
    finally:
        SimpleITK.ProcessObject.SetGlobalWarningDisplay(loud)
    if len(series) > 1:
        notes.append(f"the largest of {len(series)} series in {folder} is taken; for another name its own folder")
    if image.HasMetaDataKey(UNEVEN):
        notes.append(f"slices are missing or unevenly spaced, by up to {float(image.GetMetaData(UNEVEN)):.3g} mm")
    return image, notes


def _all_series(library: Any, folder: Path) -> list[tuple[str, ...]]:
    found = []
    for count, (below, _, files) in enumerate(os.walk(folder)):
        if count >= MOST_FOLDERS:
            break
        if not files:
            continue
        for name in library.ImageSeriesReader.GetGDCMSeriesIDs(below):
            found.append(library.ImageSeriesReader.GetGDCMSeriesFileNames(below, name))
    return [files for files in found if len(files)]


def _described(library: Any, file: str) -> str:
    reader = library.ImageFileReader()
    reader.SetFileName(file)
    reader.ReadImageInformation()
    words = [reader.GetMetaData(key).strip() for key in (MODALITY, DESCRIPTION) if reader.HasMetaDataKey(key)]
    return f" ({', '.join(filter(None, words))})" if any(words) else ""


def array_of(image: Any) -> NDArray[Any]:
    """The image's values [nx, ny, nz]."""
    import SimpleITK

    return np.asarray(SimpleITK.GetArrayFromImage(image)).transpose(2, 1, 0)
