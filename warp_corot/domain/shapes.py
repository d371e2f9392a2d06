"""Shapes with a formula for the distance."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp

from warp_corot.errors import InputError
from warp_corot.inputs.checks import checked_axis, checked_length, checked_vector
from warp_corot.kernels.meshing import domain as kernels

from .signed import SignedFunction
from .units import length


class ShapeDomain(SignedFunction):
    """A shape that one kernel evaluates; its distance is exact."""

    def __init__(self, kernel: wp.Kernel, numbers: Sequence[Any], bounds: Any, **options: Any):
        super().__init__(bounds, 1.0, **options)
        self.kernel = kernel
        self.numbers = tuple(numbers)

    def _phi(self, points: wp.array) -> wp.array:
        phi = wp.empty(points.size, wp.float32, device=points.device)
        wp.launch(self.kernel, points.size, [points, *self.numbers], [phi], device=points.device)
        return phi

    def _details(self) -> list[str]:
        size = " x ".join(length(edge) for edge in np.ptp(self.bounds, axis=0))
        return [f"a {type(self).__name__.removesuffix('Domain').lower()}, {size}"]


class SphereDomain(ShapeDomain):
    """See `Domain.sphere`."""

    def __init__(self, radius: float, centre: Sequence[float], **options: Any):
        r, c = checked_length(radius, "radius"), checked_vector(centre, "centre")
        super().__init__(kernels.evaluate_sphere, [wp.vec3(*c), r], [c - r, c + r], **options)


class BoxDomain(ShapeDomain):
    """See `Domain.box`."""

    def __init__(self, lower: Sequence[float], upper: Sequence[float], **options: Any):
        low, high = checked_vector(lower, "lower"), checked_vector(upper, "upper")
        if not (low < high).all():
            raise InputError(f"the box from {low.tolist()} to {high.tolist()} is empty; lower must be below upper")
        super().__init__(kernels.evaluate_box, [wp.vec3(*low), wp.vec3(*high)], [low, high], **options)


class TorusDomain(ShapeDomain):
    """See `Domain.torus`."""

    def __init__(self, major: float, minor: float, centre: Sequence[float], axis: str, **options: Any):
        ring, tube = checked_length(major, "major"), checked_length(minor, "minor")
        if tube >= ring:
            raise InputError(f"the torus has minor {tube:g} m and major {ring:g} m; minor must be smaller")
        c, along = checked_vector(centre, "centre"), np.eye(3)["XYZ".index(checked_axis(axis, "axis"))]
        reach = (ring + tube) * (1.0 - along) + tube * along
        numbers = [wp.vec3(*c), wp.vec3(*along), ring, tube]
        super().__init__(kernels.evaluate_torus, numbers, [c - reach, c + reach], **options)


class CapsuleDomain(ShapeDomain):
    """See `Domain.capsule`."""

    def __init__(self, start: Sequence[float], end: Sequence[float], radius: float, **options: Any):
        a, b, r = checked_vector(start, "start"), checked_vector(end, "end"), checked_length(radius, "radius")
        if np.linalg.norm(b - a) <= 1e-6 * r:
            raise InputError(f"the capsule begins and ends at {a.tolist()}; its ends must differ (or take a sphere)")
        bounds = [np.minimum(a, b) - r, np.maximum(a, b) + r]
        super().__init__(kernels.evaluate_capsule, [wp.vec3(*a), wp.vec3(*b), r], bounds, **options)
