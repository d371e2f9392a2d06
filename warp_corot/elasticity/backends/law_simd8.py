"""Constitutive laws on the CPU: eight subtrees, or eight elements, at a time; see ``kernels.elements.native_laws``."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import warp as wp

from warp_corot.discretization.discretization import Discretization
from warp_corot.discretization.plan import Plan
from warp_corot.elasticity.model import Law, LawField
from warp_corot.inputs.loading import LoadedKernel, load
from warp_corot.kernels.elements.general_cpu import rest_matrices, scatter_law_elements
from warp_corot.kernels.elements.simd8 import LANES
from warp_corot.kernels.subtrees.cpu import scatter_law_subtrees
from warp_corot.mesh import TetForest

from .divided import InLanes
from .mean_dilatation import Dilating
from .simd8 import Lanes, as_general

if TYPE_CHECKING:
    from warp_corot.discretization.discretization import Discretization


class LawSimd8Field(InLanes, LawField):
    """Complete subtrees of a forest as units of work, other elements one by one, eight of each in the lanes.

    Args:
        discretization: On the CPU.
        law: A law that is in C++.
        deterministic: As for every field.
    """

    def __init__(self, discretization: Discretization, law: Law, *, deterministic: bool = False):
        super().__init__(discretization, law, deterministic=deterministic)
        assert law.lanes is not None
        self._law = law.lanes
        self._lanes: Lanes | None = None
        self._lanes_material = self.isotropic
        self.follow()

    def plan_of(self, discretization: Discretization) -> Plan:
        return discretization.plan()

    @property
    def _force_kernels(self) -> list[LoadedKernel]:
        kernels = [self._kernel(shape) for shape, _grouped, _sharing in self.plan.kinds]
        dilating = self._dilating
        return [*kernels, scatter_law_elements(self._law) if dilating is None else dilating.kernel(self._law)]

    def load_kernels(self) -> None:
        load((), self.device, self._force_kernels)

    def _kernel(self, shape: int) -> wp.Kernel:
        return scatter_law_subtrees(shape, self._law, None if self._dilating is None else self._dilating.of)

    def share_dilatation(self, dilating: Dilating) -> bool:
        self._dilating = dilating
        self.derive()
        self.follow()
        return True

    def derive(self) -> None:
        if self._dilating is not None:
            self._dilating.derive(self.isotropic)

    def scatter_forces(self, u: wp.array, f: wp.array) -> None:
        material: Any = self.isotropic
        if self._dilating is not None:
            material = self._dilating.material(material)
        for batch in self.plan.batches:
            inputs, threads = [batch.subtrees, batch.count, material, u], -(-batch.count // LANES)
            self.launch(self._kernel(batch.shape), threads, inputs, [f, batch.flagged])
        if self._lanes is not None:
            self._lanes.scatter_forces(self._lanes_material, u, f)
        if self._dilating is not None:
            self._dilating.scatter_groups(self._law, u, f)

    def follow(self) -> None:
        flat = self.plan.flat
        self._lanes = None
        if self._dilating is not None:
            return
        if not isinstance(self.discretization.mesh, TetForest):
            self._lanes = Lanes(self.elements, self.elements, scatter=scatter_law_elements(self._law))
        elif len(flat):
            self._lanes_material = self.isotropic_of(flat)
            general = flat.general or as_general(flat.elements, rest_matrices, [flat.elements])
            self._lanes = Lanes(general, general, scatter=scatter_law_elements(self._law))
