"""Leaves that the subtree kernels leave out, and single leaves, on CUDA.

Except for groups of subtrees and clusters, those kernels are plain Warp and run on every device; a CPU's threads run
one after another.
"""

import numpy as np
import oracle
import pytest
import warp as wp
from cases import edge_scale, mixed_forest, oracle_mesh
from degenerate_launches import Launches

import warp_corot as wc
from warp_corot.discretization.planner import ForcePlan
from warp_corot.elasticity.cuda import DegenerateLeaves
from warp_corot.elasticity.model import isotropic_material
from warp_corot.kernels.subtrees.degenerate import COUNT_STRIDE, LISTS

TOLERANCE = 1e-5  # of the largest force, as in test_miscompile


def expected(forest, u, young):
    """Forces by the oracle, and the nodes without an element of undefined rotation; see test_miscompile."""
    reference, x = oracle_mesh(forest), forest.points + u.astype(np.float32).astype(float)
    F = reference.deformation_gradients(x)
    sigma = np.linalg.svd(F, compute_uv=False)
    valid = np.ones(len(forest.points), bool)
    valid[forest.tets[sigma[:, 1] + sigma[:, 2] * np.sign(np.linalg.det(F)) < 0.1 * sigma[:, 0]]] = False
    _, forces = oracle.evaluate("corotated", reference, x, *oracle.lame(young, 0.4))
    return forces, valid


@pytest.mark.parametrize(
    "uniform",
    [pytest.param(True, id="one material", marks=pytest.mark.slow), pytest.param(False, id="material per element")],
)
@pytest.mark.parametrize("share", [0.0, 0.1, 1.0])
def test_listed_leaves_get_their_forces(share, uniform, device, rng):
    """None, a tenth, or all nodes displaced by an edge: subtrees and single leaves; the list is empty afterwards."""
    forest = mixed_forest(cells=(2, 1, 1), level=7, passes=3, share=0.05)
    young = np.full(len(forest.tets), 1e4) if uniform else rng.uniform(5e3, 2e4, len(forest.tets))
    material = wc.Isotropic(1e4 if uniform else young, 0.4, 1000.0)
    body = wc.SoftBody(forest, material, device=device)
    far = rng.random((len(forest.points), 1)) < share
    u = np.where(far, 1.0, 0.08) * edge_scale(forest) * rng.uniform(-1, 1, forest.points.shape)
    body.displacements = u
    launches = Launches(body)
    assert {batch.shape for batch in launches.plan.batches} == {0, 1, 2}
    forces, valid = expected(forest, u, young)
    for _ in range(2):
        error = np.abs(launches.forces() - forces)[valid].max()
        assert error < TOLERANCE * np.abs(forces).max()
        assert (launches.count > 0) == (share > 0)
        assert (launches.listed.lists.counts.numpy() == 0).all()


def test_whole_subtrees_get_their_forces(device, rng):
    """An inverted body, compressed so that it has definite rotations: every subtree is left out whole.

    Then half of the body, and later all of it, recovers.
    """
    forest = wc.TetForest.box((2, 1, 1), 0.1, 9)
    body = wc.SoftBody(forest, wc.Isotropic(1e4, 0.4, 1000.0), device=device)
    noise = 0.02 * edge_scale(forest) * rng.uniform(-1, 1, forest.points.shape)
    over, half = noise - [0, 0, 1.6] * forest.points, forest.points[:, :1] > 0.1
    launches = Launches(body)
    (batch,) = launches.plan.batches
    for u, share in ((over, 1.0), (np.where(half, over, noise), 0.5), (noise, 0.0), (over, 1.0)):
        body.displacements = u
        forces, valid = expected(forest, u, 1e4)
        assert valid.mean() > 0.9
        for _ in range(3):
            assert np.abs(launches.forces() - forces)[valid].max() < TOLERANCE * np.abs(forces).max()
        degenerate = batch.flagged.numpy()[: batch.count]
        assert abs(np.mean(degenerate == 255) - share) < 0.1
        assert share == 0.5 or np.isin(degenerate, [0, 255]).all()


def test_one_bad_leaf_is_left_out_alone(device, rng):
    """In the subtree of an inverted leaf, the leaves with positive volume are not left out."""
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
    degenerate = np.zeros(len(forest.tets), bool)
    degenerate[leaves[bits.astype(bool)]] = True
    det = np.linalg.det(F)
    # Between the two bounds, rounding and the shape of F decide.
    assert degenerate[det < 0.029].all()
    assert not degenerate[det > 0.031].any()
    assert 0 < degenerate.sum() < 8


@pytest.mark.parametrize("share", [0.0, 0.1, 1.0])
def test_every_leaf_may_be_listed(share, device, rng):
    """Leaves may be listed unnecessarily: the forces of a body with all subtrees on the lists are right."""
    forest = wc.TetForest.box((2, 1, 1), 0.1, 9)
    young = rng.uniform(5e3, 2e4, len(forest.tets))
    body = wc.SoftBody(forest, wc.Isotropic(young, 0.4, 1000.0), device=device)
    far = rng.random((len(forest.points), 1)) < share
    u = np.where(far, 1.0, 0.08) * edge_scale(forest) * rng.uniform(-1, 1, forest.points.shape)
    body.displacements = u
    plan = ForcePlan.of_forest(forest, None, body.device, grouped=False)
    listed = DegenerateLeaves([*(batch.count for batch in plan.batches), len(plan.flat)], body.device)
    # Distributed to lists of different lengths, some of them empty.
    (batch,) = plan.batches
    counts, entries = listed.lists.counts.numpy(), listed.lists.entries.numpy().reshape(LISTS, listed.lists.room, 2)
    for k, first in enumerate(batch.subtrees.first.numpy()):
        of = k * k % (LISTS - 1)
        entries[of, counts[of * COUNT_STRIDE]] = first, 255
        counts[of * COUNT_STRIDE] += 1
    listed.lists.counts.assign(counts)
    listed.lists.entries.assign(entries.reshape(-1, 2))
    f = wp.zeros_like(body.state.displacements)
    listed.repair(
        body.discretization.elements,
        isotropic_material([body.discretization.mu, body.discretization.lam, body.discretization.material_stride]),
        body.state.displacements,
        f,
    )
    forces, valid = expected(forest, u, young)
    assert np.abs(f.numpy()[:, :3] - forces)[valid].max() < TOLERANCE * np.abs(forces).max()
    assert (listed.lists.counts.numpy()[: LISTS * COUNT_STRIDE] == 0).all()
