"""Domains that a triangle surface encloses, with the pieces of the body: parts of the surface that touch, cross or
contain one another; domains of formulas, of functions that users write, and of sets of domains."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from functools import cached_property
from os import PathLike
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.domain.closing import SurfaceParts, part_volumes
from warp_corot.domain.domain import Domain, Function
from warp_corot.domain.units import length, metres_per_unit, unlikely_size, volume
from warp_corot.errors import InputError
from warp_corot.inputs.checks import (
    checked_axis,
    checked_length,
    checked_number,
    checked_numbers,
    checked_vector,
    shown,
)
from warp_corot.inputs.cpu_threads import launch_side_by_side
from warp_corot.inputs.loading import SURFACES, load
from warp_corot.io.read.meshes import UP_AXES, LoadedMesh, load_surface
from warp_corot.kernels.meshing import domain as kernels
from warp_corot.kernels.meshing import windings
from warp_corot.mesh.topology import linked

if TYPE_CHECKING:
    from warp_corot.domain.closing import ClosedSurface

#: A file, the result of ``load_surface``, or points and triangles.
Surface = str | PathLike[str] | LoadedMesh | tuple[npt.ArrayLike, npt.ArrayLike]

#: Points along each side of the box at which winding numbers are evaluated.
SAMPLES = 16
#: A surface is refused if more than this share of the space that it encloses is inside out.
LARGEST_REVERSED = 0.05
#: Rays into the body start this far inside, over their length.
START = 0.01
#: Holes above this share of the area draw a warning.
LARGE_HOLES = 0.01


class SurfaceDomain(Domain):
    """See `Domain.from_surface`.

    Args:
        closed: A closed surface [m].
        notes: Lines of the report.
    """

    def __init__(self, closed: ClosedSurface, notes: Sequence[str] = (), **options: Any):
        named = np.zeros(len(closed.points), bool)
        named[closed.triangles] = True
        used = closed.points[named]
        # Triangles are kept in float32; its rounding may move them outwards.
        rounding = 2.0**-23 * np.abs(used).max()
        bounds = np.stack([used.min(axis=0) - rounding, used.max(axis=0) + rounding])
        super().__init__(bounds, 1.0, **options)
        load(SURFACES, self.device)
        self.closed = closed
        self.notes = list(notes)
        self._on: dict[str, wp.Mesh] = {}
        self.lines = lines_through(bounds)
        self.reversed, self.overlapping = self._windings()
        if self.reversed > LARGEST_REVERSED:
            raise InputError(
                f"the surface crosses itself so that {self.reversed:.0%} of what it encloses is inside out; it must be "
                f"wound outwards throughout (at most {LARGEST_REVERSED:.0%})"
            )

    def _phi(self, points: wp.array) -> wp.array:
        return _found(kernels.evaluate_surface, [points], self._at_lines(points.device), wp.float32)[0]

    def holds(self, points: npt.ArrayLike) -> np.ndarray:
        return windings_of(self._mesh(self.device), self.lines, self._on_device(points)) > 0

    def exits(self, starts: np.ndarray, ends: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        each, of_all = [self._on_device(starts), self._on_device(ends - starts)], self._at_lines(self.device)
        shares, normals = _found(kernels.find_exits, each, of_all, wp.float32, wp.vec3)
        found = shares.numpy().astype(np.float64)
        return np.where(found < 0.0, np.nan, found), normals.numpy().astype(np.float64)

    @cached_property
    def joined(self) -> tuple[int, np.ndarray, bool]:
        """The body's pieces; see `joined_parts`."""
        return joined_parts(self.closed, self.device)

    @property
    def has_pieces(self) -> bool:
        return self.closed.pieces > 1

    def _thickness(self, points: wp.array, along: wp.array, reach: float, side: float) -> np.ndarray:
        # A little inside, so that a ray does not hit the surface on which it starts.
        start = wp.array(points.numpy() + START * reach * along.numpy(), dtype=wp.vec3, device=points.device)
        of_all = [reach, side, self._mesh(points.device).id]
        found = _found(kernels.evaluate_thickness, [start, along], of_all, wp.float32)[0]
        return np.minimum(found.numpy() + START * reach, reach)

    def lengths_inside(self, starts: np.ndarray) -> np.ndarray:
        """The length inside the body of the lines from points below it [m], float64 [n]; see `lines`."""
        placed, of_all = self._on_device(starts), self._at_lines(self.device)
        return _found(windings.measure_lines, [placed], of_all, wp.float64)[0].numpy()

    def _mesh(self, device: wp.Device) -> wp.Mesh:
        key = str(device)
        if key not in self._on:
            self._on[key] = surface_mesh(self.closed.points, self.closed.triangles, device)
        return self._on[key]

    def _at_lines(self, device: wp.Device) -> list[Any]:
        """What kernels take that follow the lines through the surface."""
        mesh = self._mesh(device)
        return [mesh.id, mesh.indices, self.lines]

    def _windings(self) -> tuple[float, float]:
        """Share of the enclosed space that is inside out, and that counts twice."""
        rng = np.random.default_rng(0)
        cells = np.stack(np.meshgrid(*[np.arange(SAMPLES)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
        places = (cells + rng.random(cells.shape)) / SAMPLES
        points = self._on_device(self.bounds[0] + places * np.ptp(self.bounds, axis=0))
        winding = windings_of(self._mesh(self.device), self.lines, points)
        enclosed = max(int(np.count_nonzero(winding)), 1)
        return np.count_nonzero(winding < 0) / enclosed, np.count_nonzero(winding > 1) / enclosed

    def _details(self) -> list[str]:
        closed = self.closed
        lines = [f"{len(closed.triangles) - closed.caps} triangles enclose {volume(closed.volume)}", *self.notes]
        if closed.open_edges:
            lines.append(
                f"open: {closed.open_edges} edges in {closed.holes} hole{'s'[: closed.holes != 1]}, closed with "
                f"{closed.cap_share:.2%} of the area"
            )
        else:
            lines.append("closed")
        said = [
            (closed.dropped, f"{closed.dropped} triangles without area or there twice left out"),
            (closed.turned, f"{closed.turned} triangles wound against their neighbours turned round"),
            (closed.inside_out, f"{closed.inside_out} part{'s'[: closed.inside_out != 1]} inside out turned round"),
            (closed.pieces > 1, f"{closed.pieces} separate parts"),
            (closed.cavities, f"{closed.cavities} cavit{'y' if closed.cavities == 1 else 'ies'}"),
            (self.overlapping, f"parts overlap in {self.overlapping:.1%} of what is enclosed"),
            (self.reversed, f"{self.reversed:.1%} of what is enclosed is inside out and left out"),
        ]
        return [*lines, *(line for happened, line in said if happened)]


def surface_domain(surface: Surface, unit: str | float | None, up_axis: str | None, device: Any) -> Domain:
    """See `Domain.from_surface`."""
    from .closing import close_surface

    points, triangles, metres, axis, source, notes = _given(surface, unit, up_axis)
    points, triangles = checked_triangles(points, triangles, source)
    try:
        closed = close_surface(points * metres, triangles)
        domain = SurfaceDomain(closed, notes, up_axis=axis, device=device)
    except InputError as error:
        raise InputError(f"{source}{error}") from None
    size = None if unit is not None else unlikely_size(float(np.ptp(domain.bounds, axis=0).max()), metres)
    doubts = [size] if size else []
    domain.notes += doubts  # the report has a line on holes
    if closed.cap_share > LARGE_HOLES:
        holes = f"its {closed.holes} hole{'s'[: closed.holes != 1]}"
        where = f"walls inside it at {closed.crowded} edges" if closed.crowded else holes
        doubts.append(f"the surface is open: {where} took {closed.cap_share:.1%} of its area to close")
    for doubt in doubts:
        warnings.warn(f"{source}{doubt}", UserWarning, stacklevel=3)
    return domain


def checked_triangles(
    points: npt.ArrayLike, triangles: npt.ArrayLike, source: str = ""
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.int64]]:
    """Points float64 [N, 3] and triangles int64 [T, 3].

    Raises:
        InputError: Other shapes, not numbers, not finite, or indices out of range.
    """
    x, t = np.asarray(points), np.asarray(triangles)
    if x.ndim != 2 or x.shape[1] != 3 or not len(x) or x.dtype.kind not in "fiu":
        raise InputError(f"{source}points have shape {x.shape} and dtype {x.dtype}; they must be numbers [N, 3]")
    if t.ndim != 2 or t.shape[1] != 3 or not len(t) or t.dtype.kind not in "iu":
        raise InputError(f"{source}triangles have shape {t.shape} and dtype {t.dtype}; they must be indices [T, 3]")
    bad = np.flatnonzero(~np.isfinite(x).all(axis=1))
    if len(bad):
        raise InputError(f"{source}point {bad[0]} is {x[bad[0]].tolist()}; coordinates must be finite")
    bad = np.flatnonzero(((t < 0) | (t >= len(x))).any(axis=1))
    if len(bad):
        raise InputError(f"{source}triangle {bad[0]} names the points {t[bad[0]].tolist()}; there are {len(x)}")
    return x.astype(np.float64), t.astype(np.int64)


def surface_mesh(points: np.ndarray, triangles: np.ndarray, device: wp.Device) -> wp.Mesh:
    """A Warp mesh of points [N, 3] and triangles [T, 3]."""
    return wp.Mesh(
        wp.array(np.ascontiguousarray(points, dtype=np.float32), dtype=wp.vec3, device=device),
        wp.array(np.ascontiguousarray(triangles, dtype=np.int32).ravel(), dtype=wp.int32, device=device),
    )


def lines_through(bounds: np.ndarray) -> windings.Lines:
    """The lines along which winding numbers are found: along the surface's shortest side, where lines meet it least."""
    lines = windings.Lines()
    lines.axis = int(np.argmin(np.ptp(bounds, axis=0)))
    margin = 1e-3 * float(np.ptp(bounds, axis=0).max())
    lines.low, lines.high = bounds[0, lines.axis] - margin, bounds[1, lines.axis] + margin
    return lines


def windings_of(mesh: wp.Mesh, lines: windings.Lines, points: wp.array) -> np.ndarray:
    """Winding numbers of a closed surface around points, int32 [n]."""
    return _found(windings.find_windings, [points], [mesh.id, mesh.indices, lines], wp.int32)[0].numpy()


def _found(kernel: wp.Kernel, each: list[wp.array], of_all: list[Any], *kinds: type) -> list[wp.array]:
    """What a kernel finds, arrays of these types, by a thread for each entry of the first arrays."""
    count, device = len(each[0]), each[0].device
    found = [wp.empty(count, kind, device=device) for kind in kinds]
    launch_side_by_side(kernel, count, lambda own: ([*map(own, each), *of_all], [*map(own, found)]), device)
    return found


def _given(
    surface: Surface, unit: str | float | None, up_axis: str | None
) -> tuple[Any, Any, float, str, str, list[str]]:
    """Points, triangles, metres per unit, up axis, the file's name for messages, and notes."""
    if not isinstance(surface, str | PathLike | LoadedMesh):
        if not isinstance(surface, tuple | list) or len(surface) != 2:
            raise InputError(f"the surface is a {type(surface).__name__}; it must be a file or (points, triangles)")
        unit = "m" if unit is None else unit
        return *surface, metres_per_unit(unit), "Y" if up_axis is None else up_axis, "", [f"unit {unit}"]
    loaded = surface if isinstance(surface, LoadedMesh) else load_surface(surface)
    notes = list(loaded.notes)
    metres = (loaded.metres or 1.0) if unit is None else metres_per_unit(unit)
    if loaded.metres is not None and np.isclose(loaded.metres, metres):
        notes.append(f"unit {length(metres)}, as the file says")
    elif unit is None:
        notes.append("unit m: the file names none, none was given")
    else:
        other = "" if loaded.metres is None else f", as asked for, though the file says {loaded.metres:g} m"
        notes.append(f"unit {unit}{other}")
    axis = up_axis or loaded.up_axis or UP_AXES.get(loaded.source.suffix.lower(), "Z")
    if not (up_axis or loaded.up_axis):
        notes.append(f"{axis} taken as up: the file names no up axis")
    return loaded.points, loaded.cells, metres, axis, f"{loaded.source}: ", notes


def joined_parts(closed: ClosedSurface, device: wp.Device) -> tuple[int, np.ndarray, bool]:
    """Pieces of the body that a closed surface encloses: its parts, joined if they touch, cross or contain one another.

    Returns:
        The number of pieces, the piece of each triangle [T] (a cavity belongs to its surroundings), and whether parts
        overlap.
    """
    points, triangles, part = closed.points, closed.triangles.astype(np.int64), closed.parts.astype(np.int64)
    count = int(part.max()) + 1
    if count == 1:
        return 1, np.zeros(len(triangles), np.int32), False
    # Parts that share a point.
    last = np.empty(len(points), np.int64)
    last[triangles] = part[:, None]
    links = [_different(np.repeat(part, 3), last[triangles].ravel())]
    crossings = _crossings(closed, device)
    links.append(crossings)
    # Parts inside the body of others: a cavity in its surroundings, or a part buried in it.
    groups, outward = SurfaceParts(points, triangles, part), part_volumes(points, triangles, part) > 0.0
    holders = [groups.holders(groups.corners[groups.slices[own]][0, 0], own) for own in range(count)]
    overlap = len(crossings) > 0
    for own in range(count):
        around = _bounds_around(own, holders, outward)
        links.append(np.stack([np.full(len(around), own), around], axis=1))
        overlap |= len(around) > 0 and bool(outward[own])
    pairs = np.concatenate(links)
    of_part = linked(pairs, count)
    return int(of_part.max()) + 1, of_part[part].astype(np.int32), overlap


def _bounds_around(own: int, holders: list[np.ndarray], outward: np.ndarray) -> np.ndarray:
    """The parts that bound the body just outside a part: from the innermost one around it outwards, as far as the body
    reaches.
    """
    inmost_first = sorted(holders[own], key=lambda holder: -len(holders[holder]))
    depth = np.cumsum([0, *(1 if outward[holder] else -1 for holder in reversed(inmost_first))])[::-1]
    ends = np.flatnonzero(depth <= 0)
    return np.array(inmost_first[: ends[0]], np.int64)


def _crossings(closed: ClosedSurface, device: wp.Device) -> np.ndarray:
    """Pairs of parts where an edge of one passes through a triangle of the other [n, 2]."""
    edges, own = closed.edges.ends, closed.parts[closed.edges.order[closed.edges.starts] // 3]
    middle = closed.points.mean(axis=0)
    placed = wp.array(closed.points - middle, dtype=wp.vec3, device=device)
    mesh = wp.Mesh(placed, wp.array(closed.triangles.ravel(), dtype=wp.int32, device=device))
    of_edges = [wp.array(edges.astype(np.int32), dtype=wp.vec2i, device=device)]
    of_edges += [wp.array(own, dtype=wp.int32, device=device)]
    of_all = [placed, mesh.id, wp.array(closed.parts, dtype=wp.int32, device=device)]
    other = _found(windings.find_crossed_parts, of_edges, of_all, wp.int32)[0].numpy()
    return _different(own[other >= 0], other[other >= 0])


def _different(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Pairs of different numbers, each once [n, 2]."""
    differ = one != other
    return np.unique(np.stack([one[differ], other[differ]], axis=1), axis=0).astype(np.int64)


# --- formulas, functions and sets ----------------------------------------------------------------------------------


class ShapeDomain(Domain):
    """A shape whose distance is exact.

    Args:
        name: Its name.
        kind, a, b, major, minor: See ``kernels.meshing.domain.evaluate_shape``.
        bounds: Its box [m].
    """

    def __init__(self, name: str, kind: int, a: Any, b: Any, major: float, minor: float, bounds: Any, **options: Any):
        super().__init__(bounds, 1.0, **options)
        self.name, self.numbers = name, (kind, wp.vec3(*a), wp.vec3(*b), major, minor)

    def _phi(self, points: wp.array) -> wp.array:
        phi = wp.empty(points.size, wp.float32, device=points.device)
        wp.launch(kernels.evaluate_shape, points.size, [points, *self.numbers], [phi], device=points.device)
        return phi

    def _details(self) -> list[str]:
        size = " x ".join(length(edge) for edge in np.ptp(self.bounds, axis=0))
        return [f"a {self.name}, {size}"]


def sphere(radius: float, centre: Sequence[float], **options: Any) -> ShapeDomain:
    """See `Domain.sphere`."""
    r, c = checked_length(radius, "radius"), checked_vector(centre, "centre")
    return ShapeDomain("sphere", kernels.CAPSULE, c, c, 0.0, r, [c - r, c + r], **options)


def box(lower: Sequence[float], upper: Sequence[float], **options: Any) -> ShapeDomain:
    """See `Domain.box`."""
    low, high = checked_vector(lower, "lower"), checked_vector(upper, "upper")
    if not (low < high).all():
        raise InputError(f"the box from {low.tolist()} to {high.tolist()} is empty; lower must be below upper")
    return ShapeDomain("box", kernels.BOX, low, high, 0.0, 0.0, [low, high], **options)


def torus(major: float, minor: float, centre: Sequence[float], axis: str, **options: Any) -> ShapeDomain:
    """See `Domain.torus`."""
    ring, tube = checked_length(major, "major"), checked_length(minor, "minor")
    if tube >= ring:
        raise InputError(f"the torus has minor {tube:g} m and major {ring:g} m; minor must be smaller")
    c, along = checked_vector(centre, "centre"), np.eye(3)["XYZ".index(checked_axis(axis, "axis"))]
    reach = (ring + tube) * (1.0 - along) + tube * along
    return ShapeDomain("torus", kernels.TORUS, c, along, ring, tube, [c - reach, c + reach], **options)


def capsule(start: Sequence[float], end: Sequence[float], radius: float, **options: Any) -> ShapeDomain:
    """See `Domain.capsule`."""
    a, b, r = checked_vector(start, "start"), checked_vector(end, "end"), checked_length(radius, "radius")
    if np.linalg.norm(b - a) <= 1e-6 * r:
        raise InputError(f"the capsule begins and ends at {a.tolist()}; its ends must differ (or take a sphere)")
    return ShapeDomain(
        "capsule", kernels.CAPSULE, a, b, 0.0, r, [np.minimum(a, b) - r, np.maximum(a, b) + r], **options
    )


#: Pairs of points at which the slope is measured.
PAIRS = 4096
#: Rounding of float32 may add this to a slope.
SLACK = 1.0e-2


class FunctionDomain(Domain):
    """See `Domain.from_function`."""

    def __init__(self, function: Function, bounds: npt.ArrayLike, lipschitz: float, **options: Any):
        box = checked_numbers(bounds, "bounds", "[2, 3]")
        if box.shape != (2, 3) or not np.isfinite(box).all() or not (box[0] < box[1]).all():
            raise InputError(
                f"bounds are {box.tolist()}; they must be the lowest and the highest corner of a box [2, 3]"
            )
        if not 0.0 < checked_number(lipschitz, "lipschitz") < np.inf:
            raise InputError(f"lipschitz is {shown(lipschitz)}; it must be a positive number")
        if not callable(function):
            raise InputError(f"function is {shown(function)}; it must be a function of points [n, 3], or a wp.Function")
        super().__init__(box, lipschitz, **options)
        self.function = function
        self._kernel = kernels.sampler(function) if isinstance(function, wp.Function) else None
        self.reaches_bounds = self._check()

    def _phi(self, points: wp.array) -> wp.array:
        phi = self._values(points)
        low, high = (wp.vec3(*corner) for corner in self.bounds)
        wp.launch(kernels.clip_to_box, points.size, [points, low, high, self.lipschitz], [phi], device=points.device)
        return phi

    def _values(self, points: wp.array) -> wp.array:
        """The function itself, not cut off."""
        if self._kernel is None:
            values = self._called(points.numpy().astype(np.float64))
            return wp.array(values, dtype=wp.float32, device=points.device)
        phi = wp.empty(points.size, wp.float32, device=points.device)
        wp.launch(self._kernel, points.size, [points], [phi], device=points.device)
        return phi

    def _called(self, points: np.ndarray) -> np.ndarray:
        values = np.asarray(self.function(points))
        if values.shape != (len(points),) or values.dtype.kind not in "fiu":
            raise InputError(
                f"the function gave {values.dtype} of shape {values.shape} for points [{len(points)}, 3]; "
                f"it must give one number for each point"
            )
        return values.astype(np.float32)

    def _check(self) -> bool:
        """Check that the function is finite and not too steep; return whether it is negative at the bounds."""
        rng = np.random.default_rng(0)
        size = np.ptp(self.bounds, axis=0)
        points = self.bounds[0] + rng.random((PAIRS, 3)) * size
        # Steps of all sizes, from the box's size down to a thousandth of it.
        steps = rng.standard_normal((PAIRS, 3)) * size * 10.0 ** rng.uniform(-3.0, 0.0, (PAIRS, 1))
        others = np.clip(points + steps, *self.bounds)
        a, b = (self._values(self._on_device(x)).numpy().astype(np.float64) for x in (points, others))
        bad = np.flatnonzero(~np.isfinite(a))
        if len(bad):
            raise InputError(
                f"the function is {a[bad[0]]} at {points[bad[0]].tolist()}; it must be finite in the bounds"
            )
        apart = np.linalg.norm(points - others, axis=1)
        slopes = np.abs(a - b)[apart > 0] / apart[apart > 0]
        if not slopes.max() <= self.lipschitz * (1.0 + SLACK):
            raise InputError(
                f"the function changes by {slopes.max():.3g} m per metre; lipschitz is {self.lipschitz:g} and must be "
                f"at least that"
            )
        axes, ends = rng.integers(0, 3, PAIRS), rng.integers(0, 2, PAIRS)
        points[np.arange(PAIRS), axes] = self.bounds[ends, axes]
        return bool((self._values(self._on_device(points)).numpy() < -1e-6 * size.max()).any())

    def _details(self) -> list[str]:
        how = "on the device" if self._kernel is not None else "by NumPy"
        cut = [f"the inside reaches the bounds and is cut off there (box of {length(np.ptp(self.bounds[:, 0]))} in x)"]
        return [f"a function, evaluated {how}", *(cut if self.reaches_bounds else [])]


class DomainPair(Domain):
    """Two domains and the way they are combined."""

    outer: float
    inner: float
    word: str

    def __init__(self, first: Domain, second: Domain, bounds: np.ndarray, second_names: tuple[str, ...]):
        names = first.label_names + tuple(name for name in second_names if name not in first.label_names)
        lipschitz = max(first.lipschitz, second.lipschitz)
        super().__init__(bounds, lipschitz, up_axis=first.up_axis, label_names=names, device=first.device)
        self.first = first
        self.second = second

    def _phi(self, points: wp.array) -> wp.array:
        phi = self.first._phi(points)
        other = self.second._phi(points)
        wp.launch(kernels.combine, points.size, [self.outer, phi, self.inner, other], [phi], device=points.device)
        return phi

    def _details(self) -> list[str]:
        return [*self.first._details(), self.word, *self.second._details()]


class UnionDomain(DomainPair):
    """The points in either domain. The label is that of the first domain that holds the point and has one there."""

    outer, inner, word = -1.0, -1.0, "and also"

    def __init__(self, first: Domain, second: Domain):
        lows, highs = np.stack([first.bounds, second.bounds], axis=1)
        super().__init__(first, second, np.stack([lows.min(axis=0), highs.max(axis=0)]), second.label_names)

    def _labels(self, points: wp.array) -> wp.array:
        pair = (self.first, self.second)
        phis = [domain._phi(points) for domain in pair]
        labels = [labels_or_none(domain, points) for domain in pair]
        numbers = [0, *(1 + self.label_names.index(name) for name in self.second.label_names)]
        renumbered = wp.array(numbers, dtype=wp.int32, device=points.device)
        wp.launch(kernels.choose_labels, points.size, [*phis, *labels, renumbered], [labels[0]], device=points.device)
        return labels[0]

    def _part(self, name: str) -> Domain:
        first = self.first.part(name) if name in self.first.label_names else None
        if name not in self.second.label_names:
            return first or self
        rest = self.second.part(name)
        for other in self.first.label_names:
            rest = DifferenceDomain(rest, self.first.part(other))
        return UnionDomain(first, rest) if first else rest


class IntersectionDomain(DomainPair):
    """The points in both domains. Labels are the first's, or the second's if the first has none."""

    outer, inner, word = 1.0, 1.0, "cut to"

    def __init__(self, first: Domain, second: Domain):
        lows, highs = np.stack([first.bounds, second.bounds], axis=1)
        bounds = np.stack([lows.max(axis=0), highs.min(axis=0)])
        if not (bounds[0] < bounds[1]).all():
            raise InputError(
                f"the domains do not meet: one is within {first.bounds.tolist()} m, the other within "
                f"{second.bounds.tolist()} m"
            )
        super().__init__(first, second, bounds, () if first.label_names else second.label_names)

    def _labels(self, points: wp.array) -> wp.array:
        return (self.first if self.first.label_names else self.second)._labels(points)

    def _part(self, name: str) -> Domain:
        one, other = (self.first, self.second) if self.first.label_names else (self.second, self.first)
        return IntersectionDomain(one.part(name), other)


class DifferenceDomain(DomainPair):
    """The points in the first domain but not in the second; the first's labels."""

    outer, inner, word = 1.0, -1.0, "without"

    def __init__(self, first: Domain, second: Domain):
        super().__init__(first, second, first.bounds, ())

    def _labels(self, points: wp.array) -> wp.array:
        return self.first._labels(points)

    def _part(self, name: str) -> Domain:
        return DifferenceDomain(self.first.part(name), self.second)


class NamedDomain(Domain):
    """See `Domain.named`."""

    def __init__(self, body: Domain, name: str):
        if not (isinstance(name, str) and name):
            raise InputError(f"the label name is {shown(name)}; it must be a word")
        super().__init__(body.bounds, body.lipschitz, up_axis=body.up_axis, label_names=(name,), device=body.device)
        self.body = body

    def _phi(self, points: wp.array) -> wp.array:
        return self.body._phi(points)

    def _labels(self, points: wp.array) -> wp.array:
        return wp.full(points.size, 1, wp.int32, device=points.device)

    def _part(self, name: str) -> Domain:
        return self

    def _details(self) -> list[str]:
        return self.body._details()


def labels_or_none(domain: Domain, points: wp.array) -> wp.array:
    """A domain's labels, zeros if it has none."""
    return domain._labels(points) if domain.label_names else wp.zeros(points.size, wp.int32, device=points.device)
