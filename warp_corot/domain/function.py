"""Domains of functions that users write."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.errors import InputError
from warp_corot.inputs.checks import checked_number, checked_numbers, shown
from warp_corot.kernels.meshing import domain as kernels

from .signed import SignedFunction
from .units import length

#: A user's function or a Warp function; type checkers do not know the latter's type.
Function = Callable[[np.ndarray], npt.ArrayLike]

#: Pairs of points at which the slope is measured.
PAIRS = 4096
#: Rounding of float32 may add this to a slope.
SLACK = 1.0e-2


class FunctionDomain(SignedFunction):
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
