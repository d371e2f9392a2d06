"""Bodies as signed functions, sampled on the device: the base class of all kinds of domains."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.errors import InputError
from warp_corot.inputs.checks import (
    checked_axis,
    checked_device,
    checked_length,
    checked_numbers,
    checked_points,
    checked_strings,
    shown,
)
from warp_corot.kernels.meshing import domain as kernels

from .units import check_float32, length

#: The shortest step inwards in the search for a body's thickness, relative to its range, and the number of steps.
SPHERE_STEP = 0.04
SPHERES = 25
#: Four directions whose differences give a gradient.
_AROUND = np.array([[1.0, 1.0, 1.0], [1.0, -1.0, -1.0], [-1.0, 1.0, -1.0], [-1.0, -1.0, 1.0]]) / np.sqrt(3.0)


class SignedFunction:
    """The base class of all kinds of bodies; ``Domain``, which users hold, documents the attributes."""

    def __init__(
        self,
        bounds: npt.ArrayLike,
        lipschitz: float,
        *,
        up_axis: str = "Y",
        label_names: Sequence[str] = (),
        device: str | wp.Device | None = None,
    ):
        checked_axis(up_axis)
        self.bounds = np.array(bounds, dtype=np.float64)
        check_float32(self.bounds)
        self.lipschitz = float(lipschitz)
        self.up_axis = up_axis
        self.label_names = checked_strings(label_names, "label_names")
        self.device = checked_device(device)

    def phi(self, points: Any) -> Any:
        """The signed function [m], negative inside.

        Args:
            points: Positions [m]: an array [n, 3], or a Warp array of vec3.

        Returns:
            float32 [n]: a NumPy array for NumPy points, a Warp array on the same device for Warp points.

        Raises:
            InputError: NumPy points have another shape, or are not finite.
        """
        if isinstance(points, wp.array):
            return self._phi(_checked_vec3(points))
        return self._phi(self._on_device(points)).numpy()

    def sampled(self, points: np.ndarray) -> np.ndarray:
        """The signed function [m] at points [..., 3], float64 [...]."""
        return np.asarray(self.phi(points.reshape(-1, 3)), np.float64).reshape(points.shape[:-1])

    def normals(self, points: np.ndarray, apart: np.ndarray) -> np.ndarray:
        """Unit normals at points [..., 3] from differences over lengths [...] [m], outwards, float64 [..., 3]."""
        slopes = self.sampled(points[..., None, :] + apart[..., None, None] * _AROUND) @ _AROUND
        return slopes / np.maximum(np.linalg.norm(slopes, axis=-1, keepdims=True), 1e-300)

    def holds(self, points: npt.ArrayLike) -> np.ndarray:
        """Whether points [n, 3] [m] are inside, bool [n]."""
        return np.asarray(self.phi(points)) < 0.0

    def labels_at(self, points: Any, *, nearest: bool = False) -> Any:
        """The label at each point.

        Args:
            points: As for `phi`.
            nearest: Points outside the body, and in gaps between labels, take the nearest label instead of 0.

        Returns:
            int32 [n], as for `phi`: the label's place in ``label_names`` plus one; 0 outside any.
        """
        given = _checked_vec3(points) if isinstance(points, wp.array) else self._on_device(points)
        if self.label_names:
            labels = self._labels(given)
            if not nearest:
                wp.launch(kernels.clear_labels_outside, given.size, [self._phi(given)], [labels], device=given.device)
        else:
            labels = wp.zeros(given.size, wp.int32, device=given.device)
        return labels if isinstance(points, wp.array) else labels.numpy()

    @property
    def kind(self) -> SignedFunction:
        """The function itself, an object of the class of its kind; for a ``Domain``, the function that it contains."""
        return self

    @property
    def has_pieces(self) -> bool:
        """Whether the body has, or may have, several pieces, which must not be joined by the mesh."""
        return False

    def thickness(
        self, points: npt.ArrayLike, inward: npt.ArrayLike, reach: float, *, outside: bool = False
    ) -> np.ndarray:
        """The thickness of the body at points of its surface: the distance inwards until one leaves it again.

        Args:
            points: Points on or near the surface [n, 3] [m].
            inward: Unit vectors [n, 3].
            reach: The largest thickness that is measured [m].
            outside: Measure outwards instead: the widths of gaps.

        Returns:
            float64 [n] [m].
        """
        side = -1.0 if outside else 1.0
        given, directions = self._on_device(points), self._on_device(side * checked_numbers(inward, "inward", "[n, 3]"))
        if len(given) != len(directions):
            raise InputError(f"inward has {len(directions)} vectors; there must be one for each of {len(given)} points")
        return self._thickness(given, directions, checked_length(reach, "reach"), side).astype(np.float64)

    def exits(self, starts: np.ndarray, ends: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
        """Where segments from inside to outside leave the body, by its triangles; None if it has none.

        Args:
            starts, ends: float64 [n, 3] [m].

        Returns:
            The distances from the starts as shares of the segments, NaN if triangles cannot tell, float64 [n]; and the
            unit normals there [n, 3].
        """
        return None

    def part(self, name: str) -> SignedFunction:
        """The domain of a single label.

        Raises:
            InputError: The domain has no label of this name; the message lists its labels.
        """
        if name in self.label_names:
            return self._part(name)
        there = ", ".join(self.label_names) or "none"
        raise InputError(f"there is no label {shown(name)} in this domain; its labels: {there}")

    def report(self) -> list[str]:
        """A summary, line by line: size, unit, openness, pieces, labels."""
        low, high = self.bounds
        size = " x ".join(length(side) for side in high - low)
        lines = [f"bounds {size}, {self.up_axis} up", *self._details()]
        if self.label_names:
            lines.append(f"labels: {', '.join(self.label_names)}")
        return lines

    def points_in(self, name: str, count: int) -> np.ndarray:
        """Up to ``count`` points with a label, the first near their middle [m], float64 [n, 3]; none if none is known
        without a search."""
        return np.empty((0, 3))

    @property
    def label_volumes(self) -> np.ndarray:
        """The volumes of the labels [m^3], float64 [labels]; NaN if they are not known without a search."""
        return np.full(len(self.label_names), np.nan)

    # Methods that each kind of body defines.

    def _phi(self, points: wp.array) -> wp.array:
        """The function at points: float32 [n] on the points' device [m]."""
        raise NotImplementedError

    def _labels(self, points: wp.array) -> wp.array:
        """Labels int32 [n] on the points' device; outside the body the labels of the nearest part."""
        raise NotImplementedError

    def _thickness(self, points: wp.array, along: wp.array, reach: float, side: float) -> np.ndarray:
        """The thickness of the body for a ``side`` of 1, of the space around it for -1: float32 [n] [m].

        By sphere tracing: each step is the distance within which there can be no surface.
        """
        start, along = points.numpy(), along.numpy()
        gone = np.full(len(start), SPHERE_STEP * reach, np.float32)
        going = np.arange(len(start))
        for _ in range(SPHERES):
            phi = side * self.phi(start[going] + gone[going, None] * along[going])
            inside = phi < 0.0
            going, step = going[inside], np.abs(phi[inside]) / self.lipschitz
            gone[going] += np.maximum(step, SPHERE_STEP * reach)
            going = going[gone[going] < reach]
            if not len(going):
                break
        return np.minimum(gone, reach)

    def _part(self, name: str) -> SignedFunction:
        """The domain of one of its labels."""
        raise NotImplementedError

    def _details(self) -> list[str]:
        return []

    def _on_device(self, points: npt.ArrayLike) -> wp.array:
        given = np.ascontiguousarray(checked_points(points), dtype=np.float32)
        return wp.array(given, dtype=wp.vec3, device=self.device)


def _checked_vec3(points: wp.array) -> wp.array:
    if points.dtype != wp.vec3 or points.ndim != 1:
        found = f"{wp.types.type_repr(points.dtype)} {list(points.shape)}"
        raise InputError(f"points is a Warp array of {found}; it must be of vec3 [n]")
    return points
