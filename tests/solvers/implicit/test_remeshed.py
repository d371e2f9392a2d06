"""Implicit steps of bodies whose meshes follow the motion."""

from dataclasses import replace

import numpy as np
import pytest
from remeshed import near

import warp_corot as wc


def bar(device):
    mesh = wc.TetForest.box(cells=(1, 1, 3), cell_size=0.064, level=3)
    body = wc.SoftBody(mesh, wc.Isotropic(young=2e4, poisson=0.4, density=1000.0), device=device)
    body.fix(mesh.points[:, 2] < 1e-9)
    return body


def swung(device, integrator, remesh, seconds=0.5):
    body = bar(device)
    sim = wc.Simulation(body, integrator=integrator, gravity=(0.0, -9.81, 0.0), remesh=remesh)
    sim.advance(seconds)
    return sim


@pytest.mark.parametrize(
    "integrator",
    [wc.BackwardEuler(dt=0.01), wc.BackwardEuler(dt=0.01, preconditioner="diagonal"), wc.BDF2(dt=0.01)],
    ids=["chosen", "diagonal", "bdf2"],
)
def test_a_bar_that_adapts_comes_to_rest_where_its_mesh_does(integrator, device):
    """Passes every 8 steps refine and simplify the bar; in the end it hangs where ``solve_static`` finds it on its last
    mesh."""
    remesh = wc.OnlineRemesh(every=8, max_level=6, refine_above=1.05, simplify_below=1.01)
    sim = swung(device, replace(integrator, damping=15.0), remesh, seconds=0.9)
    body = sim.body
    assert len(body.mesh.tets) > 144
    assert sim.solves.unfinished == 0
    fixed = wc.SoftBody(body.mesh, wc.Isotropic(young=2e4, poisson=0.4, density=1000.0), device=device)
    fixed.fix(body.mesh.points[:, 2] < 1e-9)
    assert wc.solve_static(fixed, gravity=(0.0, -9.81, 0.0)).converged
    assert np.abs(body.displacements.numpy() - fixed.displacements.numpy()).max() < 2e-4


def test_a_resumed_run_is_the_uninterrupted_one(device, tmp_path):
    remesh = wc.OnlineRemesh(every=8, max_level=6, refine_above=1.05, simplify_below=1.01)
    sim = swung(device, wc.BackwardEuler(dt=0.01), remesh, seconds=0.25)
    sim.save(tmp_path / "state.npz")
    sim.advance_steps(12)
    later = wc.Simulation.load(tmp_path / "state.npz")
    later.advance_steps(12)
    if sim.device.is_cpu:
        np.testing.assert_array_equal(later.body.displacements.numpy(), sim.body.displacements.numpy())


def test_contact_follows_a_mesh_that_adapts(device):
    mesh = wc.TetForest.box(cells=(2, 2, 1), cell_size=0.02, level=3, origin=(0.0, 0.0, 0.002))
    body = wc.SoftBody(mesh, wc.Isotropic(young=1e4, poisson=0.4, density=1000.0), device=device)
    ground, integrator = wc.Ground(), wc.BackwardEuler(dt=0.016)
    remesh = near(0.02, device, max_level=5)
    sim = wc.Simulation(body, obstacles=ground, integrator=integrator, gravity=(0.0, 0.0, -9.81), remesh=remesh)
    sim.advance_steps(30)
    assert len(body.mesh.tets) > len(mesh.tets)
    assert body.positions.numpy()[:, 2].min() > -1e-6
    assert ground.wrench.numpy()[0, 2] == pytest.approx(-9.81 * body.masses.sum(), rel=2e-3)


def test_quasi_static_steps_are_not_remeshed(device):
    with pytest.raises(wc.InputError, match="QuasiStatic does not support remeshing"):
        wc.Simulation(bar(device), integrator=wc.QuasiStatic(dt=0.1), remesh=wc.OnlineRemesh())
