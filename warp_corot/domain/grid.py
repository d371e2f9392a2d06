"""The user's voxels, placed in metres and with numbered labels; probabilities become labels."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from os import PathLike
from typing import Any

import numpy as np
import numpy.typing as npt

from warp_corot.errors import InputError
from warp_corot.inputs.checks import checked_number, checked_numbers, shown
from warp_corot.io.read.filemesh import LoadedVolume, affine_of, load_volume

from .units import metres_per_unit

#: A file, the result of ``load_volume``, or an array.
Volume = str | PathLike[str] | LoadedVolume | npt.ArrayLike

#: Voxel axes whose directions' inner products are below this are at right angles.
SQUARE = 1.0e-4
#: Labels are kept in 16 bits.
MOST_LABELS = 2**15 - 1


@dataclass
class Grid:
    """Voxels in space: values, their affine in metres, and notes for the report."""

    values: np.ndarray
    affine: np.ndarray
    metres: float
    unit: str | float
    notes: list[str] = field(default_factory=list)


def placed_grid(scan: Volume, spacing: Any, origin: Any, affine: Any, unit: str | float | None) -> Grid:
    """A volume with its place in metres.

    Raises:
        InputError: See `Domain.from_labels`.
    """
    notes: list[str] = []
    if affine is not None and (spacing is not None or origin is not None):
        raise InputError("affine is given with spacing or origin; it must be given alone, since it contains both")
    if isinstance(scan, str | PathLike | LoadedVolume):
        loaded = scan if isinstance(scan, LoadedVolume) else load_volume(scan)
        values, given, notes, source = loaded.values, loaded.affine, list(loaded.notes), f"{loaded.source}: "
        if loaded.unit is None and unit is None:
            raise InputError(f"{source}the file names no unit of length; give unit='mm', 'cm' or 'm'")
        if unit is None or unit == loaded.unit:
            notes.append(f"unit {loaded.unit}, as the file says")
        elif loaded.unit is not None:
            notes.append(f"unit {unit} as asked for, though the file says {loaded.unit}")
        unit = (loaded.unit or "m") if unit is None else unit
        given = _replaced(given, spacing, origin)
    else:
        values, source, unit = _checked_values(scan), "", "m" if unit is None else unit
        if spacing is None and affine is None:
            raise InputError("the volume has no spacing; give spacing=(dx, dy, dz), the distance of its voxel centres")
        given = np.eye(4) if spacing is None else affine_of(spacing, origin)
    if affine is not None:
        given = checked_numbers(affine, "affine", "[4, 4]")
    if not notes or not notes[-1].startswith("unit"):
        notes.append(f"unit {unit}")
    metres = metres_per_unit(unit)
    if values.ndim != 3 or min(values.shape) == 0:
        raise InputError(f"{source}the volume has shape {values.shape}; it must be [nx, ny, nz] and not empty")
    return Grid(values, _checked_affine(given, source, notes, metres), metres, unit, notes)


def _checked_values(scan: Any) -> np.ndarray:
    try:
        return np.asarray(scan)
    except ValueError:
        raise InputError("the volume has rows of different lengths; it must be [nx, ny, nz]") from None


def _replaced(affine: np.ndarray, spacing: Any, origin: Any) -> np.ndarray:
    """A file's affine with another spacing and origin; its directions stay."""
    affine = affine.copy()
    if spacing is not None:
        wanted = affine_of(spacing, origin)[:3, :3]
        lengths = np.linalg.norm(affine[:3, :3], axis=0)
        directions = affine[:3, :3] / lengths if (lengths > 0.0).all() else np.eye(3)
        affine[:3, :3] = directions @ wanted
    if origin is not None:
        affine[:3, 3] = affine_of(np.ones(3), origin)[:3, 3]
    return affine


def _checked_affine(affine: np.ndarray, source: str, notes: list[str], metres: float) -> np.ndarray:
    """The affine in metres; shears are noted."""
    if affine.shape != (4, 4) or not np.isfinite(affine).all() or not np.array_equal(affine[3], [0, 0, 0, 1]):
        raise InputError(f"{source}the affine is {affine.tolist()}; it must be [4, 4], finite, its last row 0 0 0 1")
    spacing = np.linalg.norm(affine[:3, :3], axis=0)
    if not (spacing > 0.0).all():
        raise InputError(f"{source}the volume has no spacing ({spacing.tolist()}); give spacing=(dx, dy, dz)")
    directions = affine[:3, :3] / spacing
    if abs(np.linalg.det(directions)) < 1e-3:
        raise InputError(f"{source}the affine's axes lie in a plane; it must be invertible")
    skew = np.abs(directions.T @ directions - np.eye(3)).max()
    if skew > SQUARE:
        notes.append(f"the voxel axes are not at right angles (cosine {skew:.2g}): phi is a distance only nearly")
    return np.diag([metres, metres, metres, 1.0]) @ affine


