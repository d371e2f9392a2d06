"""The stiffness of a force field at stored displacements, for the many products of an iterative solver."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any

import warp as wp

from warp_corot.kernels.elements.constitutive import IsotropicMaterial
from warp_corot.kernels.elements.definite import DefiniteMaterial, definite_differential, keep_definite
from warp_corot.kernels.elements.forces import add_stiffness_diagonal, add_stiffness_product


class Tangent(ABC):
    """K(u) of a force field, with the same u from one ``take`` to the next.

    Args:
        field: The ``ForceField``.

    Attributes:
        displacements: u [m], vec4, with the length of the first one; ``take`` fills it.
    """

    def __init__(self, field: Any):
        self.field = field
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

    @abstractmethod
    def add_product(self, p: wp.array, y: wp.array) -> None:
        """Launch y += K p [N]; both vec4 [worlds * N]."""

    @abstractmethod
    def add_diagonal(self, blocks: wp.array) -> None:
        """Launch the addition of the 3x3 blocks on K's diagonal to those of the nodes [N/m], mat33 [worlds * N]."""


class ElementTangent(Tangent):
    """K of a law, element by element on every path of forces; see ``kernels.elements.forces``.

    Args:
        field: The field.
        differential: Device function (elements, t, material, u, dg) -> dP.
        material: Gives the struct that it reads.
        Material: The type of the struct.
    """

    def __init__(
        self,
        field: Any,
        differential: wp.Function,
        material: Callable[[], Any],
        Material: type = IsotropicMaterial,
    ):
        super().__init__(field)
        self._material = material
        self._generated_from = field.discretization.element_kind, Material, differential

    def add_product(self, p: wp.array, y: wp.array) -> None:
        inputs = [self.field.elements, self._material(), self.displacements, p]
        self.field.launch(add_stiffness_product(*self._generated_from), self.field.element_count, inputs, [y])

    def add_diagonal(self, blocks: wp.array) -> None:
        inputs = [self.field.elements, self._material(), self.displacements]
        self.field.launch(add_stiffness_diagonal(*self._generated_from), 4 * self.field.element_count, inputs, [blocks])


class DefiniteTangent(ElementTangent):
    """K of an isotropic law without the negative parts of each element's; see ``kernels.elements.definite``.

    Args:
        field, differential, material, Material: As for ``ElementTangent``, of the exact differential.
    """

    def __init__(self, field: Any, differential: wp.Function, material: Callable[[], Any], Material: type):
        self._blocks = DefiniteMaterial()
        super().__init__(field, definite_differential, lambda: self._blocks, DefiniteMaterial)
        self._exact = material
        self._keep = keep_definite(field.discretization.element_kind, Material, differential)
        self._count = 0

    def prepare(self, u: wp.array) -> None:
        super().prepare(u)
        count = self.field.element_count
        if self._count != count:
            self._count = count
            self._kept = [
                wp.zeros(count, dtype=dtype, device=self.field.device)
                for dtype in (wp.mat33, wp.mat33, wp.mat33, wp.vec3, wp.vec3)
            ]
            for name, array in zip(("left", "right", "stretches", "shears", "turns"), self._kept, strict=True):
                setattr(self._blocks, name, array)

    def take(self, u: wp.array) -> None:
        super().take(u)
        inputs = [self.field.elements, self._exact(), self.displacements]
        self.field.launch(self._keep, self._count, inputs, self._kept)


class SumTangent(Tangent):
    """The sum of two stiffnesses.

    Args:
        first, second: The two.
    """

    def __init__(self, first: Tangent, second: Tangent):
        super().__init__(second.field)
        self.first, self._both = first, (first, second)

    @property
    def kernels(self) -> list[wp.Kernel]:
        return [kernel for each in self._both for kernel in each.kernels]

    def prepare(self, u: wp.array) -> None:
        super().prepare(u)
        for each in self._both:
            each.prepare(u)

    def take(self, u: wp.array) -> None:
        super().take(u)
        for each in self._both:
            each.take(u)

    def add_product(self, p: wp.array, y: wp.array) -> None:
        for each in self._both:
            each.add_product(p, y)

    def add_diagonal(self, blocks: wp.array) -> None:
        for each in self._both:
            each.add_diagonal(blocks)
