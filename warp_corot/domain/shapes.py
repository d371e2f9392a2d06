"""Domains of formulas, of functions that users write, and of sets of domains."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.domain.domain import Domain, Function
from warp_corot.domain.units import length
from warp_corot.errors import InputError
from warp_corot.inputs.checks import (
    checked_axis,
    checked_length,
    checked_number,
    checked_numbers,
    checked_vector,
    shown,
)
from warp_corot.kernels.meshing import domain as kernels


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
