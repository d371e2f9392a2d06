"""Shared rotations within a tolerance: an ancestor's where it is near the leaves' own ones, own rotations elsewhere."""

import numpy as np
import oracle
import pytest
import warp as wp
from cases import edge_scale, oracle_mesh
from warp_corot.kernels.repair import LeftOut
from warp_corot.kernels.subtree_cuda import BLOCK, scatter_subtrees_own

import warp_corot as wc
from warp_corot.elasticity.corotated import AUTO_TOLERANCE
from warp_corot.plan import ForcePlan

MU, LAM = oracle.lame(1e4, 0.4)
ROUNDING = 1e-5  # of the largest force


def forces(forest, u, tolerance, device):
    """Forces by the kernel that CUDA has, without groups, and which leaves it left out."""
    body = wc.SoftBody(forest, wc.Isotropic(1e4, 0.4, 1000.0), device=device)
    body.displacements = u
    (batch,) = ForcePlan.of_forest(forest, None, body.device, grouped=False).batches
    if body.device.is_cpu:
        nodes = wp.array(np.ascontiguousarray(batch.subtrees.nodes.numpy().T), dtype=wp.int32, device=body.device)
        batch.subtrees.nodes = batch.subtrees.targets = nodes
    f = wp.zeros_like(body.node_displacements)
    wp.launch(
        scatter_subtrees_own(batch.shape, False, True, False, tolerance),
        dim=batch.count,
        inputs=[batch.subtrees, body.mu, body.lam, body.node_displacements],
        outputs=[f, batch.flagged, LeftOut()],
        device=body.device,
        block_dim=BLOCK,
    )
    return f.numpy()[:, :3], batch.flagged.numpy()[: batch.count]


def bent(points, radius):
    """A bar along z bent to a circle, and its displacements: rotation from leaf to leaf by h / radius."""
    angle = points[:, 2] / radius
    out = radius + points[:, 0]
    moved = np.stack([out * np.cos(angle) - radius, points[:, 1], out * np.sin(angle)], axis=1)
    return moved - points


def own(forest, u):
    reference, x = oracle_mesh(forest), forest.points + u.astype(np.float32).astype(float)
    F = reference.deformation_gradients(x)
    return reference, F, oracle.evaluate("corotated", reference, x, MU, LAM)[1]


@pytest.mark.parametrize("tolerance", [0.01, AUTO_TOLERANCE, 0.3])
@pytest.mark.parametrize("radius", [10.0, 1.0, 0.3])
@pytest.mark.parametrize("level", [6, 7, 8])
def test_error_of_the_force_is_bounded(level, radius, tolerance, device):
    """At every node by the sum of V |grad N| (2 mu + 3 lambda) (3 w |U - I| + w^2 |U|) with w = 2 tolerance."""
    forest = wc.TetForest.box((1, 1, 3), 0.1, level)
    u = bent(forest.points, radius)
    found, _ = forces(forest, u, tolerance, device)
    reference, F, expected = own(forest, u)
    U = np.swapaxes(oracle.polar(F), 1, 2) @ F
    w = 2 * tolerance
    norm = np.linalg.norm(U, axis=(1, 2))
    stress = (2 * MU + 3 * LAM) * (3 * w * np.linalg.norm(U - np.eye(3), axis=(1, 2)) + w**2 * norm)
    bound = np.zeros(len(forest.points))
    share = (reference.volumes * stress)[:, None] * np.linalg.norm(reference.gradients, axis=2)
    np.add.at(bound, forest.tets, share)
    error = np.linalg.norm(found - expected, axis=1)
    assert (error < bound + ROUNDING * np.abs(expected).max()).all()


def test_both_kinds_are_used(device):
    """Of a bar with one end bent the other is not: the straight part shares, and the error there is what shows it."""
    forest = wc.TetForest.box((1, 1, 3), 0.1, 9)
    z = forest.points[:, 2]
    u = np.where(
        (z > 0.15)[:, None], bent(forest.points - [0, 0, 0.15], 0.15), bent(forest.points - [0, 0, 0.15], 20.0)
    )
    found, _ = forces(forest, u, 0.05, device)
    _, _, expected = own(forest, u)
    error = np.linalg.norm(found - expected, axis=1) / np.abs(expected).max()
    assert error[z < 0.1].max() > 1e-6  # shared
    assert error[z > 0.2].max() < ROUNDING  # own ones


def test_what_own_rotations_hold_is_theirs(device, rng):
    """Turned over, flat and strongly strained leaves never share: their forces are those of own rotations, or they are
    left out as they are without a tolerance."""
    forest = wc.TetForest.box((1, 1, 1), 0.1, 9)
    far = rng.random((len(forest.points), 1)) < 0.1
    u = np.where(far, 1.2, 0.02) * edge_scale(forest) * rng.uniform(-1, 1, forest.points.shape)
    shared, left_out = forces(forest, u, 0.5, device)
    plain, left_out_plain = forces(forest, u, None, device)
    _, F, _ = own(forest, u)
    strained = np.linalg.norm(F @ np.swapaxes(F, 1, 2) - np.eye(3), axis=(1, 2)).reshape(-1, 8).max(1) > 5.0
    assert 0.05 < strained.mean() < 0.95
    assert np.array_equal(left_out[strained], left_out_plain[strained])
    subtrees = forest.tets.reshape(-1, 32)
    certain = np.ones(len(forest.points), bool)
    certain[subtrees[~strained]] = False
    assert certain.any()
    assert np.abs(shared - plain)[certain].max() < ROUNDING * np.abs(plain).max()


def test_rotations_of_the_whole_body_do_not_matter(device, rng):
    """Decided by what is left once the root's rotation is taken off: the forces turn with the body."""
    forest = wc.TetForest.box((1, 1, 3), 0.1, 6)
    turn = oracle.polar(rng.standard_normal((3, 3)))
    u = bent(forest.points, 1.0)
    turned = (forest.points + u) @ turn.T - forest.points
    there, here = (forces(forest, v, AUTO_TOLERANCE, device)[0] for v in (turned, u))
    assert np.abs(there - here @ turn.T).max() < 3 * ROUNDING * np.abs(here).max()


def test_levels_that_are_none():
    for level in (0.0, -0.1, 0.7, "often", True, -1, 3.5):
        with pytest.raises(wc.InputError, match="level"):
            wc.Corotated(rotation_level=level)
    assert wc.Corotated(rotation_level="auto").tolerance == AUTO_TOLERANCE
    assert wc.Corotated(rotation_level=0.1).tolerance == 0.1
    assert wc.Corotated(rotation_level=3).tolerance is None


def test_energies_are_those_of_own_rotations(device, rng):
    forest = wc.TetForest.box((1, 1, 3), 0.1, 6)
    body = wc.SoftBody(forest, wc.Isotropic(1e4, 0.4, 1000.0), device=device)
    body.displacements = bent(forest.points, 1.0)
    with_own, near = (wc.Corotated(rotation_level=level).bind(body) for level in (None, "auto"))
    u = body.node_displacements
    assert near.elastic_energy(u) == with_own.elastic_energy(u)
