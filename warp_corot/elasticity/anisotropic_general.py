"""Anisotropic general tetrahedra on CUDA, in clusters; see ``kernels.pair_clusters``."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import warp as wp

from ..anisotropy import TransverselyIsotropic
from ..kernels.cluster_laws import ActiveMaterial, anisotropic_law
from ..kernels.cluster_layout import ANISOTROPIC
from ..kernels.definite import quaternions_of
from ..kernels.rotation import quick_rotation
from .anisotropic import AnisotropicField
from .cluster_scatter import ClusterScatter
from .law_general import clustered

if TYPE_CHECKING:
    from ..body import SoftBody


class GeneralAnisotropicField(AnisotropicField):
    """Single elements whose forces need no settled order.

    Args:
        body: Of an ``Anisotropic`` material; a general mesh's, or of a forest that has few groups of subtrees.
    """

    def __init__(self, body: SoftBody):
        super().__init__(body, quick_rotation, deterministic=False)
        axes = self.material.axes
        law = anisotropic_law(isinstance(body.material, TransverselyIsotropic))
        self.scatter = ClusterScatter(self.elements, law, ActiveMaterial, chosen=clustered(body), layout=ANISOTROPIC)
        self._quaternions = wp.empty(len(axes), dtype=wp.quat, device=self.device)
        self.launch(quaternions_of, len(axes), [axes], [self._quaternions])

    def scatter_forces(self, u: wp.array, f: wp.array) -> None:
        self.scatter(self.active_material, u, f)

    @property
    def active_material(self) -> Any:
        """The material with the present active stress, as the kernel takes it."""
        return active_material(self.material, self._quaternions, *self._activation)


def active_material(passive: Any, axes: wp.array, is_active: int, activation: wp.array) -> Any:
    """``kernels.cluster_laws.ActiveMaterial`` of its parts."""
    material = ActiveMaterial()
    material.passive, material.axes = passive, axes
    material.is_active, material.activation = is_active, activation
    return material
