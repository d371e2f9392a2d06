"""A dilatation that elements in clusters share (CUDA); see ``kernels.clusters.sharing``."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.elasticity.backends.clusters import ClusterScatter
from warp_corot.elasticity.structs import Kept
from warp_corot.inputs.loading import LoadedKernel
from warp_corot.kernels.clusters.sharing import SharingMaterial, measure_pairs, shared_pressure, sharing_law
from warp_corot.kernels.elements.constitutive import IsotropicMaterial
from warp_corot.kernels.elements.dilatation import Dilatation

from .element_groups import group_numbers


class ClusteredGroups:
    """Groups of elements whose forces a ``ClusterScatter`` adds; from now on it also adds the forces of their
    dilatation.

    Args:
        scatter: Adds the forces.
        elements: Number of elements of the mesh.
        groups: The elements of each group; together they have all elements that the clusters have.
        of: The shared dilatation.
        lam: Gives lambda [Pa] as the elements have it.
    """

    def __init__(
        self,
        scatter: ClusterScatter,
        elements: int,
        groups: Sequence[npt.NDArray[np.int32]],
        of: Dilatation,
        lam: Callable[[], wp.array],
    ):
        self._scatter, self._lam, self._device = scatter, lam, scatter.clusters.elements.device
        listed = group_numbers(groups, elements)[scatter.clusters.elements.numpy()]
        self._listed = wp.array(listed, dtype=wp.int32, device=self._device)
        self._sums = wp.zeros(len(groups), dtype=wp.vec4, device=self._device)
        self._kernel = measure_pairs(scatter.Pairs, of, scatter.layout)
        made = Kept(_sharing_material)
        scatter.use_law(
            sharing_law(scatter.law, of),
            SharingMaterial,
            shared_pressure(of),
            lambda isotropic: made(isotropic, lam(), self._listed, self._sums),
        )

    @property
    def kernel(self) -> LoadedKernel:
        """The kernel of the sums."""
        return self._kernel, self._scatter.layout.threads

    def add_up(self, stride: int, u: wp.array) -> None:
        """Launch the sums of the groups' dilatation at displacements u, before the forces; ``stride`` is lambda's."""
        scatter, threads = self._scatter, self._scatter.layout.threads
        self._sums.zero_()
        inputs = [scatter.clusters, scatter.pairs, self._listed, stride, self._lam(), u]
        size = scatter.count * threads
        wp.launch(self._kernel, size, inputs, [self._sums], device=self._device, block_dim=threads)


def _sharing_material(isotropic: IsotropicMaterial, lam: wp.array, groups: wp.array, sums: wp.array) -> SharingMaterial:
    material = SharingMaterial()
    material.isotropic, material.lam, material.groups, material.sums = isotropic, lam, groups, sums
    return material
