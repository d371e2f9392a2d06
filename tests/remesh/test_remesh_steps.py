"""Steps of a body that is remeshed equal those of a body on a mesh made that way."""

import numpy as np
import pytest
import warp as wp
from remeshed import SOFT, near, twin

import warp_corot as wc
from warp_corot.kernels.remesh.criteria import ElementState


@wp.func
def within(element: ElementState, parameters: wp.array[wp.float32]):
    """1 for elements with a corner within a distance of a point."""
    point = wp.vec3(parameters[0], parameters[1], parameters[2])
    least = wp.length(element.corner - point)
    for n in range(1, 4):
        least = wp.min(least, wp.length(element.corner + element.rest[n] - point))
    return wp.where(least < parameters[3], 1.0, 0.0)


#: Stable for the finest of these meshes.
DT = 1e-4

MODELS = [
    wc.Corotated(),
    wc.Corotated(rotation_level=4),
    wc.Corotated(rotation_level="auto"),
    wc.Corotated(subtrees=False),
    wc.Linear(),
    wc.StVenantKirchhoff(),
    wc.NeoHookean(),
    wc.EdgeStVK(),
]


@pytest.mark.parametrize("model", MODELS, ids=repr)
@pytest.mark.parametrize(
    "varied", [pytest.param(False, id="uniform", marks=pytest.mark.slow), pytest.param(True, id="varied")]
)
def test_steps_go_on_as_on_a_mesh_made_that_way(model, varied, device):
    mesh = wc.TetForest.box((4, 1, 1), 0.05, 6)
    young = (lambda x: 2e4 + 4e5 * x[:, 0]) if varied else 3e4
    density = (lambda x: 900.0 + 2e3 * x[:, 1]) if varied else 1000.0
    body = wc.SoftBody(mesh, wc.Isotropic(young=young, poisson=0.4, density=density), device=device)
    body.fix(mesh.points[:, 0] < 1e-9)
    body.load(mesh.points[:, 0] > 0.2 - 1e-9, [0.0, 0.0, 0.1])
    mass = body.masses.sum()
    remesh = near(0.1, device)
    # Given, so that both take the same step: one that follows the state is measured again during the run.
    integrator = wc.SymplecticEuler(dt=DT, damping=1.0)
    sim = wc.Simulation(body, model=model, integrator=integrator, remesh=remesh)
    counts = set()
    for x in (0.05, 0.1, 0.15, 0.0):
        remesh.parameters.assign([x, 0.02])
        sim.advance_steps(20)
        counts.add(body.element_count)
        assert body.masses.sum() == pytest.approx(mass, rel=1e-12)
        fixed = twin(body, model, sim)
        sim.advance_steps(3)
        fixed.advance_steps(3)
        moved = np.abs(fixed.body.displacements.numpy()).max()
        assert np.abs(body.displacements.numpy() - fixed.body.displacements.numpy()).max() < 1e-5 * moved
        # Energies of small strains are rounded to 1e-7 of the stiffness.
        assert sim.energy().elastic == pytest.approx(fixed.energy().elastic, rel=1e-4, abs=1e-7 * 1e4 * 5e-4)
        np.testing.assert_allclose(sim.von_mises(), fixed.von_mises(), rtol=1e-2, atol=1e-3 * fixed.von_mises().max())
        sim.advance_steps(2)
    assert len(counts) == 4


def test_bodies_of_domains_go_on_as_on_a_mesh_made_that_way(device):
    ball = wc.Domain.sphere(0.04, device=device)
    mesh = wc.TetForest.from_domain(ball, 0.03, max_level=6)
    young = np.where(mesh.points[mesh.tets].mean(axis=1)[:, 1] > 0, 2e4, 6e4)
    body = wc.SoftBody(mesh, wc.Isotropic(young=young, poisson=0.4, density=1000.0), device=device)
    body.fix(mesh.points[:, 2] < -0.03)
    mass, enclosed = body.masses.sum(), float((mesh.fill * mesh.volumes).sum())
    remesh = near(0.0, device, max_level=8)
    sim = wc.Simulation(body, integrator=wc.SymplecticEuler(dt=2.0 * DT, damping=1.0), remesh=remesh)
    for x in (-0.02, 0.02):
        remesh.parameters.assign([x, 0.01])
        sim.advance_steps(25)
        present = body.mesh
        assert len(present.tets) != len(mesh.tets)
        assert body.masses.sum() == pytest.approx(mass, rel=1e-12)
        assert float((present.fill * present.volumes).sum()) == pytest.approx(enclosed, rel=1e-6)
        fixed = twin(body, wc.Corotated(), sim)
        sim.advance_steps(3)
        fixed.advance_steps(3)
        moved = np.abs(fixed.body.displacements.numpy()).max()
        assert np.abs(body.displacements.numpy() - fixed.body.displacements.numpy()).max() < 1e-5 * moved
        np.testing.assert_allclose(sim.von_mises(), fixed.von_mises(), rtol=1e-2, atol=1e-3 * fixed.von_mises().max())
        sim.advance_steps(2)


def test_the_step_is_stable_for_the_mesh_of_every_time(device):
    """A patch of fine elements grows, and with it the largest frequency at the same finest level."""
    body = wc.SoftBody(wc.TetForest.box((4, 1, 1), 0.05, 3), SOFT, device=device)
    body.fix(body.mesh.points[:, 0] < 1e-9)
    numbers = wp.array([0.1, 0.025, 0.025, 1e-4], dtype=wp.float32, device=device)
    remesh = wc.OnlineRemesh(
        criterion=within, parameters=numbers, refine_above=0.5, simplify_below=-1.0, min_level=3, max_level=9, every=5
    )
    sim = wc.Simulation(body, remesh=remesh)
    sim.advance_steps(60)
    small = int((body.mesh.levels == 9).sum())
    for reach in (5e-3, 1e-2, 2e-2, 4e-2):
        numbers.assign([0.1, 0.025, 0.025, reach])
        sim.advance_steps(30)
        fixed = wc.SoftBody(body.mesh, body.material, device=device)
        fixed.fix(body.constrained)
        assert sim.dt <= 1.02 * wc.Corotated.step_safety * wc.Simulation(fixed).stable_dt
    assert int((body.mesh.levels == 9).sum()) > 50 * small > 0
