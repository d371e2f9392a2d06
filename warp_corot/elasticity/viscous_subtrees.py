"""Viscous forces of large bodies on CUDA, over complete subtrees."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import warp as wp

from warp_corot.kernels.corotated.viscous_subtrees import scatter_viscous_subtrees
from warp_corot.kernels.subtrees.memory import BLOCK

if TYPE_CHECKING:
    from warp_corot.discretization.subtrees import Batch
    from warp_corot.kernels.elements.viscosity import ViscousMaterial

    from .model import ForceField


class ViscousSubtrees:
    """Launches the viscous forces of a mesh all of whose leaves are in subtrees.

    Args:
        field: The elastic forces.
        batches: The subtrees.
    """

    def __init__(self, field: ForceField, batches: Sequence[Batch]):
        uniform = field.isotropic.stride == 0
        self._device, self._block = field.device, BLOCK if field.device.is_cuda else 256
        kernels = [scatter_viscous_subtrees(batch.shape, batch.grouped, uniform) for batch in batches]
        places = [batch.with_own_targets(field.device) for batch in batches]
        self._launches = [
            (kernel, batch.count, each) for kernel, batch, each in zip(kernels, batches, places, strict=True)
        ]
        for kernel in kernels:
            wp.load_module(kernel.module, self._device, block_dim=self._block)

    def launch(self, material: ViscousMaterial, u: wp.array, f: wp.array) -> None:
        """Launch the forces of displacements u, which are added to f [N]."""
        for kernel, count, places in self._launches:
            wp.launch(kernel, count, [places, material, u], [f], device=self._device, block_dim=self._block)
