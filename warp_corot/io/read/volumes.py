"""Scans: volumes of voxels from NIfTI, MetaImage, NRRD and DICOM (SimpleITK) and VTK image files."""

from __future__ import annotations

import math
from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from warp_corot.errors import InputError
from warp_corot.inputs.checks import checked_numbers, checked_vector, shown

from .filemesh import SCANS, LoadedVolume, read_mesh_file, suffix_of


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
    return volume_of_image(source, image)


def volume_of_image(source: Path, image: LoadedVolume) -> LoadedVolume:
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
