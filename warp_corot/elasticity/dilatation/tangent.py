"""The stiffness of a law with a shared dilatation at stored displacements: a row for each group."""

from __future__ import annotations

from typing import TYPE_CHECKING

import warp as wp

from warp_corot.elasticity.tangent import ElementTangent, Tangent
from warp_corot.kernels.elements import mean_dilatation
from warp_corot.kernels.elements import mean_dilatation_rows as kernels
from warp_corot.kernels.elements.dilatation import SMALL, VOLUME, not_held

if TYPE_CHECKING:
    from .field import DilatationField


class SharedTangent(Tangent):
    """K of a field whose elements share their dilatation in groups.

    Args:
        field: The field.
        exact: As for ``ForceField.tangent``.
    """

    field: DilatationField

    def __init__(self, field: DilatationField, exact: bool):
        super().__init__(field)
        self.shear = field.shear.tangent(exact=exact)
        # The differential of the gradient of a dilatation acts in each element separately.
        self._turns = (exact or field.of is not VOLUME) and field.of is not SMALL
        own = mean_dilatation.own_differential(field.of), self._material, mean_dilatation.DilatedMaterial
        self._of_elements = ElementTangent(field, *own)
        self._holds = field.of.holding is not not_held
        self._version = -1
        self._shared = wp.zeros(0, dtype=wp.vec4, device=field.device)

    @property
    def kernels(self) -> list[wp.Kernel]:
        return [*self.shear.kernels, kernels.write_rows(self.field.kind, self.field.of)]

    def prepare(self, u: wp.array) -> None:
        super().prepare(u)
        self.shear.prepare(u)
        self._of_elements.displacements = self.displacements
        field, version = self.field, self.field.discretization.sizes.version
        if self._version != version:
            self._version = version
            self._shared = wp.zeros(field.element_count, dtype=wp.vec4, device=field.device)
            self._members = field.members()
            self._rows = kernels.GroupRows()
            self._rows.rows = wp.zeros(self._members.entries, dtype=wp.vec4, device=field.device)
            self._rows.factors = wp.zeros(self._members.count, dtype=wp.vec2, device=field.device)

    def take(self, u: wp.array) -> None:
        super().take(u)
        self.shear.take(u)
        field = self.field
        inputs = [field.elements, field.isotropic, self.displacements, self._members.arrays]
        outputs = [self._rows, self._shared]
        field.launch(kernels.write_rows(field.kind, field.of), self._members.count, inputs, outputs)

    def add_product(self, p: wp.array, y: wp.array) -> None:
        self.shear.add_product(p, y)
        field = self.field
        lanes = kernels.THREADS if field.device.is_cuda else 1
        groups, count = [self._members.arrays, self._rows], self._members.count
        field.launch(kernels.add_row_products, lanes * count, [lanes, *groups, p], [y])
        if self._turns:
            self._of_elements.add_product(p, y)
        elif self._holds:
            inputs = [field.elements, self.displacements, p, *groups, self._shared]
            field.launch(kernels.add_held(field.kind, field.of), count, inputs, [y])

    def add_diagonal(self, blocks: wp.array) -> None:
        self.shear.add_diagonal(blocks)
        field = self.field
        field.launch(kernels.add_row_blocks, self._members.count, [self._members.arrays, self._rows], [blocks])
        if self._turns or self._holds:
            self._of_elements.add_diagonal(blocks)

    def _material(self) -> mean_dilatation.DilatedMaterial:
        material = mean_dilatation.DilatedMaterial()
        material.isotropic, material.shared = self.field.isotropic, self._shared
        material.turning = float(self._turns)
        return material
