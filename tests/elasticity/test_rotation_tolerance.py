"""Shared rotations within a tolerance: an ancestor's if it is close to the leaves' own, own rotations elsewhere."""

import numpy as np
import oracle
import pytest
import warp as wp
from cases import edge_scale, oracle_mesh

import warp_corot as wc
from warp_corot.discretization.planner import ForcePlan
from warp_corot.elasticity.corotated.model import AUTO_TOLERANCE
from warp_corot.elasticity.model import isotropic_material
from warp_corot.kernels.subtrees import cpu as subtree_cpu

MU, LAM = oracle.lame(1e4, 0.4)
ROUNDING = 1e-5  # of the largest force


def forces(forest, u, tolerance):
    """Forces of eight subtrees in the lanes of a CPU, and the omitted leaves as bits of subtrees."""
    body = wc.SoftBody(forest, wc.Isotropic(1e4, 0.4, 1000.0), device="cpu")
    body.displacements = u
    plan = ForcePlan.of_forest(forest, None, body.device, grouped=False)
    (batch,) = plan.batches
    f = wp.zeros_like(body.state.displacements)
    material, u, outputs = (
        [body.discretization.mu, body.discretization.lam],
        body.state.displacements,
        [f, batch.flagged],
    )
    kernel, of_kernel = subtree_cpu.scatter_law_subtrees(batch.shape), isotropic_material([*material, 0])
    if tolerance is not None:
        kernel, near = subtree_cpu.scatter_subtrees_tolerance(batch.shape), subtree_cpu.ToleranceMaterial()
        near.isotropic, near.tolerance = of_kernel, tolerance
        of_kernel = near
    inputs = [batch.subtrees, batch.count, of_kernel, u]
    wp.launch(kernel, -(-batch.count // 8), inputs, outputs, device=body.device)
    return f.numpy()[:, :3], batch.flagged.numpy()[: batch.count]


def bent(points, radius):
    """A bar along z bent to a circle, and its displacements: neighbouring leaves are rotated by h / radius."""
    angle = points[:, 2] / radius
    out = radius + points[:, 0]
    moved = np.stack([out * np.cos(angle) - radius, points[:, 1], out * np.sin(angle)], axis=1)
    return moved - points


def own(forest, u):
    reference, x = oracle_mesh(forest), forest.points + u.astype(np.float32).astype(float)
    F = reference.deformation_gradients(x)
    return reference, F, oracle.evaluate("corotated", reference, x, MU, LAM)[1]


def bound(reference, F, tolerance, mu=MU, lam=LAM):
    """Bound of the error of forces [N]."""
    U = np.swapaxes(oracle.polar(F), 1, 2) @ F
    w = 2 * tolerance
    strain, norm = (np.linalg.norm(A, axis=(1, 2)) for A in (U - np.eye(3), U))
    stress = (2 * mu + 3 * lam) * (3 * w * strain + w**2 * norm)
    found = np.zeros(len(reference.points))
    share = (reference.volumes * stress)[:, None] * np.linalg.norm(reference.gradients, axis=2)
    np.add.at(found, reference.tets, share)
    return found


@pytest.mark.parametrize("tolerance", [0.01, AUTO_TOLERANCE, 0.3])
@pytest.mark.parametrize("level", [6, 7, 8])
@pytest.mark.parametrize("radius", [10.0, 1.0, 0.3])
def test_error_of_the_force_is_bounded(level, radius, tolerance):
    """At every node by the sum of V |grad N| (2 mu + 3 lambda) (3 w |U - I| + w^2 |U|) with w = 2 tolerance."""
    forest = wc.TetForest.box((1, 1, 3), 0.1, level)
    u = bent(forest.points, radius)
    found, _ = forces(forest, u, tolerance)
    reference, F, expected = own(forest, u)
    error = np.linalg.norm(found - expected, axis=1)
    assert (error < bound(reference, F, tolerance) + ROUNDING * np.abs(expected).max()).all()


def test_both_kinds_are_used():
    """One end of a bar is bent, the other is straight: the straight part shares rotations, as the error there shows."""
    forest = wc.TetForest.box((1, 1, 3), 0.1, 9)
    z = forest.points[:, 2]
    u = np.where(
        (z > 0.15)[:, None], bent(forest.points - [0, 0, 0.15], 0.07), bent(forest.points - [0, 0, 0.15], 20.0)
    )
    found, _ = forces(forest, u, AUTO_TOLERANCE)
    _, _, expected = own(forest, u)
    error = np.linalg.norm(found - expected, axis=1) / np.abs(expected).max()
    assert error[z < 0.1].max() > 1e-6  # shared
    assert error[z > 0.2].max() < ROUNDING  # own ones


def test_strongly_strained_leaves_keep_their_own_rotations(rng):
    """Inverted, flat and strongly strained leaves never share: their forces are those of own rotations, or they are
    left out as without a tolerance."""
    forest = wc.TetForest.box((1, 1, 1), 0.1, 9)
    far = rng.random((len(forest.points), 1)) < 0.1
    u = np.where(far, 1.2, 0.02) * edge_scale(forest) * rng.uniform(-1, 1, forest.points.shape)
    shared, degenerate = forces(forest, u, 0.5)
    plain, left_out_plain = forces(forest, u, None)
    _, F, _ = own(forest, u)
    strained = np.linalg.norm(F @ np.swapaxes(F, 1, 2) - np.eye(3), axis=(1, 2)).reshape(-1, 8).max(1) > 5.0
    assert 0.05 < strained.mean() < 0.95
    assert np.array_equal(degenerate[strained], left_out_plain[strained])
    subtrees = forest.tets.reshape(-1, 32)
    certain = np.ones(len(forest.points), bool)
    certain[subtrees[~strained]] = False
    assert certain.any()
    assert np.array_equal(shared[certain], plain[certain])


def test_rotations_of_the_whole_body_do_not_matter(rng):
    """The decision uses only what remains after removing the root's rotation: forces rotate with the body."""
    forest = wc.TetForest.box((1, 1, 3), 0.1, 6)
    turn = oracle.polar(rng.standard_normal((3, 3)))
    u = bent(forest.points, 1.0)
    turned = (forest.points + u) @ turn.T - forest.points
    there, here = (forces(forest, v, AUTO_TOLERANCE)[0] for v in (turned, u))
    assert np.abs(there - here @ turn.T).max() < 3 * ROUNDING * np.abs(here).max()


def test_materials_of_elements(device, rng):
    """Shared and own rotations in one body with many materials."""
    forest = wc.TetForest.box((1, 1, 3), 0.1, 8)
    young = rng.uniform(0.5e4, 2e4, len(forest.tets))
    u = np.where(forest.points[:, 2:] > 0.15, bent(forest.points - [0, 0, 0.15], 0.3), 0.0)
    body = wc.SoftBody(forest, wc.Isotropic(young, 0.4, 1000.0), device=device)
    body.displacements = u
    near, with_own = (
        wc.Simulation(body, model=wc.Corotated(rotation_level=level)).forces().numpy() for level in ("auto", None)
    )
    reference, F, _ = own(forest, u)
    lame = oracle.lame(young, 0.4)
    x = forest.points + body.displacements.numpy().astype(float)
    expected = oracle.evaluate("corotated", reference, x, *lame)[1]
    rounding = ROUNDING * np.abs(expected).max()
    assert np.abs(with_own - expected).max() < rounding
    error = np.linalg.norm(near - expected, axis=1)
    assert (error < bound(reference, F, AUTO_TOLERANCE, *lame) + rounding).all()
    if body.device.is_cpu:  # on CUDA every element has its own rotation
        assert error.max() > 100 * rounding


def test_invalid_levels_are_refused():
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
    u = body.state.displacements
    assert near.elastic_energy(u) == with_own.elastic_energy(u)
