"""Stiffnesses of the corotated law that find rotations once for many products."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, cast

import numpy as np
import warp as wp

from warp_corot.discretization.plan import Batch, Sharing
from warp_corot.elasticity.cpu import as_general
from warp_corot.elasticity.model import Kept
from warp_corot.elasticity.tangents import ElementTangent, Tangent
from warp_corot.kernels.corotated import turned_subtrees as kernels
from warp_corot.kernels.corotated.tangent import (
    EXACT_PLACES,
    PLACES,
    KeptGradients,
    KeptStrains,
    add_exact_product,
    add_kept_product,
    given_differential,
    keep_elements,
    keep_strains,
    kept_differential,
    turn_gradients,
)
from warp_corot.kernels.elements.constitutive import RotatedMaterial
from warp_corot.kernels.elements.cpu import rest_matrices
from warp_corot.kernels.elements.elements import ForestElements, Subtrees
from warp_corot.kernels.elements.simd8 import LANES
from warp_corot.kernels.subtrees.degenerate import turn_listed
from warp_corot.kernels.subtrees.memory import BLOCK

if TYPE_CHECKING:
    from warp_corot.discretization.plan import Plan
    from warp_corot.elasticity.corotated.fields import CorotatedField


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
        self._material_of = Kept(KeptStrains, "isotropic", "rotations", "strains")
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
        return self._material_of(self.field.isotropic, self._rotations, self._strains)


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
        self._keep = keep_elements(rotation) if exact else turn_gradients()
        self._product = add_exact_product() if exact else add_kept_product()
        elements = field.elements
        is_forest = field.discretization.element_kind is ForestElements
        self._general = as_general(elements, rest_matrices, [elements]) if is_forest else elements
        self._count = field.element_count
        self._blocks = -(-self._count // LANES)
        places = (EXACT_PLACES if exact else PLACES) * self._blocks
        self._kept = wp.zeros(places, dtype=wp.vec4, device=field.device)
        self._numbers = wp.array(ptr=self._kept.ptr, dtype=wp.float32, shape=4 * places, device=field.device)
        self._listed = wp.zeros(self._count + 1, dtype=wp.int32, device=field.device)
        self._none = wp.zeros(0, dtype=wp.int32, device=field.device)
        self._material = Kept(KeptGradients, "isotropic", "gradients")

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


# --- R K R^T over complete subtrees, for large uniform bodies on CUDA ------------------------------------------------


#: The number of elements from which on products go over subtrees. On an H200, a product of 1,179,648 elements takes
#: 22 us in place of 73; smaller bodies were not measured.
FEWEST = 1 << 16


class SubtreeTangent(Tangent):
    """R K R^T of a mesh all of whose leaves are in subtrees, with a quaternion for each leaf.

    The diagonal is found with a rotation for each element, because solvers with multigrid never need it.

    Args:
        field: The field; each element has its own rotation.
        batches: The subtrees, from ``subtrees_of``.
    """

    field: CorotatedField

    def __init__(self, field: CorotatedField, batches: Sequence[Batch]):
        super().__init__(field)
        self._rotated, self._batches = RotatedTangent(field), tuple(batches)
        self._places = [with_own_targets(batch, field.device) for batch in batches]
        self._turns = [wp.zeros(8 * batch.count, dtype=wp.vec4, device=field.device) for batch in batches]
        self._keep = kernels.keep_turns(kernels.turned_by(field.model.own_rotation))
        uniform = field.isotropic.stride == 0
        self._products = [kernels.add_subtree_products(b.shape, b.grouped, uniform, False) for b in batches]
        self._block = BLOCK if field.device.is_cuda else 256
        for kernel in self._products:
            wp.load_module(kernel.module, field.device, block_dim=self._block)
        self._no_rows = wp.zeros(1, dtype=wp.vec4, device=field.device)

    def prepare(self, u: wp.array) -> None:
        super().prepare(u)
        self._rotated.prepare(u)

    def take(self, u: wp.array) -> None:
        super().take(u)
        elements = cast("ForestElements", self.field.elements)
        for batch, turns in zip(self._batches, self._turns, strict=True):
            inputs = [batch.count, batch.subtrees.first, elements, u]
            wp.launch(self._keep, (8, batch.count), inputs, [turns], device=self.field.device)

    def add_product(self, p: wp.array, y: wp.array) -> None:
        isotropic = self.field.isotropic
        material = kernels.LeafMaterial()
        material.mu, material.lam, material.most_lambda = isotropic.mu, isotropic.lam, 1e30
        for kernel, batch, places, turns in zip(self._products, self._batches, self._places, self._turns, strict=True):
            inputs = [places, material, turns, self._no_rows, p]
            wp.launch(kernel, batch.count, inputs, [y], device=self.field.device, block_dim=self._block)

    def add_diagonal(self, blocks: wp.array) -> None:
        self._rotated.take(self.displacements)
        self._rotated.add_diagonal(blocks)


def with_own_targets(batch: Batch, device: wp.Device) -> Subtrees:
    """Subtrees with their nodes as targets, for kernels with one thread a subtree."""
    given, found = batch.subtrees, Subtrees()
    found.code, found.first, found.frames, found.size = given.code, given.first, given.frames, given.size
    found.nodes = given.nodes
    if device.is_cpu:
        places = np.ascontiguousarray(given.nodes.numpy()[: batch.count].T)
        found.nodes = wp.array(places, dtype=wp.int32, device=device)
    found.targets = found.nodes
    return found


def subtrees_of(plan: Plan) -> tuple[Batch, ...] | None:
    """The subtrees of a mesh that does not change, if they have all leaves, each with its own rotation; else None."""
    if plan.counts is not None or len(plan.flat) or not plan.batches:
        return None
    if any(batch.sharing is not Sharing.OWN or batch.live is not None for batch in plan.batches):
        return None
    return tuple(plan.batches)
