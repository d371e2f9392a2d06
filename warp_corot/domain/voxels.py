"""Signed distances of sets of voxels, and how steep their trilinear interpolant is."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING

import numpy as np
import scipy.ndimage

if TYPE_CHECKING:
    from collections.abc import Iterator


def signed_distance(inside: np.ndarray, spacing: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Signed distances at voxel centres to a surface halfway between those inside and those outside.

    From a centre the nearest one on the other side is n steps away (n the largest difference of their indices) and the
    surface half a step less: phi = distance * (1 - 1 / (2 n)), negative inside. The distances are exact, by the feature
    transform of `scipy.ndimage.distance_transform_edt`.

    Args:
        inside: bool [nx, ny, nz], with some of both.
        spacing: Distance of voxel centres along each axis [m].

    Returns:
        ``phi`` float32 [nx, ny, nz] [m], and ``nearest`` int32 [3, nx, ny, nz], the indices of the nearest voxel inside
        (a voxel's own, inside).
    """
    # Of several nearest voxels the one taken should not hang on the last digits of the spacing.
    ratios = np.round(spacing / spacing.min(), 5)

    def nearest_zero(values: np.ndarray) -> np.ndarray:
        return scipy.ndimage.distance_transform_edt(
            values, sampling=ratios, return_distances=False, return_indices=True
        )

    # SciPy lets go of the interpreter meanwhile.
    with ThreadPoolExecutor(2) as pool:
        nearest, other = pool.map(nearest_zero, (~inside, inside))
    phi = np.empty(inside.shape, np.float32)
    for slab in _slabs(len(phi)):
        # A voxel is its own nearest one on its side, so one of the two distances is always zero.
        phi[slab] = _less_half_a_step(nearest, slab, spacing) - _less_half_a_step(other, slab, spacing)
    return phi, nearest


def steepest_slope(phi: np.ndarray, spacing: np.ndarray) -> float:
    """The largest gradient that the trilinear interpolant can have.

    Within a cell the derivative along an axis is a mean of the differences along the cell's four edges in that
    direction, so the gradient is at most sqrt(sum over axes of the largest of the four, squared); between cells the
    interpolant is continuous.
    """
    steepest = 0.0
    for slab in _slabs(len(phi) - 1):
        values = phi[slab.start : slab.stop + 1]
        squares: np.ndarray = np.zeros(1, np.float32)
        for axis in range(3):
            edges = np.abs(np.diff(values, axis=axis)) / np.float32(spacing[axis])
            for across in {0, 1, 2} - {axis}:
                low = tuple(slice(None, -1) if k == across else slice(None) for k in range(3))
                high = tuple(slice(1, None) if k == across else slice(None) for k in range(3))
                edges = np.maximum(edges[low], edges[high])
            squares = squares + edges * edges
        steepest = max(steepest, float(np.sqrt(np.max(squares))))
    return steepest


def gaussian(phi: np.ndarray, sigma: float, spacing: np.ndarray) -> np.ndarray:
    """phi smoothed by a Gaussian of standard deviation ``sigma`` [m]: a mean of shifted copies, so no steeper."""
    return scipy.ndimage.gaussian_filter(phi, sigma / spacing, mode="nearest")


def pieces(inside: np.ndarray) -> np.ndarray:
    """Voxels in each connected piece, the largest first."""
    return np.sort(np.bincount(piece_of_voxels(inside).ravel())[1:])[::-1]


def piece_of_voxels(inside: np.ndarray) -> np.ndarray:
    """Which piece each voxel is in, from 1; 0 where it is outside. Voxels that touch, be it in a corner, are of one."""
    return scipy.ndimage.label(inside, np.ones((3, 3, 3)))[0]


def _less_half_a_step(nearest: np.ndarray, slab: slice, spacing: np.ndarray) -> np.ndarray:
    """Distances of voxel centres to the given voxels', less half a step on the way."""
    squares = np.zeros(nearest[0, slab].shape, np.float32)
    steps = np.ones(squares.shape, np.int32)
    for axis in range(3):
        own = np.arange(nearest.shape[axis + 1], dtype=np.int32)[slab if axis == 0 else slice(None)]
        apart = np.abs(nearest[axis, slab] - own.reshape([-1 if k == axis else 1 for k in range(3)]))
        np.maximum(steps, apart, out=steps)
        squares += np.square(np.float32(spacing[axis]) * apart.astype(np.float32))
    return np.sqrt(squares) * (np.float32(1.0) - np.float32(0.5) / steps.astype(np.float32))


def _slabs(count: int, thickness: int = 32) -> Iterator[slice]:
    return (slice(start, min(start + thickness, count)) for start in range(0, count, thickness))
