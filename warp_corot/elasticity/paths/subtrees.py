"""The subtree kernels of laws that need no rotation (CUDA): linear, St. Venant-Kirchhoff, neo-Hookean."""

from __future__ import annotations

from typing import TYPE_CHECKING

import warp as wp

from warp_corot.discretization.clusters.single import isotropic_material
from warp_corot.discretization.plan import FlatLeaves, ForcePlan, Plan
from warp_corot.discretization.subtrees import chosen
from warp_corot.elasticity.model import LawField
from warp_corot.kernels.clusters.laws import isotropic_law
from warp_corot.kernels.subtrees import cuda as subtree_cuda
from warp_corot.kernels.subtrees.laws import scatter_subtrees
from warp_corot.mesh import TetForest

from .clusters import ClusterScatter, grouped_and_others

if TYPE_CHECKING:
    from warp_corot.body.soft_body import SoftBody
    from warp_corot.discretization.changing.plan import DevicePlan
    from warp_corot.discretization.changing.pools import DeviceForest


class LawSubtreeField(LawField):
    """Complete subtrees in batches; the leaves that are in none one by one, under the same law. Where the mesh stays as
    it is these go in clusters, and with them the subtrees that are in no group.

    Args:
        body: A forest's, on CUDA.
        stress, energy, cauchy: The law, functions of ``kernels.elements.constitutive``.
        deterministic: As for every field.
    """

    def __init__(
        self,
        body: SoftBody,
        *,
        stress: wp.Function,
        energy: wp.Function,
        cauchy: wp.Function,
        deterministic: bool = False,
    ):
        super().__init__(body, stress=stress, energy=energy, cauchy=cauchy, deterministic=deterministic)
        self._stress = stress
        self._uniform = body.material_stride == 0
        if body.changing is None:
            assert isinstance(body.mesh, TetForest)
            self._go_through(
                ForcePlan.of_forest(body.mesh, None, self.device, worlds=body.worlds, deterministic=self.deterministic)
            )

    def _take_slots(self) -> None:
        """The plan has them."""

    def plan_of(self, forest: DeviceForest) -> DevicePlan:
        from warp_corot.discretization.changing.plan import DevicePlan

        return DevicePlan(forest)

    def follow(self, plan: DevicePlan) -> None:
        super().follow(plan)
        # Everything that any mesh may come to need, so that nothing is compiled once steps are made.
        for shape, grouped, _sharing in plan.kinds:
            wp.load_module(self._kernel(shape, grouped).module, self.device, block_dim=subtree_cuda.BLOCK)
        wp.load_module(self._forces.module, self.device)
        self._go_through(plan)

    def _go_through(self, plan: Plan) -> None:
        self.plan = plan
        self.slots = plan.slots
        self._batches, self._flat = list(plan.batches), plan.flat if len(plan.flat) else None
        self._clusters: ClusterScatter | None = None
        if isinstance(plan, ForcePlan) and len(plan.flat) and self.device.is_cuda and not self.deterministic:
            self._batches, leaves = grouped_and_others(plan)
            self._clusters, self._flat = ClusterScatter(self.elements, isotropic_law(self._stress), chosen=leaves), None
        self._kernels = [self._kernel(batch.shape, batch.grouped) for batch in self._batches]
        self._flat_material = self._material_of(plan.flat)

    def _material_of(self, flat: FlatLeaves) -> list:
        if flat.material is not None:
            return [*flat.material, 1]
        if self._uniform or not len(flat):
            return self.material_inputs
        return [*(chosen(values, flat.leaves) for values in (self.body.mu, self.body.lam)), 1]

    def _kernel(self, shape: int, grouped: bool) -> wp.Kernel:
        return scatter_subtrees(shape, grouped, self._uniform, self._stress)

    def scatter_forces(self, u: wp.array, f: wp.array) -> None:
        body, flat = self.body, self._flat
        for batch, kernel in zip(self._batches, self._kernels, strict=True):
            inputs = [batch.subtrees, body.mu, body.lam, u]
            wp.launch(kernel, batch.count, inputs=inputs, outputs=[f], device=self.device, block_dim=subtree_cuda.BLOCK)
        if flat is not None:
            self.launch(self._forces, len(flat), [flat.elements, *self._flat_material, u], [f])
        if self._clusters is not None:
            self._clusters(isotropic_material(self.material_inputs), u, f)
