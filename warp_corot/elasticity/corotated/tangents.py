"""Stiffnesses of the corotated law that find rotations once for many products."""

from __future__ import annotations

from typing import TYPE_CHECKING

import warp as wp

from warp_corot.elasticity.backends.simd8 import as_general
from warp_corot.elasticity.structs import Kept
from warp_corot.elasticity.tangent import ElementTangent, Tangent
from warp_corot.kernels.corotated import kept_exact
from warp_corot.kernels.corotated.kept_gradients import (
    PLACES,
    KeptGradients,
    add_kept_product,
    turn_gradients,
)
from warp_corot.kernels.corotated.tangent import KeptStrains, given_differential, keep_strains, kept_differential
from warp_corot.kernels.elements.constitutive import IsotropicMaterial, RotatedMaterial
from warp_corot.kernels.elements.elements import ForestElements
from warp_corot.kernels.elements.general_cpu import rest_matrices
from warp_corot.kernels.elements.simd8 import LANES
from warp_corot.kernels.subtrees.repair import turn_listed

if TYPE_CHECKING:
    from .elements import CorotatedField


class RotatedTangent(ElementTangent):
    """The paper's R K R^T with rotations that are found once.

    Attributes:
        rotations: The rotations of the units, mat33 [units].
    """

    field: CorotatedField

    def __init__(self, field: CorotatedField):
        super().__init__(field, given_differential, lambda: field.material_with(self.rotations), RotatedMaterial)
        self.rotations = wp.zeros(0, dtype=wp.mat33, device=field.device)

    def prepare(self, u: wp.array) -> None:
        super().prepare(u)
        if len(self.rotations) != self.field.unit_count:
            self.rotations = wp.zeros(self.field.unit_count, dtype=wp.mat33, device=self.field.device)

    def take(self, u: wp.array) -> None:
        super().take(u)
        self.field.write_rotations(u, self.rotations)


class ExactTangent(ElementTangent):
    """The exact derivative, with each element's own rotation and strain.

    Args:
        field: The field.
        rotation: The device function that finds an element's own rotation.
    """

    field: CorotatedField

    def __init__(self, field: CorotatedField, rotation: wp.Function):
        super().__init__(field, kept_differential, self._kept, KeptStrains)
        self._keep = keep_strains(field.discretization.element_kind, rotation)
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

    def _kept(self) -> KeptStrains:
        material = KeptStrains()
        material.isotropic = self.field.isotropic
        material.rotations, material.strains = self._rotations, self._strains
        return material


class KeptTangent(Tangent):
    """The paper's stiffness or the exact one on the CPU, for elements with own rotations: all that products need of an
    element is kept, eight elements side by side.

    The diagonal is found element by element, because solvers with multigrid never need it.

    Args:
        field: The field.
        exact: Whether it is the exact derivative.
    """

    field: CorotatedField

    def __init__(self, field: CorotatedField, exact: bool):
        super().__init__(field)
        rotation = field.model.own_rotation
        self._diagonal = ExactTangent(field, rotation) if exact else RotatedTangent(field)
        self._exact = exact
        self._keep = kept_exact.keep_elements(rotation) if exact else turn_gradients()
        self._product = kept_exact.add_exact_product() if exact else add_kept_product()
        elements = field.elements
        is_forest = field.discretization.element_kind is ForestElements
        self._general = as_general(elements, rest_matrices, [elements]) if is_forest else elements
        self._count = field.element_count
        self._blocks = -(-self._count // LANES)
        places = (kept_exact.PLACES if exact else PLACES) * self._blocks
        self._kept = wp.zeros(places, dtype=wp.vec4, device=field.device)
        self._numbers = wp.array(ptr=self._kept.ptr, dtype=wp.float32, shape=4 * places, device=field.device)
        self._listed = wp.zeros(self._count + 1, dtype=wp.int32, device=field.device)
        self._none = wp.zeros(0, dtype=wp.int32, device=field.device)
        self._material = Kept(_kept_gradients)

    @property
    def kernels(self) -> list[wp.Kernel]:
        return [self._keep, self._product]

    def prepare(self, u: wp.array) -> None:
        super().prepare(u)
        self._diagonal.prepare(u)

    def take(self, u: wp.array) -> None:
        super().take(u)
        if self._exact:
            self.field.launch(self._keep, self._count, [self._general, u], [self._numbers])
            return
        inputs = [self._general, self._count, self.field.isotropic, u]
        self.field.launch(self._keep, self._blocks, inputs, [self._kept, self._listed])
        self.field.launch(turn_listed, 1, [self._general, u], [self._listed, self._kept])

    def add_product(self, p: wp.array, y: wp.array) -> None:
        material = self._material(self.field.isotropic, self._kept)
        self.field.launch(self._product, self._blocks, [self._general, self._count, material, p], [y, self._none])

    def add_diagonal(self, blocks: wp.array) -> None:
        self._diagonal.take(self.displacements)
        self._diagonal.add_diagonal(blocks)


def _kept_gradients(isotropic: IsotropicMaterial, gradients: wp.array) -> KeptGradients:
    material = KeptGradients()
    material.isotropic, material.gradients = isotropic, gradients
    return material
