"""Kernels of laws that CUDA takes, on random strained states, every node against float64.

Their arithmetic is the same on either device; what only CUDA has, memory shared by groups of subtrees and warps that
add up, runs through the public models there (see ``test_miscompile``).
"""

import numpy as np
import oracle
import pytest
import warp as wp
from cases import oracle_mesh, random_displacement
from test_miscompile import FORESTS, TOLERANCE, materials, meshed, turned
from warp_corot.kernels import constitutive
from warp_corot.kernels.general_cuda import corotated_law
from warp_corot.kernels.rotation import quick_rotation
from warp_corot.kernels.subtree_cuda import BLOCK
from warp_corot.kernels.subtree_laws import scatter_subtrees

import warp_corot as wc
from warp_corot.elasticity.law_general import GeneralScatter
from warp_corot.plan import ForcePlan

LAWS = {
    "linear": constitutive.linear_stress,
    "stvk": constitutive.stvk_stress,
    "neo_hookean": constitutive.neo_hookean_stress,
}


def state(mesh, law, rng):
    """Displacements as the device has them, and positions in float64."""
    u = random_displacement(mesh, rng, 0.1) if law == "linear" else turned(mesh, rng, 0.1)
    return np.pad(u, ((0, 0), (0, 1))), mesh.points + u.astype(float)


def assert_right(forces, expected):
    wrong = np.abs(forces - expected).max(axis=1) > TOLERANCE * np.abs(expected).max()
    assert not wrong.any(), f"{wrong.sum()} of {wrong.size} nodes"


@pytest.mark.parametrize("uniform", [True, False], ids=["one material", "material per element"])
@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("name", FORESTS)
def test_subtrees_one_by_one(name, law, uniform, device, rng):
    """All subtrees of a forest, without the leaves that are in none."""
    mesh = meshed(name)
    given, (mu, lam) = materials(len(mesh.tets), uniform, rng)
    body = wc.SoftBody(mesh, wc.Isotropic(**given), device=device)
    u, x = state(mesh, law, rng)
    on_device = wp.array(u, dtype=wp.vec4, device=device)
    f = wp.zeros_like(on_device)
    plan = ForcePlan.of_forest(mesh, None, wp.get_device(device), grouped=False)
    for batch in plan.batches:
        subtrees = batch.subtrees
        if body.device.is_cpu:
            by_node = np.ascontiguousarray(subtrees.nodes.numpy().T)
            subtrees.nodes = subtrees.targets = wp.array(by_node, dtype=wp.int32, device=device)
        kernel = scatter_subtrees(batch.shape, False, uniform, LAWS[law])
        inputs = [subtrees, body.mu, body.lam, on_device]
        wp.launch(kernel, batch.count, inputs=inputs, outputs=[f], device=device, block_dim=BLOCK)
    inside = np.ones(len(mesh.tets), bool)
    inside[plan.flat.leaves.numpy()] = False
    assert inside.sum() > 1000
    mu, lam = (np.broadcast_to(value, inside.shape)[inside] for value in (mu, lam))
    _, expected = oracle.evaluate(law, oracle.Mesh(mesh.points, mesh.tets[inside]), x, mu, lam)
    assert_right(f.numpy()[:, :3], expected)


@pytest.mark.parametrize("uniform", [True, False], ids=["one material", "material per element"])
@pytest.mark.parametrize("law", [*LAWS, "corotated"])
def test_general_elements(law, uniform, device, rng):
    mesh = meshed("general")
    given, (mu, lam) = materials(len(mesh.tets), uniform, rng)
    body = wc.SoftBody(mesh, wc.Isotropic(**given), device=device)
    u, x = state(mesh, law, rng)
    on_device = wp.array(u, dtype=wp.vec4, device=device)
    f = wp.zeros_like(on_device)
    stress = LAWS.get(law) or corotated_law(quick_rotation)
    GeneralScatter(body.elements, stress)([body.mu, body.lam, body.material_stride], on_device, f)
    assert_right(f.numpy()[:, :3], oracle.evaluate(law, oracle_mesh(mesh), x, mu, lam)[1])
