"""Anisotropic general tetrahedra on CUDA; see ``kernels.general_cuda``."""

from __future__ import annotations

from typing import TYPE_CHECKING

import warp as wp

from ..anisotropy import TransverselyIsotropic
from ..kernels.definite import quaternions_of
from ..kernels.general_anisotropic import scatter_general_anisotropic
from ..kernels.general_cuda import BLOCK
from ..kernels.rotation import quick_rotation
from .anisotropic import AnisotropicField
from .law_general import posed_elements

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
        self._kernel = scatter_general_anisotropic(isinstance(body.material, TransverselyIsotropic))
        self._posed = posed_elements(self.elements)
        self._quaternions = wp.empty(len(axes), dtype=wp.quat, device=self.device)
        self.launch(quaternions_of, len(axes), [axes], [self._quaternions])

    def scatter_forces(self, u: wp.array, f: wp.array) -> None:
        inputs = [self._posed, self.material, self._quaternions, *self._activation, u]
        wp.launch(self._kernel, self.element_count, inputs=inputs, outputs=[f], device=self.device, block_dim=BLOCK)
