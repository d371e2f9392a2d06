"""The stiffness of tension beside the corotated R K R^T; see ``kernels.corotated.tension``."""

from __future__ import annotations

from typing import TYPE_CHECKING

import warp as wp

from warp_corot.elasticity.added_stress import AddedStressField
from warp_corot.elasticity.corotated.fields import CorotatedField
from warp_corot.elasticity.dilatation import SharedTangent, law_of
from warp_corot.elasticity.tangents import SumTangent
from warp_corot.inputs.cpu_threads import Regions
from warp_corot.kernels.corotated import tension as kernels
from warp_corot.kernels.elements.simd8 import LANES

if TYPE_CHECKING:
    from warp_corot.elasticity import ForceField
    from warp_corot.elasticity.tangents import Tangent


class Tension:
    """The stiffness of the elements whose tension counts in a step, for many products at the same displacements.

    Args:
        field: A field of corotated elements.
        tangent: Its R K R^T; what it keeps is found before.
        mass: Of the nodes [kg], float32.
        scales: Those of the operator, see ``TangentOperator``.

    Attributes:
        taut: Nonzero for elements that count, uint8 [T].
        twists, swells: Their Theta and p S in world axes [Pa], mat33 [T]; ``swells`` is empty if no pressure is shared.
    """

    def __init__(self, field: ForceField, tangent: Tangent, mass: wp.array, scales: wp.array):
        self._field, self._tangent, self._mass, self._scales = field, tangent, mass, scales
        self._law, _ = law_of(field)
        self._device, self._kind = field.device, field.discretization.element_kind
        self._regions = Regions(field.discretization.team, field.device)
        self._none = wp.zeros(0, dtype=wp.vec4, device=field.device)
        self.taut = wp.zeros(0, dtype=wp.uint8, device=field.device)
        self.prepare()

    @classmethod
    def of(cls, field: ForceField, tangent: Tangent, mass: wp.array, scales: wp.array) -> Tension | None:
        """That of a field whose tangent is the paper's, otherwise None."""
        while isinstance(field, AddedStressField):
            assert isinstance(tangent, SumTangent)
            field, tangent = field.law, tangent.first
        is_corotated = isinstance(law_of(field)[0], CorotatedField)
        return cls(field, tangent, mass, scales) if is_corotated else None

    @property
    def kernels(self) -> list[wp.Kernel]:
        """Kernels of factories that it launches."""
        on_cpu, on_cuda = (kernels.find_taut8, kernels.add_taut_product8), (kernels.find_taut, kernels.add_taut_product)
        factories = on_cpu if self._device.is_cpu else on_cuda
        return [make(self._kind) for make in (*factories, kernels.add_taut_diagonal)]

    def prepare(self) -> None:
        """Make room for the present elements; not while launches are recorded."""
        count = self._field.element_count
        if len(self.taut) != count:
            device = self._device
            self.taut = wp.zeros(count, dtype=wp.uint8, device=device)
            counts = count, count, count * self._field.shares_dilatation
            self._turns, self.twists, self.swells = (wp.zeros(n, dtype=wp.mat33, device=device) for n in counts)

    def take(self, u: wp.array) -> None:
        """Launch the update to displacements u [m], vec4, for which the tangent has been taken."""
        field, law = self._field, self._law
        elements, tangent = field.discretization.elements, self._tangent
        shared = tangent.shared if isinstance(tangent, SharedTangent) else self._none

        inputs = [elements, law.isotropic, field.isotropic, shared, self._mass, self._scales, u]
        outputs, count = [self.taut, self._turns, self.twists, self.swells], field.element_count
        if self._device.is_cpu:
            kernel, key = kernels.find_taut8(self._kind), (u.ptr, shared.ptr)
            self._regions.launch_from(kernel, -(-count // LANES), [0, count, *inputs], outputs, *key)
        else:
            field.launch(kernels.find_taut(self._kind), count, inputs, outputs)

    def add_product(self, p: wp.array, y: wp.array) -> None:
        """Launch y += K p [N]; both vec4 [worlds * N]."""
        count, elements = self._field.element_count, self._field.discretization.elements
        inputs = [self.taut, self._turns, self.twists, self.swells, p]
        if self._device.is_cpu:
            kernel = kernels.add_taut_product8(self._kind)
            self._field.launch(kernel, -(-count // LANES), [elements, count, *inputs], [y])
        else:
            self._field.launch(kernels.add_taut_product(self._kind), count, [elements, *inputs], [y])

    def add_diagonal(self, blocks: wp.array) -> None:
        """Launch the addition of the 3x3 blocks on K's diagonal to those of the nodes [N/m], mat33 [worlds * N]."""
        count, inputs = self._field.element_count, [self.taut, self._turns, self.twists]
        kernel = kernels.add_taut_diagonal(self._kind)
        self._field.launch(kernel, 4 * count, [self._field.discretization.elements, *inputs], [blocks])
