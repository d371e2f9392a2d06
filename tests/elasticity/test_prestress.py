"""Initial stress: a free bar, a string's frequency, gradients, and several kinds together."""

import numpy as np
import oracle
import pytest
from cases import jittered, mixed_forest, random_displacement
from tangents import assert_diagonal, assert_symmetric, on_device, product

import warp_corot as wc

LAW = wc.NeoHookean(dilatation="element")


def test_a_free_bar_contracts_by_stress_over_modulus(device):
    """And widens by Poisson's ratio times as much."""
    mesh = wc.TetForest.box((1, 1, 2), 0.1, 2)
    body = wc.SoftBody(mesh, wc.Isotropic(1e4, 0.3, 1000.0), device=device)
    strain = 1e-3
    model = wc.Prestressed(np.diag([0, 0, strain * 1e4]), wc.Corotated())
    assert wc.solve_static(body, model=model, gravity=(0, 0, 0), tolerance=1e-5).converged
    u = body.displacements.numpy()
    u = u - u.mean(0)
    expected = (mesh.points - mesh.points.mean(0)) * [0.3 * strain, 0.3 * strain, -strain]
    assert np.abs(u - expected).max() < 5e-3 * np.abs(expected).max()


@pytest.mark.parametrize(
    "make",
    [
        lambda forest: forest,
        pytest.param(lambda forest: wc.TetMesh(forest.points, forest.tets), marks=pytest.mark.slow),
    ],
)
def test_a_string_sounds_at_the_root_of_stress_over_density(make, device):
    """w = pi / L sqrt(S / rho). Cells of length h with mass at the ends have 2 / h sqrt(S / rho) sin(pi h / 2 L), 0.4 %
    less. Young's modulus is so small that clamped ends hardly matter."""
    mesh = make(wc.TetForest.box((1, 1, 10), 0.1, 0))
    body = wc.SoftBody(mesh, wc.Isotropic(1.0, 0.0, 1000.0), device=device)
    body.fix("z == zmin or z == zmax")
    model = wc.Prestressed(np.diag([0, 0, 1e4]), wc.Corotated())
    sim = wc.Simulation(body, model=model, gravity=(0, 0, 0))
    kick = np.zeros_like(mesh.points)
    kick[:, 0] = 1e-3 * np.sin(np.pi * mesh.points[:, 2])
    body.velocities = kick
    frequency = np.pi * np.sqrt(1e4 / 1000.0)
    middle = np.flatnonzero(np.isclose(mesh.points[:, 2], 0.5))
    times, heights = [], []
    for _ in range(60):
        sim.advance(2 * np.pi / frequency / 20)
        times.append(sim.time)
        heights.append(body.displacements.numpy()[middle, 0].mean())
    t, x = np.array(times), np.array(heights, float)
    before = np.flatnonzero(np.diff(np.sign(x)))
    crossings = t[before] - x[before] * np.diff(t)[before] / np.diff(x)[before]
    found = np.pi * (len(crossings) - 1) / (crossings[-1] - crossings[0])
    print(found / frequency)
    assert found == pytest.approx(20.0 * np.sqrt(1e4 / 1000.0) * np.sin(np.pi / 20), rel=0.002)


@pytest.mark.parametrize("make", [mixed_forest, pytest.param(jittered, marks=pytest.mark.slow)])
def test_force_and_stiffness_are_derivatives(make, device, rng):
    """With a stress of each element, beside a law that relaxes, in a body that has turned."""
    mesh = make()
    stress = rng.standard_normal((len(mesh.tets), 3, 3)) * 300.0
    model = wc.Prestressed(stress + np.swapaxes(stress, 1, 2), wc.Prony(0.5, 0.1, LAW))
    field = model.bind(wc.SoftBody(mesh, wc.Isotropic(500.0, 0.3, 10.0), device=device))
    turn = oracle.polar(rng.standard_normal((3, 3)))
    u = ((mesh.points + random_displacement(mesh, rng, 0.1)) @ turn.T - mesh.points).astype(np.float32)
    du, ends, energies = random_displacement(mesh, rng, 2e-3), [], []
    for sign in (1, -1):
        moved = on_device(u + sign * du, field)
        ends.append(field.elastic_forces(moved).numpy()[:, :3])
        energies.append(field.elastic_energy(moved))
    there = field.elastic_forces(on_device(u, field)).numpy()[:, :3]
    assert energies[0] - energies[1] == pytest.approx(-2 * (there.astype(float) * du).sum(), rel=2e-3)
    change = ends[1] - ends[0]
    assert np.abs(product(field, u, 2 * du) - change).max() < 2e-3 * np.abs(change).max()
    assert_symmetric(field, mesh, u, rng)
    assert_diagonal(field, u, rng.choice(len(u), 2, replace=False))
    x = mesh.points + u
    assert np.abs(np.cross(x, there).sum(0)).max() < 1e-5 * np.abs(x).max() * np.abs(there).sum()


def test_it_is_saved_and_acts_in_all_worlds(device, tmp_path):
    mesh = wc.TetForest.box((1, 1, 2), 0.064, 1)
    body = wc.SoftBody(mesh, wc.Isotropic(500.0, 0.3, 10.0), worlds=2, device=device)
    body.fix("z == zmin")
    stress = np.zeros((len(mesh.tets), 3, 3))
    stress[: len(stress) // 2, 2, 2] = 50.0
    sim = wc.Simulation(body, model=wc.Prestressed(stress, LAW), integrator=wc.BackwardEuler(dt=0.01))
    sim.advance(0.1)
    u = body.displacements.numpy().reshape(2, -1, 3)
    np.testing.assert_allclose(u[1], u[0], rtol=1e-4, atol=1e-7)
    sim.save(tmp_path / "stressed.npz")
    assert wc.Simulation.load(tmp_path / "stressed.npz", device=device).models == sim.models


def test_invalid_stresses_are_refused(device):
    body = wc.SoftBody(wc.TetForest.box((1, 1, 1), 0.1, 1), wc.Isotropic(500.0, 0.3, 10.0), device=device)
    for stress in ([1.0, 2.0], np.full((3, 3), np.nan), [[0, 1, 0], [0, 0, 0], [0, 0, 0]]):
        with pytest.raises(wc.InputError, match="stress"):
            wc.Prestressed(stress)
    with pytest.raises(wc.InputError, match="stress has 2 tensors"):
        wc.Prestressed(np.zeros((2, 3, 3))).bind(body)
