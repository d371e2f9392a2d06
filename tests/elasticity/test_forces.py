"""Elastic forces and energies of every model, on every kind of mesh, against the float64 oracle.

The forces are float32: each is a sum of terms that rounding changes by some 1e-7 of the largest stress, times the
number of operations and elements around a node. A wrong weight, sign or index is 1e-2 or more.
"""

import numpy as np
import oracle
import pytest
from cases import (
    MATERIAL,
    MESHES,
    MODELS,
    jittered,
    mixed_forest,
    oracle_mesh,
    place,
    random_displacement,
    simulation,
)

import warp_corot as wc

MU, LAM = oracle.lame(MATERIAL["young"], MATERIAL["poisson"])
# nearly incompressible: lambda is 49 mu, so that a rounding of the trace weighs 100 times that of a strain
FORCE_TOLERANCE = 1e-5  # of the largest nodal force


def compare(sim, body, model, u, mu=MU, lam=LAM, tolerance=FORCE_TOLERANCE, **options):
    reference = oracle_mesh(body.mesh)
    energies, expected = oracle.evaluate(model, reference, reference.points + u.astype(float), mu, lam, **options)
    forces = sim.forces().numpy()
    assert np.isfinite(forces).all()
    assert np.abs(forces - expected).max() < tolerance * np.abs(expected).max()
    assert sim.energy().elastic == pytest.approx(energies.sum(), rel=tolerance)


@pytest.mark.parametrize("mesh", ["level 0", "level 3", "level 4", "level 5", "mixed levels", "general"])
@pytest.mark.parametrize("model", MODELS)
def test_forces_and_energy_equal_the_oracle(model, mesh, device, rng):
    """Strains around 0.3, with a large rotation if the model allows it."""
    mesh = MESHES[mesh]()
    sim, body = simulation(mesh, model, device)
    u = random_displacement(mesh, rng, 0.1)
    if model != "linear":
        turn = oracle.polar(rng.standard_normal((3, 3)))
        u = ((mesh.points + u) @ turn.T - mesh.points).astype(np.float32)
    place(body, u)
    compare(sim, body, model, u)


@pytest.mark.parametrize("model", [model for model in MODELS if "quadratic" not in model and model != "mass_spring"])
def test_inverted_elements_equal_the_oracle(model, device, rng):
    """Displacements of a whole edge invert elements; forces still follow from the energy.

    Corotated: an inverted element whose two smaller singular values nearly meet has no well-defined rotation; only
    nodes that no such element touches are compared.
    """
    mesh = wc.TetForest.box((1, 1, 1), 0.064, 3)
    sim, body = simulation(mesh, model, device)
    u = random_displacement(mesh, rng, 0.9)
    place(body, u)
    reference = oracle_mesh(mesh)
    F = reference.deformation_gradients(mesh.points + u.astype(float))
    assert (np.linalg.det(F) < -0.1).sum() > 5
    _, expected = oracle.evaluate(model, reference, mesh.points + u.astype(float), MU, LAM)
    sigma = np.linalg.svd(F, compute_uv=False)
    gap = sigma[:, 1] + sigma[:, 2] * np.sign(np.linalg.det(F))
    well = np.ones(len(mesh.points), bool)
    if model == "corotated":
        well[mesh.tets[gap < 0.1 * sigma[:, 0]]] = False
    assert well.sum() > 10
    assert np.abs(sim.forces().numpy() - expected)[well].max() < FORCE_TOLERANCE * np.abs(expected).max()


