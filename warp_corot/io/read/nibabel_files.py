"""Formats of nibabel: NIfTI, and FreeSurfer's MGH."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import nibabel
import numpy as np

from .filemesh import FileImage


def read(path: Path) -> FileImage:
    """The voxels of an image. Errors are nibabel's own."""
    image: Any = nibabel.load(path)
    values, affine = np.asanyarray(image.dataobj), np.array(image.affine, dtype=np.float64)
    if path.suffix.lower() in (".mgz", ".mgh"):
        return FileImage(values, affine, [], "mm")  # by definition of FreeSurfer's format
    header = image.header
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
    return FileImage(values, affine, notes, {"meter": "m", "mm": "mm"}.get(said))
