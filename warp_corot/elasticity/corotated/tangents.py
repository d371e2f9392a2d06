"""Stiffnesses of the corotated law that find rotations once for many products."""

from __future__ import annotations

from typing import TYPE_CHECKING

import warp as wp

from warp_corot.elasticity.paths.lanes import as_general
from warp_corot.elasticity.stiffness import ElementStiffness
from warp_corot.elasticity.structs import Kept
from warp_corot.elasticity.tangent import Tangent
from warp_corot.kernels.corotated import kept_exact
from warp_corot.kernels.corotated.kept_gradients import (
    PLACES,
    KeptGradients,
    add_kept_product,
    turn_gradients,
)
from warp_corot.kernels.corotated.tangent import KeptStrains, keep_strains, kept_differential
from warp_corot.kernels.elements.constitutive import IsotropicMaterial
from warp_corot.kernels.elements.elements import ForestElements
from warp_corot.kernels.elements.general_cpu import rest_matrices
from warp_corot.kernels.elements.lanes import LANES
from warp_corot.kernels.subtrees.repair import turn_listed

if TYPE_CHECKING:
    from .elements import CorotatedField


class RotatedTangent(Tangent):
    """The paper's R K R^T with rotations that are found once.

    Attributes:
        rotations: The rotations of the units, mat33 [units].
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


class KeptTangent(Tangent):
    """The same on the CPU, for elements with own rotations: rotated gradients are kept.

    The diagonal is found with a rotation for each element, because solvers with multigrid never need it.
    """

    field: CorotatedField

    def __init__(self, field: CorotatedField):
        super().__init__(field)
        self._rotated = RotatedTangent(field)
        self._take, self._product = turn_gradients(), add_kept_product()
        elements = field.elements
        is_forest = field.discretization.element_kind is ForestElements
        self._general = as_general(elements, rest_matrices, [elements]) if is_forest else elements
        self._count = field.element_count
        self._blocks = -(-self._count // LANES)
        self._gradients = wp.zeros(PLACES * self._blocks, dtype=wp.vec4, device=field.device)
        self._listed = wp.zeros(self._count + 1, dtype=wp.int32, device=field.device)
        self._none = wp.zeros(0, dtype=wp.int32, device=field.device)
        self._material = Kept(_kept_gradients)

    @property
    def kernels(self) -> list[wp.Kernel]:
        return [self._take, self._product]

    def prepare(self, u: wp.array) -> None:
        super().prepare(u)
        self._rotated.prepare(u)

    def take(self, u: wp.array) -> None:
        super().take(u)
        inputs = [self._general, self._count, self.field.isotropic, u]
        self.field.launch(self._take, self._blocks, inputs, [self._gradients, self._listed])
        self.field.launch(turn_listed, 1, [self._general, u], [self._listed, self._gradients])

    def add_product(self, p: wp.array, y: wp.array) -> None:
        material = self._material(self.field.isotropic, self._gradients)
        self.field.launch(self._product, self._blocks, [self._general, self._count, material, p], [y, self._none])

    def add_diagonal(self, blocks: wp.array) -> None:
        self._rotated.take(self.displacements)
        self._rotated.add_diagonal(blocks)


def _kept_gradients(isotropic: IsotropicMaterial, gradients: wp.array) -> KeptGradients:
    material = KeptGradients()
    material.isotropic, material.gradients = isotropic, gradients
    return material


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


class KeptExactTangent(Tangent):
    """The same on the CPU, with all that products need of an element kept, eight elements side by side.

    Args:
        field: The field.
        rotation: As for ``ExactTangent``, which finds the diagonal: solvers with multigrid never need it.
    """

    field: CorotatedField

    def __init__(self, field: CorotatedField, rotation: wp.Function):
        super().__init__(field)
        self._exact = ExactTangent(field, rotation)
        self._keep, self._product = kept_exact.keep_elements(rotation), kept_exact.add_exact_product()
        elements = field.elements
        is_forest = field.discretization.element_kind is ForestElements
        self._general = as_general(elements, rest_matrices, [elements]) if is_forest else elements
        self._count = field.element_count
        self._blocks = -(-self._count // LANES)
        self._kept = wp.zeros(kept_exact.PLACES * self._blocks, dtype=wp.vec4, device=field.device)
        self._numbers = wp.array(ptr=self._kept.ptr, dtype=wp.float32, shape=4 * len(self._kept), device=field.device)
        self._none = wp.zeros(0, dtype=wp.int32, device=field.device)
        self._material = Kept(_kept_gradients)

    def prepare(self, u: wp.array) -> None:
        super().prepare(u)
        self._exact.prepare(u)

    def take(self, u: wp.array) -> None:
        super().take(u)
        self.field.launch(self._keep, self._count, [self._general, u], [self._numbers])

    def add_product(self, p: wp.array, y: wp.array) -> None:
        material = self._material(self.field.isotropic, self._kept)
        self.field.launch(self._product, self._blocks, [self._general, self._count, material, p], [y, self._none])

    def add_diagonal(self, blocks: wp.array) -> None:
        self._exact.take(self.displacements)
        self._exact.add_diagonal(blocks)