@pytest.mark.parametrize("model", MODELS)
def test_trajectory_equals_the_oracle(model, device, rng):
    """A hundred symplectic Euler steps with gravity, damping and fixed nodes, against the same in float64."""
    mesh = mixed_forest(seed=3, level=3, passes=1)
    fixed = mesh.points[:, 2] < 1e-9
    scheme = {"damping": 5.0, "gravity": (0.0, -9.8, 1.0)}
    sim, body = simulation(mesh, model, device, dt=1e-4, fixed=fixed, **scheme)
    u = np.where(fixed[:, None], 0, random_displacement(mesh, rng, 0.1)).astype(np.float32)
    place(body, u)
    reference = oracle_mesh(mesh)
    x, v = oracle.symplectic_euler(
        model,
        reference,
        mesh.points + u.astype(float),
        np.zeros_like(mesh.points),
        MU,
        LAM,
        reference.masses(MATERIAL["density"]),
        1e-4,
        100,
        fixed=fixed,
        **scheme,
    )
    for _ in range(10):
        sim.step()
    sim.advance(90e-4)
    assert sim.steps == 100
    assert sim.time == pytest.approx(0.01)
    moved = np.abs(x - mesh.points).max()
    assert np.abs(body.displacements.numpy() - (x - mesh.points)).max() < 1e-5 * moved
    assert np.abs(body.velocities.numpy() - v).max() < 1e-5 * np.abs(v).max()
    assert np.abs(body.positions.numpy() - x).max() < 1e-5 * moved + 1e-7 * np.abs(x).max()


def cauchy_von_mises(model, mesh, x, mu, lam):
    """sqrt(3/2 s:s), s the deviator of the Cauchy stress P F^T / J (linear, corotated: of Hooke's) [T] (Pa)."""
    F = mesh.deformation_gradients(x)
    if model == "corotated":
        P = np.swapaxes(oracle.polar(F), 1, 2) @ oracle.stress(model, mesh, x, mu, lam)
    else:
        P = oracle.stress("stvk" if model == "edge_stvk" else model, mesh, x, mu, lam)
        if model != "linear":
            P = P @ np.swapaxes(F, 1, 2) / np.linalg.det(F)[:, None, None]
    deviator = P - np.trace(P, axis1=1, axis2=2)[:, None, None] / 3 * np.eye(3)
    return np.sqrt(1.5 * np.sum(deviator**2, axis=(1, 2)))


@pytest.mark.parametrize("make", [mixed_forest, jittered])
@pytest.mark.parametrize("model", ["linear", "corotated", "stvk", "neo_hookean", "edge_stvk"])
def test_von_mises_stress(model, make, device, rng):
    mesh = make()
    sim, body = simulation(mesh, model, device)
    u = random_displacement(mesh, rng, 0.1)
    place(body, u)
    expected = cauchy_von_mises(model, oracle_mesh(mesh), mesh.points + u.astype(float), MU, LAM)
    stress = sim.von_mises()
    assert stress.dtype == np.float32
    assert np.abs(stress - expected).max() < FORCE_TOLERANCE * LAM


@pytest.mark.parametrize("strain", [1e-3, 1e-5])
@pytest.mark.parametrize("model", ["linear", "stvk", "edge_stvk", "edge_stvk_quadratic", "corotated", "neo_hookean"])
def test_digits_of_small_strains(model, strain, device, rng):
    """The digits that remain of float32's seven at small strains.

    Models written in the displacement gradient alone keep all, in forces and energy. Corotated strain is a
    difference R^T F - I: it resolves strains down to the rounding of a rotation, 1e-7.
    """
    mesh = mixed_forest()
    sim, body = simulation(mesh, model, device)
    u = random_displacement(mesh, rng, 0.3 * strain)
    place(body, u)
    reference = oracle_mesh(mesh)
    energies, expected = oracle.evaluate(model, reference, mesh.points + u.astype(float), MU, LAM)
    tolerance = 1e-6 / strain if model == "corotated" else 1e-5
    error = np.abs(sim.forces().numpy() - expected).max() / np.abs(expected).max()
    energy_error = abs(sim.energy().elastic / energies.sum() - 1)
    print(f"{model}, strain {strain}, {device}: {error:.1e}, energy {energy_error:.1e}")
    assert error < tolerance
    if model != "corotated":
        assert energy_error < tolerance
