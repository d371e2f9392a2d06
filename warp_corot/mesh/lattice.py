"""The integer lattice of a forest's vertices, and the cubes and levels for which it has room."""

from typing import Any

import numpy as np

from warp_corot.errors import InputError
from warp_corot.inputs.checks import checked_axis, checked_number, checked_numbers, shown
from warp_corot.kernels.tables.shapes import VOLUME

#: A root cube has 2**LATTICE_BITS lattice intervals a side, so levels go up to 3 * LATTICE_BITS.
LATTICE_BITS = 16
MAX_LEVEL = 3 * LATTICE_BITS

#: The most root cubes along an axis, because lattice coordinates are int32.
MAX_CELLS = 2 ** (31 - LATTICE_BITS) - 1


def lattice_spacing(cell_size: float) -> float:
    """Length of one lattice interval [m]."""
    return cell_size / 2**LATTICE_BITS


def volume_shares(level: np.ndarray | int) -> np.ndarray:
    """Volume of tetrahedra of these levels over the volume of a root cube."""
    all_levels = np.arange(MAX_LEVEL + 1)
    return (0.125 ** (all_levels // 3) * np.array(VOLUME)[all_levels % 3])[level]


def checked_level(level: Any, name: str) -> int:
    """A level for which the lattice has room.

    Raises:
        InputError: It is not a whole number from 0 to ``MAX_LEVEL``.
    """
    try:
        found = int(level)
        whole = bool(found == level) and not isinstance(level, bool)
    except (TypeError, ValueError, OverflowError):
        found, whole = -1, False
    if not whole or not 0 <= found <= MAX_LEVEL:
        raise InputError(f"{name} is {shown(level)}; it must be a whole number from 0 to {MAX_LEVEL}")
    return found


def check_levels(min_level: Any, max_level: Any) -> None:
    """Check that two levels are in order; None leaves one open.

    Raises:
        InputError: One is not a level, or the first is larger than the second.
    """
    levels = {"min_level": min_level, "max_level": max_level}
    found = [checked_level(level, name) for name, level in levels.items() if level is not None]
    if len(found) == 2 and found[0] > found[1]:
        raise InputError(f"min_level is {min_level}; it must be at most max_level, which is {max_level}")


def checked_cells(cells: Any) -> tuple[int, int, int]:
    """Numbers of root cubes along x, y, z.

    Raises:
        InputError: They are not three numbers for which the lattice has room.
    """
    try:
        counts = np.asarray(cells)
    except ValueError:  # rows of different lengths
        counts = np.empty(0)
    whole = counts.shape == (3,) and np.issubdtype(counts.dtype, np.integer)
    if not (whole and counts.min() >= 1 and counts.max() <= MAX_CELLS):
        raise InputError(f"cells is {shown(cells)}; it must be three whole numbers from 1 to {MAX_CELLS}")
    x, y, z = (int(c) for c in counts)
    return x, y, z


def checked_box(
    cells: Any, cell_size: float, level: Any, origin: Any, up_axis: str
) -> tuple[tuple[int, int, int], float, int, tuple[float, float, float]]:
    """The checked arguments of ``TetForest.box`` except the axis.

    Raises:
        InputError: One of them is out of its range.
    """
    counts, size, depth = checked_cells(cells), checked_cell_size(cell_size), checked_level(level, "level")
    checked_axis(up_axis)
    corner = checked_numbers(origin, "origin", "[3]")
    if corner.shape != (3,) or not np.isfinite(corner).all():
        raise InputError(f"origin is {shown(origin)}; it must be three finite coordinates in metres")
    x, y, z = (float(c) for c in corner)
    return counts, size, depth, (x, y, z)


def checked_cell_size(cell_size: float) -> float:
    """The edge length of a root cube [m].

    Raises:
        InputError: It is not positive and finite.
    """
    if not 0 < checked_number(cell_size, "cell_size", "m") < np.inf:
        raise InputError(f"cell_size is {cell_size}; it must be a positive length in metres")
    return float(cell_size)
