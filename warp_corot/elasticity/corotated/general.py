"""The corotated law on CUDA on elements in clusters, whose forces may be summed in any order."""

from __future__ import annotations

from typing import TYPE_CHECKING

import warp as wp

from warp_corot.elasticity.backends.clusters import ClusterScatter, clustered
from warp_corot.inputs.loading import LoadedKernel
from warp_corot.kernels.clusters.laws import isotropic_law
from warp_corot.kernels.elements.general_cuda import corotated_law

from .elements import LeafField

if TYPE_CHECKING:
    from collections.abc import Sequence

    from warp_corot.discretization.discretization import Discretization
    from warp_corot.discretization.subtrees import Batch

    from .options import CorotatedOptions


class CorotatedGeneralField(LeafField):
    """General elements with own rotations."""

    def __init__(self, discretization: Discretization, model: CorotatedOptions):
        super().__init__(discretization, model, deterministic=False)
        law = isotropic_law(corotated_law(model.own_rotation))
        self._scatter = ClusterScatter(self.elements, law, chosen=clustered(discretization))

    @property
    def _force_kernels(self) -> list[LoadedKernel]:
        return [self._scatter.kernel]

    @property
    def in_clusters(self) -> tuple[ClusterScatter, Sequence[Batch]]:
        return self._scatter, ()

    def scatter_forces(self, u: wp.array, f: wp.array) -> None:
        self._scatter(self.isotropic, u, f)
