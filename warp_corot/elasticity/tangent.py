"""The stiffness of a force field at displacements that are kept, for the many products of an iterative solver."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import warp as wp

if TYPE_CHECKING:
    from .model import ForceField


class Tangent:
    """K(u) of a force field, where u stays the same from one ``take`` to the next.

    Args:
        field: The field.
        options: Of its ``add_stiffness`` and ``add_diagonal``.

    Attributes:
        displacements: u [m], vec4, as long as the first one that was taken; filled by ``take``.
    """

    def __init__(self, field: ForceField, **options: Any):
        self.field, self._options = field, options
        self.displacements = wp.zeros(0, dtype=wp.vec4, device=field.device)

    def prepare(self, u: wp.array) -> None:
        """Make room for displacements like these; not while launches are recorded."""
        if len(self.displacements) != len(u):
            self.displacements = wp.zeros_like(u)

    def take(self, u: wp.array) -> None:
        """Launch that K is the one at displacements u from now on."""
        wp.copy(self.displacements, u)

    def add_product(self, p: wp.array, y: wp.array) -> None:
        """Launch y += K p [N]; both vec4 [worlds * N]."""
        self.field.add_stiffness(self.displacements, p, y, **self._options)

    def add_diagonal(self, blocks: wp.array) -> None:
        """Launch that the 3x3 blocks on K's diagonal are added to those of the nodes [N/m], mat33 [worlds * N]."""
        self.field.add_diagonal(self.displacements, blocks, **self._options)
