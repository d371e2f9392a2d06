"""Leaves that the subtree kernels leave out, and leaves in no subtree: what CUDA does with them.

Those kernels are plain Warp but for groups of subtrees and clusters, so they run on every device; a CPU's threads come
one after another.
"""

import numpy as np
import oracle
import pytest
import warp as wp
from cases import edge_scale, mixed_forest, oracle_mesh
from warp_corot.kernels.block_layout import VECTOR_BYTES
from warp_corot.kernels.repair import LIST_BLOCK
from warp_corot.kernels.subtree_cuda import BLOCK, FLAT, Stretch, scatter_stretches

import warp_corot as wc
from warp_corot.clusters import clusters_of
from warp_corot.elasticity.left_out import LeftOutLeaves
from warp_corot.plan import ForcePlan

TOLERANCE = 1e-5  # of the largest force, as in test_miscompile


class Launches:
    """The launches of a body's plan without groups or clusters."""

    def __init__(self, body):
        self.body, self.device = body, body.device
        self.plan = plan = ForcePlan.of_forest(body.mesh, None, body.device, grouped=False)
        self.listed = LeftOutLeaves.of(plan, body.device)
        self.rows, self.blocks = [], 0
        for batch in plan.batches:
            if self.device.is_cpu:
                nodes = np.ascontiguousarray(batch.subtrees.nodes.numpy().T)
                batch.subtrees.nodes = batch.subtrees.targets = wp.array(nodes, dtype=wp.int32, device=self.device)
            self._add(batch.count, batch.shape, batch.subtrees, batch.flagged)
        if len(plan.flat):
            self._add(len(plan.flat), FLAT)
        self.stretches = wp.array(self.rows, dtype=Stretch, device=self.device)

    def _add(self, count, shape, subtrees=None, flagged=None):
        stretch = Stretch()
        stretch.begin, stretch.count, stretch.shape = self.blocks, count, shape
        if subtrees is not None:
            stretch.subtrees, stretch.flagged = subtrees, flagged
        self.rows.append(stretch)
        self.blocks += -(-count // BLOCK)

    def forces(self):
        body, flat = self.body, self.plan.flat
        f = wp.zeros_like(body.node_displacements)
        wp.launch(
            scatter_stretches(body.material_stride == 0),
            dim=self.blocks * BLOCK,
            inputs=[self.stretches, flat.elements, flat.leaves, body.mu, body.lam, body.node_displacements],
            outputs=[f, self.listed.own],
            device=self.device,
            block_dim=BLOCK,
        )
        self.count = int(self.listed.own.counts.numpy()[0])
        material = [body.mu, body.lam, body.material_stride]
        self.listed.repair(body.elements, material, body.node_displacements, f)
        return f.numpy()[:, :3]


def expected(forest, u, young):
    """Forces by the oracle, and the nodes that no element without a definite rotation touches; see test_miscompile."""
    reference, x = oracle_mesh(forest), forest.points + u.astype(np.float32).astype(float)
    F = reference.deformation_gradients(x)
    sigma = np.linalg.svd(F, compute_uv=False)
    sound = np.ones(len(forest.points), bool)
    sound[forest.tets[sigma[:, 1] + sigma[:, 2] * np.sign(np.linalg.det(F)) < 0.1 * sigma[:, 0]]] = False
    _, forces = oracle.evaluate("corotated", reference, x, *oracle.lame(young, 0.4))
    return forces, sound


@pytest.mark.parametrize("uniform", [True, False], ids=["one material", "material per element"])
@pytest.mark.parametrize("share", [0.0, 0.1, 1.0])
def test_listed_leaves_get_their_forces(share, uniform, device, rng):
    """No node, a tenth, or all displaced by an edge: subtrees and single leaves, and the list is empty again after."""
    forest = mixed_forest(cells=(2, 1, 1), level=7, passes=3, share=0.05)
    young = np.full(len(forest.tets), 1e4) if uniform else rng.uniform(5e3, 2e4, len(forest.tets))
    material = wc.Isotropic(1e4 if uniform else young, 0.4, 1000.0)
    body = wc.SoftBody(forest, material, device=device)
    far = rng.random((len(forest.points), 1)) < share
    u = np.where(far, 1.0, 0.08) * edge_scale(forest) * rng.uniform(-1, 1, forest.points.shape)
    body.displacements = u
    launches = Launches(body)
    assert {batch.shape for batch in launches.plan.batches} == {0, 1, 2}
    forces, sound = expected(forest, u, young)
    for _ in range(2):
        error = np.abs(launches.forces() - forces)[sound].max()
        assert error < TOLERANCE * np.abs(forces).max()
        assert (launches.count > 0) == (share > 0)
        assert (launches.listed.own.counts.numpy() == 0).all()


def test_whole_subtrees_get_their_forces(device, rng):
    """A body turned over, and pressed so that it has definite rotations: every subtree is left out whole."""
    forest = wc.TetForest.box((2, 1, 1), 0.1, 9)
    body = wc.SoftBody(forest, wc.Isotropic(1e4, 0.4, 1000.0), device=device)
    u = 0.02 * edge_scale(forest) * rng.uniform(-1, 1, forest.points.shape) - [0, 0, 1.6] * forest.points
    body.displacements = u
    launches = Launches(body)
    forces, sound = expected(forest, u, 1e4)
    assert sound.all()
    assert np.abs(launches.forces() - forces).max() < TOLERANCE * np.abs(forces).max()
    (batch,) = launches.plan.batches
    assert (batch.flagged.numpy()[: batch.count] == 255).all()


def test_one_bad_leaf_is_left_out_alone(device, rng):
    """Of the subtree of a leaf that is turned over, the leaves that still have a volume are not left out."""
    forest = wc.TetForest.box((1, 1, 1), 0.1, 9)
    body = wc.SoftBody(forest, wc.Isotropic(1e4, 0.4, 1000.0), device=device)
    u = 0.02 * edge_scale(forest) * rng.uniform(-1, 1, forest.points.shape)
    tet = forest.tets[len(forest.tets) // 2]
    u[tet[0]] += 1.5 * (forest.points[tet[1:]].mean(0) - forest.points[tet[0]])
    body.displacements = u
    launches = Launches(body)
    launches.forces()
    F = oracle_mesh(forest).deformation_gradients(forest.points + u)
    (batch,) = launches.plan.batches
    bits = np.unpackbits(batch.flagged.numpy()[: batch.count, None], axis=1, bitorder="little")
    leaves = batch.subtrees.first.numpy()[:, None] + np.arange(8)
    left_out = np.zeros(len(forest.tets), bool)
    left_out[leaves[bits.astype(bool)]] = True
    det = np.linalg.det(F)
    # Between the two bounds rounding and the shape of F decide.
    assert left_out[det < 0.029].all()
    assert not left_out[det > 0.031].any()
    assert 0 < left_out.sum() < 8


def test_clusters_add_up_every_corner_once(rng):
    """The tables alone: nodes of corners, and sums of slots against a plain sum over elements."""
    forest = mixed_forest(cells=(2, 1, 1), level=7, passes=3, share=0.05)
    chosen = np.flatnonzero(rng.random(len(forest.tets)) < 0.7).astype(np.int32)
    clusters, count = clusters_of(chosen, forest.tets, wp.get_device("cpu"))
    elements, begin = clusters.elements.numpy(), clusters.begin.numpy()
    assert len(elements) == count * LIST_BLOCK
    there = np.flatnonzero(elements >= 0)
    assert np.array_equal(elements[there], chosen)
    corners = clusters.corners.numpy().view("<u2").reshape(-1, 4)[there]
    nodes = clusters.nodes.numpy()
    assert np.array_equal(nodes[begin[there // LIST_BLOCK][:, None] + corners], forest.tets[chosen])
    values = np.zeros((count * LIST_BLOCK, 4))
    values[there] = rng.random((len(there), 4))
    # Slots hold a corner after another's, one element after another; past the last of a task's slots is the zero one.
    slots = np.ascontiguousarray(clusters.slots.numpy().T).view("<u2").astype(int) // VECTOR_BYTES
    total = np.zeros(len(forest.points))
    for cluster in range(count):
        own = np.append(values.reshape(count, -1, 4)[cluster].T.ravel(), 0.0)
        tasks = slice(begin[cluster], begin[cluster + 1])
        np.add.at(total, nodes[tasks], own[slots[tasks]].sum(1))
    plain = np.zeros(len(forest.points))
    np.add.at(plain, forest.tets[chosen], values[there])
    assert np.allclose(total, plain, rtol=1e-13)
