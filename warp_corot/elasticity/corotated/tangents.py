"""Stiffnesses of the corotated law that find rotations once for many products."""

from __future__ import annotations

from typing import TYPE_CHECKING

import warp as wp

from warp_corot.elasticity.stiffness import ElementStiffness
from warp_corot.elasticity.tangent import Tangent
from warp_corot.kernels.corotated.tangent import KeptStrains, keep_strains, kept_differential

if TYPE_CHECKING:
    from .elements import CorotatedField


class RotatedTangent(Tangent):
    """The paper's R K R^T with rotations that are found once.

    Attributes:
        rotations: Of the units, mat33 [units].
    """

    field: CorotatedField

    def __init__(self, field: CorotatedField):
        super().__init__(field)
        self.rotations = wp.zeros(0, dtype=wp.mat33, device=field.device)

    def prepare(self, u: wp.array) -> None:
        super().prepare(u)
        if len(self.rotations) != self.field.unit_count:
            self.rotations = wp.zeros(self.field.unit_count, dtype=wp.mat33, device=self.field.device)

    def take(self, u: wp.array) -> None:
        super().take(u)
        self.field.write_rotations(u, self.rotations)

    def add_product(self, p: wp.array, y: wp.array) -> None:
        stiffness, material = self.field.stiffness_with(self.rotations)
        stiffness.add_product(self.field.elements, material, self.displacements, p, y)

    def add_diagonal(self, blocks: wp.array) -> None:
        stiffness, material = self.field.stiffness_with(self.rotations)
        stiffness.add_diagonal(self.field.elements, material, self.displacements, blocks)


class ExactTangent(Tangent):
    """The exact derivative, with each element's own rotation and strain.

    Args:
        field: The field.
        rotation: The device function that finds an element's own rotation.
    """

    field: CorotatedField

    def __init__(self, field: CorotatedField, rotation: wp.Function):
        super().__init__(field)
        self._keep = keep_strains(field.discretization.element_kind, rotation)
        self._stiffness = ElementStiffness(field.discretization, kept_differential, KeptStrains)
        self._rotations, self._strains = (wp.zeros(0, dtype=wp.mat33, device=field.device) for _ in range(2))

    def prepare(self, u: wp.array) -> None:
        super().prepare(u)
        count = self.field.element_count
        if len(self._rotations) != count:
            self._rotations, self._strains = (wp.zeros(count, dtype=wp.mat33, device=u.device) for _ in range(2))

    def take(self, u: wp.array) -> None:
        super().take(u)
        field = self.field
        field.launch(self._keep, field.element_count, [field.elements, u], [self._rotations, self._strains])

    def add_product(self, p: wp.array, y: wp.array) -> None:
        self._stiffness.add_product(self.field.elements, self._material, self.displacements, p, y)

    def add_diagonal(self, blocks: wp.array) -> None:
        self._stiffness.add_diagonal(self.field.elements, self._material, self.displacements, blocks)

    @property
    def _material(self) -> KeptStrains:
        material = KeptStrains()
        material.isotropic, material.rotations, material.strains = (
            self.field.isotropic,
            self._rotations,
            self._strains,
        )
        return material
