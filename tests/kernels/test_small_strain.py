"""Small motions do not drown in rounding: forces and energies keep their digits at any strain.

Displacements are float32, correct to 6e-8 relative, and their differences to a few times that; a strain
computed as a difference of numbers near one is off by 1.5e-7 at any size.
"""

import numpy as np
import oracle
import pytest
import warp as wp
from cases import edge_scale, mixed_forest, oracle_mesh, place, random_displacement, simulation
from degenerate_launches import Launches

import warp_corot as wc
from warp_corot.discretization.planner import ForcePlan
from warp_corot.elasticity.model import ROTATED, Kept, isotropic_material
from warp_corot.kernels.elements.constitutive import RotatedMaterial
from warp_corot.kernels.subtrees.cuda import scatter_subtrees_shared
from warp_corot.kernels.subtrees.degenerate import DegenerateList

LAME = oracle.lame(1e4, 0.4)
MATERIAL = {"young": 1e4, "poisson": 0.4, "density": 1000.0}
AMOUNTS = [1e-2, 1e-3, 1e-4, 1e-6]
TOLERANCE = 3e-6  # some 10 roundings of each of some 10 elements of a node, relative to the largest force


def gathered(forest, x, level):
    if level is None:
        return None
    ancestors, unit = np.unique(forest.ancestors(level), return_inverse=True)
    return oracle.polar(oracle.Mesh(forest.points, forest.tree.tets[ancestors]).deformation_gradients(x))[unit.ravel()]


@pytest.mark.parametrize("amount", AMOUNTS)
@pytest.mark.parametrize("level", [None, 2])
def test_leaf_by_leaf(level, amount, device, rng):
    """Own and shared rotations: forces and the energy."""
    forest = mixed_forest(cells=(1, 1, 1), level=4, passes=2)
    model = wc.Corotated(rotation_level=level, subtrees=False)
    sim, body = simulation(forest, model, device, material=MATERIAL)
    u = random_displacement(forest, rng, amount)
    place(body, u)
    x = forest.points + u.astype(float)
    energies, expected = oracle.evaluate("corotated", oracle_mesh(forest), x, *LAME, R=gathered(forest, x, level))
    assert np.abs(sim.forces().numpy() - expected).max() < TOLERANCE * np.abs(expected).max()
    assert sim.energy().elastic == pytest.approx(energies.sum(), rel=TOLERANCE)


@pytest.mark.parametrize("amount", AMOUNTS)
def test_own_rotations_by_subtrees(amount, device, rng):
    """The series for small displacements at and below its bound: correct to 2e-5 in the worst case, beyond it to 1e-4.

    ``amount`` = 0.01 lies near the bound, with leaves on both paths side by side.
    """
    forest = mixed_forest(cells=(2, 1, 1), level=7, passes=3, share=0.05)
    body = wc.SoftBody(forest, wc.Isotropic(**MATERIAL), device=device)
    u = amount * edge_scale(forest) * rng.uniform(-1, 1, forest.points.shape)
    body.displacements = u
    _, expected = oracle.evaluate(
        "corotated", oracle_mesh(forest), forest.points + u.astype(np.float32).astype(float), *LAME
    )
    tolerance = 1e-4 if amount > 5e-3 else TOLERANCE
    assert np.abs(Launches(body).forces() - expected).max() < tolerance * np.abs(expected).max()


@pytest.mark.parametrize("amount", AMOUNTS)
@pytest.mark.parametrize("leaf_level", [6, *(pytest.param(level, marks=pytest.mark.slow) for level in (7, 8))])
def test_shared_rotations_by_subtrees(leaf_level, amount, device, rng):
    """Displacements rotated back by the root's rotation keep their digits at every size."""
    forest = wc.TetForest.box((1, 1, 1), 0.1, leaf_level)
    body = wc.SoftBody(forest, wc.Isotropic(**MATERIAL), device=device)
    u = amount * edge_scale(forest) * rng.uniform(-1, 1, forest.points.shape)
    body.displacements = u
    level = leaf_level - 3
    (batch,) = ForcePlan.of_forest(forest, level, body.device, grouped=False).batches
    if body.device.is_cpu:
        nodes = wp.array(np.ascontiguousarray(batch.subtrees.nodes.numpy().T), dtype=wp.int32, device=body.device)
        batch.subtrees.nodes = batch.subtrees.targets = nodes
    f = wp.zeros_like(body.state.displacements)
    material = isotropic_material([body.discretization.mu, body.discretization.lam, 0])
    none = wp.empty(0, dtype=wp.mat33, device=body.device), wp.empty(0, dtype=wp.int32, device=body.device)
    material = Kept(RotatedMaterial, *ROTATED)(material, *none)
    wp.launch(
        scatter_subtrees_shared(batch.shape, False, True, False),
        dim=batch.count,
        inputs=[batch.subtrees, material, body.state.displacements],
        outputs=[f, batch.flagged, DegenerateList()],
        device=body.device,
        block_dim=128,
    )
    x = forest.points + u.astype(np.float32).astype(float)
    _, expected = oracle.evaluate("corotated", oracle_mesh(forest), x, *LAME, R=gathered(forest, x, level))
    assert np.abs(f.numpy()[:, :3] - expected).max() < TOLERANCE * np.abs(expected).max()
