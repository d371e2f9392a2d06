"""The mesh data of force fields: plans of static meshes, and of meshes that change."""

import numpy as np
import pytest
import warp as wp
from remesh_cases import CUBE, apply_marks, random_marks

import warp_corot as wc
from warp_corot.elasticity.model import isotropic_material
from warp_corot.kernels.elements.constitutive import IsotropicMaterial, law_functions
from warp_corot.kernels.elements.forces import law_stress, scatter_forces

MATERIAL = wc.Isotropic(young=1e4, poisson=0.4, density=1000.0)


def adaptive(rng):
    forest = wc.TetForest.box((2, 1, 1), CUBE, 6)
    return forest.refine(rng.choice(len(forest.tets), 5, replace=False))


def forces(field, u):
    f = wp.zeros_like(u)
    field.add_forces(u, f)
    return f.numpy()[:, :3]


def random_displacements(count, places, rng, device):
    u = np.zeros((places, 4), np.float32)
    u[:count, :3] = 2e-3 * rng.standard_normal((count, 3))
    return wp.array(u, dtype=wp.vec4, device=device)


@pytest.mark.parametrize("worlds", [1, 3])
@pytest.mark.parametrize("general", [False, True])
@pytest.mark.parametrize("subtrees", [False, True])
def test_forces_by_slots_equal_forces_added_to_nodes(subtrees, general, worlds, device, rng):
    """Elements of a plan with slots write to slots, and gathering gives the same sums as adding to the nodes."""
    mesh = adaptive(rng)
    mesh = wc.TetMesh(mesh.points, mesh.tets) if general else mesh
    body = wc.SoftBody(mesh, MATERIAL, worlds=worlds, device=device)
    plan = body.discretization.plan(subtrees=subtrees, deterministic=True)
    u = random_displacements(body.node_count, body.node_count, rng, device)
    own = body.discretization
    kernel = scatter_forces(own.element_kind, IsotropicMaterial, law_stress(law_functions("stvk").stress))
    inputs = [isotropic_material([own.mu, own.lam, own.material_stride]), u]
    expected, found = wp.zeros_like(u), wp.zeros_like(u)
    wp.launch(
        kernel, body.element_count, inputs=[body.discretization.elements, *inputs], outputs=[expected], device=device
    )
    plan.slots.values.zero_()
    outputs = [plan.slots.values]
    wp.launch(kernel, body.element_count, inputs=[plan.elements, *inputs], outputs=outputs, device=device)
    plan.slots.gather(found)
    np.testing.assert_allclose(found.numpy(), expected.numpy(), atol=1e-6 * np.abs(expected.numpy()).max())


def test_a_field_without_subtrees_uses_the_bodys_elements(device, rng):
    body = wc.SoftBody(adaptive(rng), MATERIAL, device=device)
    plan = body.discretization.plan(subtrees=False)
    assert plan.elements is body.discretization.elements
    assert plan.batches == ()
    assert len(plan.flat) == 0
    assert plan.slots is None
    assert plan.counts is None
    assert body.discretization.plan().elements is body.discretization.elements


@pytest.mark.parametrize("model", [wc.Corotated(), wc.Corotated(rotation_level=4), wc.NeoHookean()], ids=str)
def test_a_field_bound_to_a_remeshed_body_uses_its_present_mesh(model, device, rng):
    """The simulation's own field still follows the mesh."""
    source = adaptive(rng)
    body = wc.SoftBody(source, MATERIAL, device=device)
    options = wc.OnlineRemesh(capacity=4 * len(source.tets), min_level=0, max_level=48)
    sim = wc.Simulation(body, model=model, remesh=options)
    changing = sim.remeshing.changing[0]
    for _ in range(2):
        apply_marks(changing.passes, random_marks(changing.forest, rng, 0.05, 0.2))
        changing.renew()
        other = model.bind(body)
        assert other.plan is not sim.fields[0].plan
        alone = wc.SoftBody(changing.forest.to_forest(), MATERIAL, device=device)
        u = random_displacements(body.node_count, len(body.state.displacements), rng, device)
        expected = forces(model.bind(alone), wp.clone(u[: body.node_count]))
        for field in (other, sim.fields[0]):
            found = forces(field, u)[: body.node_count]
            np.testing.assert_allclose(found, expected, atol=3e-6 * np.abs(expected).max())
