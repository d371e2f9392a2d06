"""Signed distances of sets of voxels, and how steep their trilinear interpolant is."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.ndimage
import warp as wp

from warp_corot.inputs.cpu_threads import launch_side_by_side
from warp_corot.kernels.meshing import voxel_distances as kernels

if TYPE_CHECKING:
    from collections.abc import Iterator


def signed_distance(inside: np.ndarray, spacing: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Signed distances at voxel centres to a surface halfway between those inside and those outside.

    From a centre the nearest one on the other side is n steps away (n the largest difference of their indices) and the
    surface half a step less: phi = distance * (1 - 1 / (2 n)), negative inside. The distances are exact.

    Args:
        inside: bool [nx, ny, nz], with some of both.
        spacing: Distance of voxel centres along each axis [m].

    Returns:
        ``phi`` float32 [nx, ny, nz] [m], and ``nearest`` int16 [3, nx, ny, nz], the indices of the nearest voxel inside
        (a voxel's own, inside).
    """
    # Which one of several nearest voxels is taken should not depend on the last digits of the spacing.
    ratios = np.round(spacing / spacing.min(), 5)
    cpu = wp.get_device("cpu")
    given = wp.array(inside.astype(np.uint8), dtype=wp.uint8, device=cpu)
    phi = wp.empty(inside.shape, dtype=wp.float32, device=cpu)
    nearest = wp.empty((3, *inside.shape), dtype=wp.int16, device=cpu)
    for wanted in (0, 1):
        inputs = [given, wanted, *_nearest_of(given, wanted, ratios), wp.vec3(*spacing)]
        _on_lines(kernels.take_distances, given.shape[0] * given.shape[1], inputs, [phi, nearest])
    return phi.numpy(), nearest.numpy()


def _nearest_of(inside: wp.array, wanted: int, ratios: np.ndarray) -> list[wp.array]:
    """The nearest voxels that are inside, or outside, by their place along each axis, int16 [nx, ny, nz] each.

    The first index is read at the voxel itself, the second at the voxel with that first index, and the third at the
    voxel with both.
    """
    shape, cpu = inside.shape, inside.device
    third, second, first, kept = (wp.empty(shape, dtype=wp.int16, device=cpu) for _ in range(4))
    rows, layers = (wp.empty(shape, dtype=wp.float32, device=cpu) for _ in range(2))
    inputs = [inside, wanted, float(ratios[2])]
    _on_lines(kernels.find_nearest_in_rows, shape[0] * shape[1], inputs, [third, rows])
    _on_lines(kernels.find_nearest_across, shape[0] * shape[2], [rows, float(ratios[1])], [kept, second, layers])
    layers, rows, kept, turned = (array.transpose((1, 0, 2)) for array in (layers, rows, kept, first))
    _on_lines(kernels.find_nearest_across, shape[1] * shape[2], [layers, float(ratios[0])], [kept, turned, rows])
    return [first, second, third]


def _on_lines(kernel: wp.Kernel, count: int, inputs: list[Any], outputs: list[wp.array]) -> None:
    """Launch a kernel with a thread for each line of voxels."""
    launch_side_by_side(kernel, count, lambda own: ([*inputs, -own(0)], outputs), wp.get_device("cpu"))


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
    """The piece of each voxel, from 1; 0 outside. Voxels that touch, even in a corner, belong to one piece."""
    return scipy.ndimage.label(inside, np.ones((3, 3, 3)))[0]


def _slabs(count: int, thickness: int = 32) -> Iterator[slice]:
    return (slice(start, min(start + thickness, count)) for start in range(0, count, thickness))
