"""The launches of leaves that subtree kernels left out, by hand."""

import numpy as np
import warp as wp

from warp_corot.discretization.planner import ForcePlan
from warp_corot.elasticity.cuda import DegenerateLeaves
from warp_corot.elasticity.model import isotropic_material
from warp_corot.kernels.subtrees.cuda import FLAT, WorkRange, scatter_body
from warp_corot.kernels.subtrees.memory import BLOCK


class Launches:
    """The launches of a body's plan without groups or clusters."""

    def __init__(self, body):
        self.body, self.device = body, body.device
        self.plan = plan = ForcePlan.of_forest(body.mesh, None, body.device, grouped=False)
        self.listed = DegenerateLeaves([*(batch.count for batch in plan.batches), len(plan.flat)], body.device)
        self.rows, self.blocks = [], 0
        for batch in plan.batches:
            if self.device.is_cpu:
                nodes = np.ascontiguousarray(batch.subtrees.nodes.numpy().T)
                batch.subtrees.nodes = batch.subtrees.targets = wp.array(nodes, dtype=wp.int32, device=self.device)
            self._add(batch.count, batch.shape, batch.subtrees, batch.flagged)
        if len(plan.flat):
            self._add(len(plan.flat), FLAT)
        self.ranges = wp.array(self.rows, dtype=WorkRange, device=self.device)

    def _add(self, count, shape, subtrees=None, flagged=None):
        one = WorkRange()
        one.begin, one.count, one.shape = self.blocks, count, shape
        if subtrees is not None:
            one.subtrees, one.flagged = subtrees, flagged
        self.rows.append(one)
        self.blocks += -(-count // BLOCK)

    def forces(self):
        body, flat = self.body, self.plan.flat
        own, f = body.discretization, wp.zeros_like(body.state.displacements)
        material = isotropic_material([own.mu, own.lam, own.material_stride])
        wp.launch(
            scatter_body(body.discretization.material_stride == 0),
            dim=self.blocks * BLOCK,
            inputs=[
                self.ranges,
                self.plan.elements,
                flat.leaves,
                material,
                body.state.displacements,
            ],
            outputs=[f, self.listed.lists],
            device=self.device,
            block_dim=BLOCK,
        )
        self.count = int(self.listed.lists.counts.numpy().sum())
        self.listed.repair(body.discretization.elements, material, body.state.displacements, f)
        return f.numpy()[:, :3]
