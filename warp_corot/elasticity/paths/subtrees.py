"""The subtree kernels of laws that need no rotation (CUDA): linear, St. Venant-Kirchhoff, neo-Hookean."""

from __future__ import annotations

from typing import TYPE_CHECKING

import warp as wp

from warp_corot.discretization.discretization import Discretization
from warp_corot.discretization.plan import Plan
from warp_corot.elasticity.model import LawField
from warp_corot.inputs.loading import LoadedKernel, load
from warp_corot.kernels.clusters.laws import isotropic_law
from warp_corot.kernels.subtrees import cuda as subtree_cuda
from warp_corot.kernels.subtrees.laws import scatter_subtrees

from .clusters import others_in_clusters

if TYPE_CHECKING:
    from collections.abc import Sequence

    from warp_corot.discretization.subtrees import Batch

    from .clusters import ClusterScatter


class LawSubtreeField(LawField):
    """Complete subtrees in batches, and other leaves one by one, under the same law. If the mesh never changes, the
    other leaves and the subtrees outside groups go in clusters.

    Args:
        discretization: A forest on CUDA.
        stress, functions: The law, as for ``LawField``.
        deterministic: As for every field.
    """

    def __init__(
        self,
        discretization: Discretization,
        *,
        stress: wp.Function,
        deterministic: bool = False,
        **functions: wp.Function,
    ):
        super().__init__(discretization, stress=stress, deterministic=deterministic, **functions)
        self._stress = stress
        self._uniform = discretization.material_stride == 0
        self.follow()

    def plan_of(self, discretization: Discretization) -> Plan:
        return discretization.plan(deterministic=self.deterministic)

    @property
    def _force_kernels(self) -> list[LoadedKernel]:
        of_subtrees: list[LoadedKernel] = [(kernel, subtree_cuda.BLOCK) for kernel in self._kernels]
        of_subtrees += [] if self._flat is None else [self._forces]
        return [*of_subtrees, *([] if self._clusters is None else [self._clusters.kernel])]

    def load_kernels(self) -> None:
        kernels = [self._kernel(shape, grouped) for shape, grouped, _sharing in self.plan.kinds]
        load((), self.device, [self._forces, *((kernel, subtree_cuda.BLOCK) for kernel in kernels)])

    def follow(self) -> None:
        self._batches, self._flat, self._clusters = others_in_clusters(self.plan, isotropic_law(self._stress))
        self._kernels = [self._kernel(batch.shape, batch.grouped) for batch in self._batches]
        self._flat_material = self.isotropic_of(self.plan.flat)

    @property
    def in_clusters(self) -> tuple[ClusterScatter, Sequence[Batch]] | None:
        return None if self._clusters is None else (self._clusters, self._batches)

    def _kernel(self, shape: int, grouped: bool) -> wp.Kernel:
        return scatter_subtrees(shape, grouped, self._uniform, self._stress)

    def scatter_forces(self, u: wp.array, f: wp.array) -> None:
        discretization, flat = self.discretization, self._flat
        for batch, kernel in zip(self._batches, self._kernels, strict=True):
            inputs = [batch.subtrees, discretization.mu, discretization.lam, u]
            wp.launch(kernel, batch.count, inputs=inputs, outputs=[f], device=self.device, block_dim=subtree_cuda.BLOCK)
        if flat is not None:
            self.launch(self._forces, len(flat), [flat.elements, self._flat_material, u], [f])
        if self._clusters is not None:
            self._clusters(self.isotropic, u, f)
