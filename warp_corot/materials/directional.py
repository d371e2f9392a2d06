"""What materials with directions in rest space share: axes, and numbers of each element that kernels read."""

from __future__ import annotations

from abc import abstractmethod
from typing import ClassVar

import numpy as np
import numpy.typing as npt

from warp_corot.errors import InputError

from .isotropic import Material, place

Array = npt.NDArray[np.float64]

#: The entries of ``Directional.entries`` and of ``frames``, row by row, when elements carry them one by one.
STIFFNESS_ENTRIES = tuple(f"stiffness{n}" for n in range(9))
FRAME_ENTRIES = tuple(f"frame{n}" for n in range(9))


class Directional(Material):
    """A material with three axes at right angles, and up to nine numbers in them.

    Class attributes:
        positive: Which entries must be positive numbers of float32.
    """

    positive: ClassVar[tuple[int, ...]]

    @abstractmethod
    def entries(self) -> Array:
        """The numbers that kernels read of each element, [..., 9]."""

    @abstractmethod
    def fields_of_entries(self, entries: Array) -> dict[str, Array]:
        """The fields that give these ``entries``, [..., 9], by name."""

    @abstractmethod
    def frames(self) -> Array:
        """The axes in rest space as the columns of proper rotations, [..., 3, 3]."""

    @abstractmethod
    def directions_of(self, frames: Array) -> dict[str, Array]:
        """The fields that give these ``frames``, [..., 3, 3], by name."""


def any_across(along: Array) -> Array:
    """A direction at right angles to each of some directions of length one, [..., 3]."""
    # The first is perpendicular to the axis that is farthest from it.
    across = np.cross(along, np.eye(3)[np.abs(along).argmin(axis=-1)])
    return across / np.linalg.norm(across, axis=-1, keepdims=True)


def unit(vectors: Array, name: str) -> Array:
    """Vectors [..., 3] of length one; those of length one are not changed, so that repetition changes nothing.

    Raises:
        InputError: One has length zero.
    """
    largest = np.abs(vectors).max(axis=-1, keepdims=True)
    zero = np.argwhere(largest[..., 0] == 0)
    if len(zero):
        rank = 2 if name == "axes" else 1
        where = place(zero[0][: largest.ndim - rank], largest.shape[: largest.ndim - rank])
        raise InputError(f"{name}{where} has length zero; it must have a nonzero length")
    # Scaling comes first, so that no square overflows or underflows.
    scaled = vectors / largest
    norm = np.linalg.norm(scaled, axis=-1, keepdims=True)
    return np.where(np.abs(largest * norm - 1.0) < 1e-14, vectors, scaled / norm)
