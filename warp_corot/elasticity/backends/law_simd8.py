"""Constitutive laws on the CPU: eight subtrees, or eight elements, at a time; see ``kernels.elements.native_laws``."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import warp as wp

from warp_corot.discretization.discretization import Discretization
from warp_corot.discretization.plan import Plan
from warp_corot.elasticity.model import Law, LawField
from warp_corot.inputs.loading import LoadedKernel, load
from warp_corot.kernels.elements.simd8 import LANES
from warp_corot.kernels.subtrees.cpu import scatter_law_subtrees

from .in_lanes import InLanes

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
        self.lanes_law = law.lanes
        self.follow()

    def plan_of(self, discretization: Discretization) -> Plan:
        return discretization.plan()

    @property
    def _force_kernels(self) -> list[LoadedKernel]:
        return [*(self._kernel(shape) for shape, _grouped, _sharing in self.plan.kinds), *self.other_kernels]

    def load_kernels(self) -> None:
        load((), self.device, self._force_kernels)

    def _kernel(self, shape: int) -> wp.Kernel:
        return scatter_law_subtrees(shape, self.lanes_law, None if self._dilating is None else self._dilating.of)

    def scatter_forces(self, u: wp.array, f: wp.array) -> None:
        material: Any = self.isotropic
        if self._dilating is not None:
            material = self._dilating.material(material)
        for batch in self.plan.batches:
            inputs, threads = [batch.subtrees, batch.count, material, u], -(-batch.count // LANES)
            self.launch(self._kernel(batch.shape), threads, inputs, [f, batch.flagged])
        self.scatter_others(u, f)
