"""Domains of segmented volumes."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.errors import InputError
from warp_corot.inputs.checks import checked_number
from warp_corot.kernels.meshing import domain as kernels

from .grid import Grid, Volume, labels_from_probabilities, numbered_labels, placed_grid
from .signed import SignedFunction
from .units import length, unlikely_size, volume
from .voxels import gaussian, pieces, signed_distance, steepest_slope

#: Voxels of background around the body: the interpolant is positive beyond.
MARGIN = 2
#: Smoothing beyond this share of the body's length removes more than the steps of voxels.
LARGEST_SMOOTHING = 0.1


class LabelDomain(SignedFunction):
    """See `Domain.from_labels`.

    Args:
        numbers: Place of each voxel's label in ``names`` plus one, 0 outside, int16 [nx, ny, nz].
        affine: From voxel indices to metres [4, 4].
        names: Names of the labels.
        smoothing: Standard deviation [m] of the Gaussian over phi.
        notes: Lines of the report.
    """

    def __init__(
        self,
        numbers: np.ndarray,
        affine: np.ndarray,
        names: Sequence[str],
        smoothing: float = 0.0,
        notes: Sequence[str] = (),
        **options: Any,
    ):
        box = _extent(numbers > 0)
        longest = float((np.ptp(box, axis=0) * np.linalg.norm(affine[:3, :3], axis=0)).max())
        if smoothing > LARGEST_SMOOTHING * longest:
            raise InputError(
                f"smoothing is {length(smoothing)} and the body {length(longest)} long; it must be at most "
                f"{LARGEST_SMOOTHING:g} of that"
            )
        margin = MARGIN + np.ceil(4.0 * smoothing / np.linalg.norm(affine[:3, :3], axis=0)).astype(int)
        wide = np.stack([box[0] - margin, box[1] + margin])
        self.numbers = _crop(numbers, wide)
        self.affine = affine.copy()
        self.affine[:3, 3] += affine[:3, :3] @ wide[0]
        self.spacing = np.linalg.norm(affine[:3, :3], axis=0)
        self.smoothing = smoothing
        self.notes = list(notes)
        cut = [f"{'xyz'[k]}" for k in range(3) if box[0, k] == 0 or box[1, k] == numbers.shape[k]]
        if cut:
            self.notes.append(
                f"the body reaches the end of the volume along voxel axis {', '.join(cut)}: cut off there"
            )

        inside = self.numbers > 0
        phi, nearest = signed_distance(inside, self.spacing)
        self.nearest = self.numbers[tuple(nearest)]
        if smoothing:
            phi = gaussian(phi, smoothing, self.spacing)
            if not (phi < 0.0).any():
                raise InputError(f"smoothing by {length(smoothing)} leaves nothing of the body; it must be less")
            change = np.count_nonzero(phi < 0.0) / np.count_nonzero(inside) - 1.0
            self.notes.append(f"smoothed by {length(smoothing)}, which changes the volume by {change:+.2%}")
        self.values = phi
        # Distances assume voxel axes at right angles; other affines stretch them.
        inverse = np.linalg.inv(self.affine[:3, :3])
        stretch = np.linalg.norm(self.spacing[:, None] * inverse, 2)
        slope = max(1.0, steepest_slope(phi, self.spacing)) * float(stretch)
        super().__init__(_bounds(phi, self.affine), slope, label_names=names, **options)
        self._to_voxel = wp.mat33(*inverse.ravel())
        self._shift = wp.vec3(*(-inverse @ self.affine[:3, 3]))
        self._on: dict[str, tuple[wp.array, wp.array]] = {}

    def _arrays(self, device: wp.Device) -> tuple[wp.array, wp.array]:
        """Distances and labels on a device."""
        key = str(device)
        if key not in self._on:
            values = wp.array(np.ascontiguousarray(self.values), dtype=wp.float32, device=device)
            self._on[key] = values, wp.array(np.ascontiguousarray(self.nearest), dtype=wp.int16, device=device)
        return self._on[key]

    def _phi(self, points: wp.array) -> wp.array:
        phi = wp.empty(points.size, wp.float32, device=points.device)
        values, _ = self._arrays(points.device)
        given = [points, self._to_voxel, self._shift, wp.vec3(*self.spacing), values]
        wp.launch(kernels.evaluate_voxels, points.size, given, [phi], device=points.device)
        return phi

    def _labels(self, points: wp.array) -> wp.array:
        labels = wp.empty(points.size, wp.int32, device=points.device)
        _, nearest = self._arrays(points.device)
        given = [points, self._to_voxel, self._shift, nearest]
        wp.launch(kernels.read_voxels, points.size, given, [labels], device=points.device)
        return labels

    def points_in(self, name: str, count: int) -> np.ndarray:
        """See `Domain.points_in`: centres of voxels, from the one nearest to their centre to the farthest."""
        if name not in self.label_names:
            return super().points_in(name, count)
        voxels = np.argwhere(self.numbers == self.label_names.index(name) + 1)
        away = ((voxels - voxels.mean(axis=0)) ** 2).sum(axis=1) if len(voxels) else np.empty(0)
        chosen = voxels[np.argsort(away, kind="stable")[:: max(1, -(-len(voxels) // count))]]
        return chosen @ self.affine[:3, :3].T + self.affine[:3, 3]

    @property
    def label_volumes(self) -> np.ndarray:
        """See `Domain.label_volumes`."""
        counts = np.bincount(self.numbers.ravel(), minlength=len(self.label_names) + 1)[1:]
        return counts * abs(float(np.linalg.det(self.affine[:3, :3])))

    def part(self, name: str) -> SignedFunction:
        """See `Domain.part`."""
        if name not in self.label_names:
            return super().part(name)
        chosen = (self.numbers == self.label_names.index(name) + 1).astype(np.int16)
        options = {"up_axis": self.up_axis, "device": self.device}
        return LabelDomain(chosen, self.affine, [name], self.smoothing, **options)

    def _details(self) -> list[str]:
        steps = " x ".join(length(step) for step in self.spacing)
        sizes = pieces(self.numbers > 0)
        volumes = zip(self.label_names, self.label_volumes.tolist(), strict=True)
        shares = ", ".join(f"{name} {volume(own)}" for name, own in volumes)
        parted = f", the largest has {sizes[0] / sizes.sum():.2%} of the voxels" if len(sizes) > 1 else ""
        return [
            f"voxels of {steps}: {sizes.sum()} in {len(sizes)} piece{'s'[: len(sizes) > 1]}{parted}",
            f"volume by label: {shares}",
            *self.notes,
        ]


def label_domain(
    given: Volume,
    spacing: Sequence[float] | None,
    origin: Sequence[float] | None,
    affine: npt.ArrayLike | None,
    labels: Mapping[str, int | Sequence[int]] | None,
    unit: str | float | None,
    smoothing: float,
    up_axis: str,
    device: Any,
) -> SignedFunction:
    """See `Domain.from_labels`."""
    grid = placed_grid(given, spacing, origin, affine, unit)
    numbers, names = numbered_labels(grid.values, labels)
    return _domain(grid, numbers, names, smoothing, up_axis, device, unit)


def probability_domain(
    maps: Mapping[str, Volume],
    certain: float,
    spacing: Sequence[float] | None,
    origin: Sequence[float] | None,
    affine: npt.ArrayLike | None,
    unit: str | float | None,
    smoothing: float,
    up_axis: str,
    device: Any,
) -> SignedFunction:
    """See `Domain.from_probabilities`."""
    if not (isinstance(maps, Mapping) and maps):
        raise InputError("maps is empty; it must give at least one volume by label name")
    grids = {name: placed_grid(given, spacing, origin, affine, unit) for name, given in maps.items()}
    first_name, first = next(iter(grids.items()))
    for name, grid in grids.items():
        if grid.values.shape == first.values.shape and not np.allclose(grid.affine, first.affine, atol=1e-6):
            raise InputError(f"the maps {first_name!r} and {name!r} have different affines; they must lie in one place")
    numbers = labels_from_probabilities({name: grid.values for name, grid in grids.items()}, certain=certain)
    if not numbers.any():
        raise InputError("no voxel of the maps is likelier inside than outside; are they in the range 0 to certain?")
    return _domain(first, numbers.astype(np.int16), list(maps), smoothing, up_axis, device, unit)


def _domain(
    grid: Grid, numbers: np.ndarray, names: Sequence[str], smoothing: float, up_axis: str, device: Any, unit: Any
) -> SignedFunction:
    if not 0.0 <= checked_number(smoothing, "smoothing", "m") < np.inf:
        raise InputError(f"smoothing is {smoothing!r}; it must be a length [m], 0 for none")
    domain = LabelDomain(numbers, grid.affine, names, smoothing, grid.notes, up_axis=up_axis, device=device)
    doubt = unlikely_size(float(np.ptp(domain.bounds, axis=0).max()), grid.metres)
    if unit is None and doubt:
        domain.notes.append(doubt)
        warnings.warn(doubt, UserWarning, stacklevel=4)
    return domain


def _extent(inside: np.ndarray) -> np.ndarray:
    """First and past-the-last index of the voxels inside, [2, 3].

    Raises:
        InputError: There is none.
    """
    lows, highs = [], []
    for axis in range(3):
        taken = np.flatnonzero(inside.any(axis=tuple({0, 1, 2} - {axis})))
        if not len(taken):
            raise InputError("the volume is empty: no voxel has a label")
        lows.append(taken[0])
        highs.append(taken[-1] + 1)
    return np.array([lows, highs])


def _crop(values: np.ndarray, box: np.ndarray) -> np.ndarray:
    """The values within a box of indices, zero beyond the volume, in C order."""
    low, high = np.maximum(box[0], 0), np.minimum(box[1], values.shape)
    cut = values[tuple(slice(a, b) for a, b in zip(low, high, strict=True))]
    before, after = low - box[0], box[1] - high
    return np.ascontiguousarray(np.pad(cut, list(zip(before, after, strict=True))))


def _bounds(phi: np.ndarray, affine: np.ndarray) -> np.ndarray:
    """A box in space that holds every cell with a corner inside."""
    low, past = _extent(phi <= 0.0)
    corners = np.stack(np.meshgrid(*np.stack([low - 1, past]).T, indexing="ij"), axis=-1).reshape(-1, 3)
    placed = corners @ affine[:3, :3].T + affine[:3, 3]
    return np.stack([placed.min(axis=0), placed.max(axis=0)])
