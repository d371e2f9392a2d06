"""The fast path of the corotated model: complete subtrees of a forest as units of work; see ``plan``."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from ..elements import forest_elements, in_worlds, with_targets
from ..kernels import subtree_cpu, subtree_cuda
from ..kernels.general_cpu import repair_elements, rest_matrices, scatter_elements
from ..kernels.lanes import LANES
from ..kernels.repair import repair_own, repair_shared
from ..mesh import TetForest
from ..plan import Batch, ForcePlan, Sharing
from .corotated_field import CorotatedField
from .lanes import Lanes, as_general

if TYPE_CHECKING:
    from ..body import SoftBody
    from .corotated import Corotated


class SubtreeField(CorotatedField):
    """The fast path: complete subtrees in batches, leaf by leaf only what is left over."""

    def __init__(self, body: SoftBody, model: Corotated, deterministic: bool):
        super().__init__(body, model, deterministic)
        assert isinstance(body.mesh, TetForest)
        self.plan = ForcePlan.of_forest(
            body.mesh, model.rotation_level, self.device, worlds=body.worlds, deterministic=self.deterministic
        )
        self.slots = self.plan.slots
        if self.plan.leaf_targets is not None and self.slots is not None:
            targets = in_worlds(self.plan.leaf_targets, body.worlds, self.slots.per_world)
            self.elements = with_targets(self.elements, targets)
        self._uniform = body.material_stride == 0
        self._kernels = [self._kernel(batch) for batch in self.plan.batches]
        above = [batch.sharing is Sharing.ABOVE for batch in self.plan.batches]
        self._needs_rotations = model.rotation_level is not None and (any(above) or len(self.plan.flat) > 0)
        nothing = wp.empty(0, dtype=wp.int32, device=self.device)
        no_rotations = wp.empty(0, dtype=wp.mat33, device=self.device)
        self._rotations = self._sharing().rotations if self._needs_rotations else no_rotations
        self._batch_units = [
            self._units_of(batch) if is_above else nothing
            for batch, is_above in zip(self.plan.batches, above, strict=True)
        ]
        if len(self.plan.flat):
            self._prepare_flat(body.mesh, in_worlds(self.plan.flat, body.worlds, len(body.mesh.tets)))

    def _prepare_flat(self, mesh: TetForest, flat: np.ndarray) -> None:
        """The leaves that are in no subtree, as elements of their own."""
        plan, worlds = self.plan, self.body.worlds
        self._flat_elements = forest_elements(mesh, mesh.tree.leaves[plan.flat], self.device, worlds)
        if plan.leaf_targets is not None and plan.slots is not None:
            targets = in_worlds(plan.leaf_targets[plan.flat], worlds, plan.slots.per_world)
            self._flat_elements = with_targets(self._flat_elements, targets)
        self._flat_material = self.material_inputs
        if not self._uniform:
            self._flat_material = [
                wp.array(a.numpy()[flat], dtype=wp.float32, device=self.device) for a in (self.body.mu, self.body.lam)
            ] + [1]
        self._flat_lanes: Lanes | None = None
        if self.device.is_cpu and not self._needs_rotations:
            general = as_general(self._flat_elements, rest_matrices, [self._flat_elements])
            self._flat_lanes = Lanes(general, general, scatter=scatter_elements, repair=repair_elements)
        if self._needs_rotations:
            self._flat_unit = wp.array(self._sharing().unit.numpy()[flat], dtype=wp.int32, device=self.device)

    def scatter_forces(self, u: wp.array, f: wp.array) -> None:
        if self._needs_rotations:
            self.extract_rotations(u)
        for batch, kernel, unit in zip(self.plan.batches, self._kernels, self._batch_units, strict=True):
            self._launch_batch(batch, kernel, unit, u, f)
        if len(self.plan.flat):
            inputs = [self._flat_elements, *self._flat_material, u]
            count = len(self._flat_elements.code)
            if self._flat_lanes is not None:
                self._flat_lanes.scatter_forces(self._flat_material, u, f)
            elif self._needs_rotations:
                self.launch(self._forces, count, [*inputs, self._rotations, self._flat_unit], [f])
            else:
                self.launch(self._own, count, inputs, [f])

    def _kernel(self, batch: Batch) -> wp.Kernel:
        given = batch.sharing is Sharing.ABOVE
        if self.device.is_cuda:
            if batch.sharing is Sharing.OWN:
                return subtree_cuda.scatter_subtrees_own(batch.shape, batch.grouped, self._uniform)
            return subtree_cuda.scatter_subtrees_shared(batch.shape, batch.grouped, self._uniform, given)
        if batch.sharing is Sharing.OWN:
            return subtree_cpu.scatter_subtrees_own(batch.shape)
        return subtree_cpu.scatter_subtrees_shared(batch.shape, given)

    def _units_of(self, batch: Batch) -> wp.array:
        """Which of the extracted rotations each subtree uses."""
        unit = self._sharing().unit.numpy()[batch.subtrees.first.numpy()]
        return wp.array(unit, dtype=wp.int32, device=self.device)

    def _launch_batch(self, batch: Batch, kernel: wp.Kernel, unit: wp.array, u: wp.array, f: wp.array) -> None:
        body = self.body
        if self.device.is_cuda:
            threads, block = batch.count, subtree_cuda.BLOCK
            inputs = [batch.subtrees, body.mu, body.lam, u]
        else:
            threads, block = -(-batch.count // LANES), 256
            inputs = [batch.subtrees, batch.count, *self.material_inputs, u]
        if batch.sharing is not Sharing.OWN:
            inputs += [self._rotations, unit]
        wp.launch(kernel, dim=threads, inputs=inputs, outputs=[f, batch.flagged], device=self.device, block_dim=block)
        flags = batch.flags_by_eights
        inputs = [self.elements, *self.material_inputs, u]
        if batch.sharing is Sharing.OWN:
            self.launch(repair_own, len(flags), [flags, batch.subtrees.first, *inputs], [f])
        elif batch.sharing is Sharing.ROOT:
            self.launch(repair_shared, len(flags), [flags, batch.subtrees.first, batch.roots, *inputs], [f])
