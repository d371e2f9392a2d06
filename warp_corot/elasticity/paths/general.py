"""Single elements on CUDA whose forces may be summed in any order, in clusters; see ``kernels.clusters.single``."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warp_corot.discretization.clusters.single import order_in_clusters
from warp_corot.discretization.elements import in_worlds
from warp_corot.elasticity.corotated.elements import CorotatedOptions, LeafField
from warp_corot.elasticity.model import LawField
from warp_corot.inputs.loading import LoadedKernel
from warp_corot.kernels.clusters.laws import isotropic_law
from warp_corot.kernels.elements.general_cuda import corotated_law
from warp_corot.mesh import TetForest

from .clusters import ClusterScatter

if TYPE_CHECKING:
    from collections.abc import Sequence

    from warp_corot.discretization.discretization import Discretization
    from warp_corot.discretization.subtrees import Batch


def clustered(discretization: Discretization) -> np.ndarray:
    """A body's elements, of all worlds, in the order of clusters: int32 [worlds * T]."""
    mesh = discretization.mesh
    if isinstance(mesh, TetForest):
        return np.arange(discretization.worlds * len(mesh.tets), dtype=np.int32)
    return in_worlds(order_in_clusters(mesh.points, mesh.tets), discretization.worlds, len(mesh.tets))


class LawGeneralField(LawField):
    """A law on single elements whose forces may be summed in any order.

    Args:
        discretization: A general mesh, or a forest with few groups of subtrees.
        stress, functions: The law, as for ``LawField``.
        deterministic: False; slots of elements are not shared, so nothing is summed.
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
        self._scatter = ClusterScatter(self.elements, isotropic_law(stress), chosen=clustered(discretization))

    @property
    def _force_kernels(self) -> list[LoadedKernel]:
        return [self._scatter.kernel]

    @property
    def in_clusters(self) -> tuple[ClusterScatter, Sequence[Batch]]:
        return self._scatter, ()

    def scatter_forces(self, u: wp.array, f: wp.array) -> None:
        self._scatter(self.isotropic, u, f)


class CorotatedGeneralField(LeafField):
    """The corotated law with own rotations on general elements whose forces may be summed in any order."""

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