def numbered_labels(
    values: np.ndarray, labels: Mapping[str, int | Sequence[int]] | None
) -> tuple[np.ndarray, list[str]]:
    """Place of each voxel's label plus one, int16, and the labels' names.

    Raises:
        InputError: The values are not whole numbers, or a label does not occur.
    """
    values = _whole(values)
    there = np.unique(values)
    if labels is None and not there.any():
        raise InputError("the volume is empty: all of its voxels are 0")
    if labels is None:
        labels = {str(number): int(number) for number in there if number != 0}
    if not isinstance(labels, Mapping) or not labels:
        known = ", ".join(map(str, there[:40]))
        raise InputError(
            f"labels is {shown(labels)}; it must give numbers by name, such as {{'liver': 3}}; there are {known}"
        )
    if len(labels) > MOST_LABELS:
        raise InputError(f"there are {len(labels)} labels; it must be at most {MOST_LABELS}")
    place = np.zeros(len(there), np.int16)
    for index, (name, wanted) in enumerate(labels.items(), start=1):
        given = np.atleast_1d(np.asarray(wanted))
        if not given.size:
            raise InputError(f"label {name!r} has no numbers; it must have at least one")
        for number in given:
            found = np.flatnonzero(there == number)
            if not len(found):
                known = ", ".join(map(str, there[:40])) + (", ..." if len(there) > 40 else "")
                raise InputError(f"label {number!s} ({name!r}) is not in the volume; there are {known}")
            if place[found[0]]:
                raise InputError(
                    f"label {number!s} is given both to {list(labels)[place[found[0]] - 1]!r} and {name!r}"
                )
            place[found[0]] = index
    first = int(there[0])
    if int(there[-1]) - first >= 2**20:
        return place[np.searchsorted(there, values)], [str(name) for name in labels]
    table = np.zeros(int(there[-1]) - first + 1, np.int16)
    table[there.astype(np.int64) - first] = place
    return table[values.astype(np.int64) - first if first else values], [str(name) for name in labels]


def _whole(values: np.ndarray) -> np.ndarray:
    """The values as whole numbers.

    Raises:
        InputError: They are not whole, or not numbers.
    """
    if values.dtype == bool:
        return values.astype(np.uint8)
    if values.dtype.kind in "iu":
        return values
    if values.dtype.kind != "f":
        raise InputError(f"the volume has dtype {values.dtype}; labels must be integers")
    bad = ~(np.isfinite(values) & (values == np.round(values)))
    if bad.any():
        voxel = np.unravel_index(int(np.argmax(bad)), values.shape)
        raise InputError(
            f"voxel {tuple(map(int, voxel))} of the volume is {values[voxel]:g}; labels must be integers "
            f"(probability maps: Domain.from_probabilities)"
        )
    return values.astype(np.int64)


def labels_from_probabilities(maps: Mapping[str, npt.ArrayLike], *, certain: float = 1.0) -> np.ndarray:
    """The likeliest label of each voxel.

    The rest up to ``certain`` is the probability of the background. A voxel is background if that is the largest, or if
    all are zero; among equals the first map counts.

    Args:
        maps: Probabilities, arrays of one shape, by label name.
        certain: The value that means probability one.

    Returns:
        int32, of the maps' shape: 0 for background, k for the k-th map.

    Raises:
        InputError: There are no maps, their shapes differ, or a value is not finite or outside 0 to ``certain``.
    """
    if not maps:
        raise InputError("maps is empty; it must give at least one volume by label name")
    if not 0.0 < checked_number(certain, "certain") < np.inf:
        raise InputError(f"certain is {certain!r}; it must be the value that means probability one")
    arrays = {name: np.asarray(values) for name, values in maps.items()}
    first_name, first = next(iter(arrays.items()))
    left, best = np.full(first.shape, certain, np.float32), np.zeros(first.shape, np.float32)
    labels = np.zeros(first.shape, np.int32)
    for place, (name, values) in enumerate(arrays.items(), start=1):
        if values.shape != first.shape:
            raise InputError(
                f"the map {name!r} has shape {values.shape} and {first_name!r} {first.shape}; all must have the same"
            )
        if values.dtype.kind not in "fiu":
            raise InputError(f"the map {name!r} has dtype {values.dtype}; probabilities must be numbers")
        low, high = values.min(initial=0), values.max(initial=0)
        if not (low >= -1e-6 * certain and high <= certain * (1.0 + 1e-6)):
            raise InputError(f"the map {name!r} runs from {low:g} to {high:g}; it must be within 0 to {certain:g}")
        better = values > best
        labels[better] = place
        best = np.maximum(best, values, dtype=np.float32)
        left -= values
    labels[left >= best] = 0
    return labels
