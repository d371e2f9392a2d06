"""The colour map of stresses: light for none, dark for much, perceptually uniform."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from warp_corot.mesh.topology import signed_volumes

# Seventeen evenly spaced colours of Matplotlib's "magma" (CC0) from 0.97 down to 0.25, sRGB. The ends, near-black and
# near-white, are left out, so that a shaded body keeps its shape in every colour.
_MAGMA = (
    "fcf0b2 fdda9c fec68a feb078 fd9b6b fb8560 f7705c ee5b5e e24d66 "
    "d0416f bf3a77 ab337c 992d80 862781 752181 621980 51127c"
)
COLORMAP_NAME = "magma, reversed"
TISSUE = (0.94, 0.74, 0.64)
"""Colour of a body without stresses, sRGB."""
STEEL = (0.62, 0.67, 0.74)
"""Colour of rigid obstacles, sRGB."""


def stress_colors(count: int = 256) -> NDArray[np.float64]:
    """The colour map as a table, sRGB in 0..1, float64 [count, 3]; row 0 stands for no stress."""
    knots = np.array([[int(word[i : i + 2], 16) / 255.0 for i in (0, 2, 4)] for word in _MAGMA.split()])
    at = np.linspace(0.0, len(knots) - 1.0, count)
    return np.stack([np.interp(at, np.arange(len(knots)), channel) for channel in knots.T], axis=1)


def color_index(values: ArrayLike, lowest: float, highest: float, count: int = 256) -> NDArray[np.int32]:
    """Rows of a table of ``count`` colours: ``lowest`` → 0, ``highest`` → last, clamped; NaN → last."""
    scaled = (np.asarray(values, dtype=np.float64) - lowest) * (1.0 / max(highest - lowest, 1e-30))
    scaled = np.where(np.isfinite(scaled), scaled, 1.0)
    return np.rint(np.clip(scaled, 0.0, 1.0) * (count - 1)).astype(np.int32)


def srgb_to_linear(color: ArrayLike) -> NDArray[np.float64]:
    """Linear light from sRGB values in 0..1 (IEC 61966-2-1), the encoding of OpenUSD's ``displayColor``."""
    c = np.asarray(color, dtype=np.float64)
    return np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)


_ROUND_STEPS = (1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0)


def round_limit(value: float) -> float:
    """The smallest of 1, 1.5, 2, 3, 4, 5, 6, 8 × 10ᵏ not below ``value``; 0 unless that is positive and finite."""
    if not np.isfinite(value) or value <= 0.0:
        return 0.0
    power = 10.0 ** np.floor(np.log10(value))
    return float(next(step * power for step in _ROUND_STEPS if step * power >= value * (1.0 - 1e-9)))


class VertexAverage:
    """Averages values [T] of tetrahedra over the tetrahedra around each node, weighted (with their volumes), to [N]."""

    def __init__(self, tets: NDArray[np.int32], weights: NDArray[np.float64], nodes: int):
        self._corners = [np.ascontiguousarray(corner) for corner in np.transpose(tets)]
        self._weights = np.asarray(weights, dtype=np.float64)
        self._nodes = nodes
        total = self._sums(self._weights)
        self._inverse = 1.0 / np.where(total > 0.0, total, 1.0)

    @classmethod
    def of(cls, mesh: Any) -> VertexAverage:
        """The average of a mesh with points [N, 3] and tetrahedra [T, 4], weighted with their volumes."""
        return cls(mesh.tets, np.abs(signed_volumes(mesh.points, mesh.tets)), len(mesh.points))

    def __call__(self, values: ArrayLike) -> NDArray[np.float64]:
        return self._sums(np.asarray(values, dtype=np.float64) * self._weights) * self._inverse

    def _sums(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.sum([np.bincount(corner, values, minlength=self._nodes) for corner in self._corners], axis=0)
