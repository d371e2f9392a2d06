"""The stiffness of a force field at stored displacements, for the many products of an iterative solver."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import warp as wp

if TYPE_CHECKING:
    from .model import ForceField


class Tangent:
    """K(u) of a force field, with the same u from one ``take`` to the next.

    Args:
        field: The field.
        options: The options of ``add_stiffness`` and ``add_diagonal``.

    Attributes:
        displacements: u [m], vec4, with the length of the first one; ``take`` fills it.
    """

    def __init__(self, field: ForceField, **options: Any):
        self.field, self._options = field, options
        self.displacements = wp.zeros(0, dtype=wp.vec4, device=field.device)

    @property
    def kernels(self) -> list[wp.Kernel]:
        """Kernels of factories that products launch; each that is named is loaded beside others."""
        return []

    def prepare(self, u: wp.array) -> None:
        """Allocate memory for displacements like these; not while launches are recorded."""
        if len(self.displacements) != len(u):
            self.displacements = wp.zeros_like(u)

    def take(self, u: wp.array) -> None:
        """Launch the update of K to displacements u."""
        wp.copy(self.displacements, u)

    def add_product(self, p: wp.array, y: wp.array) -> None:
        """Launch y += K p [N]; both vec4 [worlds * N]."""
        self.field.add_stiffness(self.displacements, p, y, **self._options)

    def add_diagonal(self, blocks: wp.array) -> None:
        """Launch the addition of the 3x3 blocks on K's diagonal to those of the nodes [N/m], mat33 [worlds * N]."""
        self.field.add_diagonal(self.displacements, blocks, **self._options)
