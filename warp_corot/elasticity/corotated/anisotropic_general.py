"""Anisotropic general tetrahedra on CUDA, in clusters; see ``kernels.clusters.pairs``."""

from __future__ import annotations

from typing import TYPE_CHECKING

import warp as wp

from warp_corot.elasticity.paths.clusters import ClusterScatter
from warp_corot.elasticity.paths.general import clustered
from warp_corot.kernels.clusters.laws import ActiveMaterial, anisotropic_law
from warp_corot.kernels.corotated.anisotropic import OrthotropicMaterial
from warp_corot.kernels.corotated.definite import quaternions_of
from warp_corot.kernels.math.rotation import quick_rotation
from warp_corot.kernels.tables.cluster_layout import ANISOTROPIC
from warp_corot.materials.anisotropic import TransverselyIsotropic

from .anisotropic import AnisotropicField

if TYPE_CHECKING:
    from warp_corot.discretization.discretization import Discretization


class GeneralAnisotropicField(AnisotropicField):
    """Single elements whose forces may be summed in any order.

    Args:
        discretization: A general mesh, or a forest with few groups of subtrees, with an ``Anisotropic`` material.
    """

    def __init__(self, discretization: Discretization):
        super().__init__(discretization, quick_rotation, deterministic=False)
        axes = self.material.axes
        law = anisotropic_law(isinstance(discretization.material, TransverselyIsotropic))
        self.scatter = ClusterScatter(
            self.elements, law, ActiveMaterial, chosen=clustered(discretization), layout=ANISOTROPIC
        )
        self._quaternions = wp.empty(len(axes), dtype=wp.quat, device=self.device)
        self.launch(quaternions_of, len(axes), [axes], [self._quaternions])

    def scatter_forces(self, u: wp.array, f: wp.array) -> None:
        self.scatter(self.active_material, u, f)

    @property
    def active_material(self) -> ActiveMaterial:
        """The material with the present active stress, in the form that the kernel reads."""
        return active_material(self.material, self._quaternions, *self._activation)


def active_material(
    passive: OrthotropicMaterial, axes: wp.array, is_active: int, activation: wp.array
) -> ActiveMaterial:
    """``kernels.clusters.laws.ActiveMaterial`` from its parts."""
    material = ActiveMaterial()
    material.passive, material.axes = passive, axes
    material.is_active, material.activation = is_active, activation
    return material
