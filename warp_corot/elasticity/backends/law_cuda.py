"""Laws that need no rotation on CUDA: subtrees, clusters, and elements one by one."""

from __future__ import annotations

from typing import TYPE_CHECKING

import warp as wp

from warp_corot.discretization.discretization import Discretization
from warp_corot.discretization.plan import Plan
from warp_corot.elasticity.model import Law, LawField
from warp_corot.inputs.loading import LoadedKernel, load
from warp_corot.kernels.clusters.laws import isotropic_law
from warp_corot.kernels.subtrees.laws import scatter_subtrees
from warp_corot.kernels.subtrees.memory import BLOCK

from .clusters import divided

if TYPE_CHECKING:
    from collections.abc import Sequence

    from warp_corot.discretization.subtrees import Batch

    from .clusters import ClusterScatter


class LawCudaField(LawField):
    """Complete subtrees in batches, and other elements in clusters or one by one, under the same law.

    Args:
        discretization: A mesh on CUDA.
        law, deterministic: As for ``LawField``.
    """

    def __init__(self, discretization: Discretization, law: Law, *, deterministic: bool = False):
        super().__init__(discretization, law, deterministic=deterministic)
        self._uniform = discretization.material_stride == 0
        self.follow()

    def plan_of(self, discretization: Discretization) -> Plan:
        subtrees = self.deterministic or discretization.prefers_subtrees
        return discretization.plan(subtrees=subtrees, deterministic=self.deterministic)

    @property
    def _force_kernels(self) -> list[LoadedKernel]:
        of_subtrees: list[LoadedKernel] = [(kernel, BLOCK) for kernel in self._kernels]
        if self._clusters is not None:
            return [*of_subtrees, self._clusters.kernel]
        return of_subtrees if self._batches and not len(self.plan.flat) else [*of_subtrees, self._forces]

    def load_kernels(self) -> None:
        kernels = [self._kernel(shape, grouped) for shape, grouped, _sharing in self.plan.kinds]
        load((), self.device, [self._forces, *((kernel, BLOCK) for kernel in kernels)])

    def follow(self) -> None:
        self._batches, self._clusters = divided(self.discretization, self.plan, isotropic_law(self.law.stress))
        self._kernels = [self._kernel(batch.shape, batch.grouped) for batch in self._batches]
        self._flat_material = self.isotropic_of(self.plan.flat)

    @property
    def in_clusters(self) -> tuple[ClusterScatter, Sequence[Batch]] | None:
        return None if self._clusters is None else (self._clusters, self._batches)

    def _kernel(self, shape: int, grouped: bool) -> wp.Kernel:
        return scatter_subtrees(shape, grouped, self._uniform, self.law.stress)

    def scatter_forces(self, u: wp.array, f: wp.array) -> None:
        isotropic, flat = self.isotropic, self.plan.flat
        for batch, kernel in zip(self._batches, self._kernels, strict=True):
            inputs = [batch.subtrees, isotropic, u]
            wp.launch(kernel, batch.count, inputs=inputs, outputs=[f], device=self.device, block_dim=BLOCK)
        if self._clusters is not None:
            self._clusters(isotropic, u, f)
        elif len(flat):
            self.launch(self._forces, len(flat), [flat.elements, self._flat_material, u], [f])
        elif not self._batches:
            super().scatter_forces(u, f)
