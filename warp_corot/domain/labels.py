"""Domains of segmented volumes: the user's voxels, placed in metres and with numbered labels; probabilities become
labels; signed distances of sets of voxels."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from os import PathLike
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import scipy
import warp as wp

from warp_corot.domain.domain import Domain
from warp_corot.domain.units import length, metres_per_unit, unlikely_size, volume
from warp_corot.errors import InputError
from warp_corot.inputs.checks import checked_number, checked_numbers, shown
from warp_corot.inputs.cpu_threads import launch_side_by_side
from warp_corot.io.read.filemesh import LoadedVolume, affine_of, load_volume
from warp_corot.kernels.meshing import domain as kernels
from warp_corot.kernels.meshing import voxel_distances as distances

if TYPE_CHECKING:
    from collections.abc import Iterator

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
        _on_lines(distances.take_distances, given.shape[0] * given.shape[1], inputs, [phi, nearest])
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
    _on_lines(distances.find_nearest_in_rows, shape[0] * shape[1], inputs, [third, rows])
    _on_lines(distances.find_nearest_across, shape[0] * shape[2], [rows, float(ratios[1])], [kept, second, layers])
    layers, rows, kept, turned = (array.transpose((1, 0, 2)) for array in (layers, rows, kept, first))
    _on_lines(distances.find_nearest_across, shape[1] * shape[2], [layers, float(ratios[0])], [kept, turned, rows])
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


#: Voxels of background around the body: the interpolant is positive beyond.
MARGIN = 2
#: Smoothing beyond this share of the body's length removes more than the steps of voxels.
LARGEST_SMOOTHING = 0.1


class LabelDomain(Domain):
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

    def _part(self, name: str) -> Domain:
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


#: Spacing, origin, affine and unit, as for ``Domain.from_labels``.
Placing = tuple[Sequence[float] | None, Sequence[float] | None, npt.ArrayLike | None, str | float | None]


def label_domain(given: Volume, labels: Any, placing: Placing, *options: Any) -> Domain:
    """See `Domain.from_labels`."""
    grid = placed_grid(given, *placing)
    numbers, names = numbered_labels(grid.values, labels)
    return _domain(grid, numbers, names, placing[-1], *options)


def probability_domain(maps: Mapping[str, Volume], certain: float, placing: Placing, *options: Any) -> Domain:
    """See `Domain.from_probabilities`."""
    if not (isinstance(maps, Mapping) and maps):
        raise InputError("maps is empty; it must give at least one volume by label name")
    grids = {name: placed_grid(given, *placing) for name, given in maps.items()}
    first_name, first = next(iter(grids.items()))
    for name, grid in grids.items():
        if grid.values.shape == first.values.shape and not np.allclose(grid.affine, first.affine, atol=1e-6):
            raise InputError(f"the maps {first_name!r} and {name!r} have different affines; they must lie in one place")
    numbers = labels_from_probabilities({name: grid.values for name, grid in grids.items()}, certain=certain)
    if not numbers.any():
        raise InputError("no voxel of the maps is likelier inside than outside; are they in the range 0 to certain?")
    return _domain(first, numbers.astype(np.int16), list(maps), placing[-1], *options)


def _domain(
    grid: Grid, numbers: np.ndarray, names: Sequence[str], unit: Any, smoothing: float, up_axis: str, device: Any
) -> Domain:
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
