"""Anisotropic materials on CUDA: subtrees, clusters, and elements one by one."""

from __future__ import annotations

from typing import TYPE_CHECKING

import warp as wp

from warp_corot.discretization.discretization import Discretization
from warp_corot.discretization.plan import Plan
from warp_corot.elasticity.backends.clusters import divided
from warp_corot.inputs.loading import LoadedKernel
from warp_corot.kernels.clusters.laws import ActiveMaterial, anisotropic_law
from warp_corot.kernels.corotated.anisotropic import OrthotropicMaterial
from warp_corot.kernels.corotated.well_conditioned import quaternions_of
from warp_corot.kernels.math.rotation import quick_rotation
from warp_corot.kernels.subtrees.anisotropic import repair_leaves, scatter_anisotropic_subtrees, scatter_flat
from warp_corot.kernels.subtrees.memory import BLOCK
from warp_corot.kernels.tables.cluster_layout import ANISOTROPIC
from warp_corot.materials.anisotropic import TransverselyIsotropic

from .anisotropic import AnisotropicField

if TYPE_CHECKING:
    from warp_corot.discretization.discretization import Discretization


class AnisotropicCudaField(AnisotropicField):
    """Complete subtrees in batches; other elements one by one or, if the mesh never changes, in clusters. Forces may be
    summed in any order.

    Args:
        discretization: A mesh with an ``Anisotropic`` material, on CUDA.
    """

    def __init__(self, discretization: Discretization):
        super().__init__(discretization, quick_rotation, deterministic=False)
        self._transverse = isinstance(discretization.material, TransverselyIsotropic)
        self._quaternions = wp.empty(len(self.passive.axes), dtype=wp.quat, device=self.device)
        self.derive()
        self.follow()

    _force_kernels: list[LoadedKernel] = []  # noqa: RUF012 (never changed)

    def plan_of(self, discretization: Discretization) -> Plan:
        return discretization.plan(subtrees=discretization.prefers_subtrees)

    def load_kernels(self) -> None:
        for shape, grouped, _sharing in self.plan.kinds:
            wp.load_module(self._kernel(shape, grouped).module, self.device, block_dim=BLOCK)
        for kernel in (scatter_flat, repair_leaves):
            wp.load_module(kernel.module, self.device)

    def derive(self) -> None:
        self.launch(quaternions_of, len(self._quaternions), [self.passive.axes], [self._quaternions])

    def scatter_forces(self, u: wp.array, f: wp.array) -> None:
        fibres, flat = self.fibres, self.plan.flat
        active = active_material(self.passive, self._quaternions, *self._activation)
        for batch, kernel, flags in zip(self._batches, self._kernels, self._flags, strict=True):
            inputs, outputs = [batch.subtrees, active, u], [f, as_bytes(flags)]
            wp.launch(kernel, batch.count, inputs=inputs, outputs=outputs, device=self.device, block_dim=BLOCK)
            inputs = [8, flags, batch.subtrees.first, self.elements, fibres, u]
            self.launch(repair_leaves, 8 * len(flags), inputs, [f])
        if self._clusters is not None:
            self._clusters(active, u, f)
        elif len(flat):
            self.launch(scatter_flat, len(flat), [flat.elements, flat.leaves, fibres, u], [f])

    def follow(self) -> None:
        law = anisotropic_law(self._transverse)
        self._batches, self._clusters = divided(self.discretization, self.plan, law, ActiveMaterial, ANISOTROPIC)
        self._kernels = [self._kernel(batch.shape, batch.grouped) for batch in self._batches]
        self._flags = [wp.zeros(-(-b.count // 8), dtype=wp.uint64, device=self.device) for b in self._batches]

    def _kernel(self, shape: int, grouped: bool) -> wp.Kernel:
        one_axes, one_stiffness = self.passive.axes_stride == 0, self.passive.stride == 0
        return scatter_anisotropic_subtrees(shape, grouped, self._transverse, one_axes, one_stiffness)


def active_material(
    passive: OrthotropicMaterial, axes: wp.array, is_active: int, activation: wp.array
) -> ActiveMaterial:
    """``kernels.clusters.laws.ActiveMaterial`` from its parts."""
    material = ActiveMaterial()
    material.passive, material.axes = passive, axes
    material.is_active, material.activation = is_active, activation
    return material


def as_bytes(flags: wp.array) -> wp.array:
    """The memory of uint64 [n] as uint8 [8 n]."""
    return wp.array(ptr=flags.ptr, dtype=wp.uint8, shape=8 * len(flags), device=flags.device)
