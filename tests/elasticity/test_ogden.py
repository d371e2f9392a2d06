"""Ogden's law: the float64 formula, its differences, closed forms, neo-Hookean as a case, and stability."""

import numpy as np
import oracle
import pytest
from cases import jittered, mixed_forest, oracle_mesh, random_displacement
from tangents import assert_diagonal, assert_equal, assert_symmetric, difference, product

import warp_corot as wc
from warp_corot.elasticity.float64 import cauchy_stress, displacement_gradients

MATERIAL = {"young": 500.0, "poisson": 0.4, "density": 10.0}
MU, LAM = oracle.lame(MATERIAL["young"], MATERIAL["poisson"])
TERMS = ((0.7, 8.0), (0.3, -4.0))
MODEL = wc.Ogden(mu=(1.4, 0.6), alpha=(8.0, -4.0), dilatation="element")


def plain(F, mu=MU, lam=LAM, terms=TERMS):
    """Energy density and P by singular values, without any continuation."""
    u, s, vt = np.linalg.svd(F)
    log = np.log(s)
    psi = 0.5 * lam * log.sum(-1) ** 2
    slope = lam * log.sum(-1, keepdims=True) / s
    for share, alpha in terms:
        psi = psi + 2 * mu * share / alpha**2 * (s**alpha - 1 - alpha * log).sum(-1)
        slope = slope + 2 * mu * share / alpha * (s**alpha - 1) / s
    return psi, (u * slope[..., None, :]) @ vt


def forces(mesh, u, mu=MU, lam=LAM):
    reference = oracle_mesh(mesh)
    return oracle.continuum(plain, reference, mesh.points + u.astype(float), mu, lam)[1]


def bound(mesh, device, model=MODEL, **options):
    return model.bind(wc.SoftBody(mesh, wc.Isotropic(**(MATERIAL | options)), device=device))


@pytest.mark.parametrize("make", [mixed_forest, pytest.param(jittered, marks=pytest.mark.slow)])
def test_forces_and_stiffness_equal_the_float64_formula(make, device, rng):
    mesh = make()
    field = bound(mesh, device)
    turn = oracle.polar(rng.standard_normal((3, 3)))
    u = random_displacement(mesh, rng, 0.06)
    u = ((mesh.points + u) @ turn.T - mesh.points).astype(np.float32)
    p = random_displacement(mesh, rng, 1.0)
    body = wc.SoftBody(mesh, wc.Isotropic(**MATERIAL), device=device)
    sim = wc.Simulation(body, model=MODEL, gravity=(0, 0, 0))
    body.displacements = u
    assert_equal(sim.forces().numpy(), forces(mesh, u))
    energies, _ = oracle.continuum(plain, oracle_mesh(mesh), mesh.points + u.astype(float), MU, LAM)
    assert sim.energy().elastic == pytest.approx(energies.sum(), rel=1e-5)
    A = displacement_gradients(mesh.points, mesh.tets, u)
    F = np.eye(3) + A
    s = cauchy_stress(MODEL, A, MATERIAL["young"], MATERIAL["poisson"])
    expected = plain(F)[1] @ np.swapaxes(F, 1, 2) / np.linalg.det(F)[:, None, None]
    # The law's constants are floats on all devices, and files have these stresses as floats.
    assert np.abs(s - expected).max() < 1e-6 * np.abs(expected).max()
    s = s - np.trace(s, axis1=1, axis2=2)[:, None, None] / 3 * np.eye(3)
    assert_equal(sim.von_mises(), np.sqrt(1.5 * (s * s).sum((1, 2))))
    expected = difference(
        lambda x: oracle.continuum(plain, oracle_mesh(mesh), x, MU, LAM)[1], mesh.points + u.astype(float), p
    )
    assert_equal(product(field, u, p), expected, tolerance=1e-5)
    assert_symmetric(field, mesh, u, rng)
    assert_diagonal(field, u, rng.choice(len(u), 3, replace=False))


@pytest.mark.parametrize("strain", [1e-3, 1e-5])
def test_digits_of_small_displacements(strain, device, rng):
    mesh = mixed_forest()
    u = random_displacement(mesh, rng, 0.3 * strain)
    body = wc.SoftBody(mesh, wc.Isotropic(**MATERIAL), device=device)
    sim = wc.Simulation(body, model=MODEL, gravity=(0, 0, 0))
    body.displacements = u
    assert_equal(sim.forces().numpy(), forces(mesh, u))


def principal(model, stretches, poisson, device):
    """Principal Piola stresses [Pa] of a cube of homogeneous deformation diag(stretches) + maybe more."""
    mesh = wc.TetForest.box((1, 1, 1), 1.0, 0)
    body = wc.SoftBody(mesh, wc.Isotropic(500.0, poisson, 10.0), device=device)
    sim = wc.Simulation(body, model=model, gravity=(0, 0, 0))
    F = np.diag(stretches) if np.ndim(stretches) == 1 else np.asarray(stretches)
    body.displacements = mesh.points @ (F - np.eye(3)).T
    f = sim.forces().numpy()
    return -np.array([[f[mesh.points[:, j] > 0.5].sum(0)[i] for j in range(3)] for i in range(3)])


@pytest.mark.parametrize("stretch", [0.7, 1.0, 1.5])
def test_incompressible_closed_forms(stretch, device):
    """Uniaxial, equibiaxial and simple shear of one term, for which P = 2 mu / alpha (...) without a pressure.

    In isochoric motion lambda's part vanishes, and what the lateral faces carry is taken off as a pressure."""
    mu, _ = oracle.lame(500.0, 0.4)
    for alpha in (8.0, -4.0):
        law = wc.Ogden(mu=3.0, alpha=alpha, dilatation="element")
        across = stretch**-0.5
        P = principal(law, (stretch, across, across), 0.4, device)
        nominal = P[0, 0] - P[1, 1] * across / stretch
        expected = 2 * mu / alpha * (stretch ** (alpha - 1) - stretch ** (-alpha / 2 - 1))
        assert nominal == pytest.approx(expected, rel=1e-4, abs=1e-3)
        through = stretch**-2
        P = principal(law, (stretch, stretch, through), 0.4, device)
        nominal = P[0, 0] - P[2, 2] * through / stretch
        expected = 2 * mu / alpha * (stretch ** (alpha - 1) - stretch ** (-2 * alpha - 1))
        assert nominal == pytest.approx(expected, rel=1e-4, abs=1e-3)
        shear = stretch - 1.0
        P = principal(law, np.array([[1, shear, 0], [0, 1, 0], [0, 0, 1]]), 0.4, device)
        largest = shear / 2 + np.sqrt(1 + shear**2 / 4)
        # The work of the shear stress: dW/dshear with dlargest/dshear = largest^2 / (1 + largest^2).
        expected = 2 * mu / alpha * (largest**alpha - largest**-alpha) / largest * largest**2 / (1 + largest**2)
        assert P[0, 1] == pytest.approx(expected, rel=1e-4, abs=1e-3)


def test_one_term_of_two_is_neo_hookean(device, rng):
    """Turned-over elements too."""
    mesh = mixed_forest()
    u = random_displacement(mesh, rng, 0.9)
    found = [
        model.bind(wc.SoftBody(mesh, wc.Isotropic(**MATERIAL), device=device))
        for model in (wc.Ogden(5.0, 2.0, dilatation="element"), wc.NeoHookean(dilatation="element"))
    ]
    p = random_displacement(mesh, rng, 1.0)
    assert_equal(product(found[0], u, p), product(found[1], u, p).astype(float))


def test_force_is_the_gradient_where_elements_are_turned_over(device, rng):
    mesh = mixed_forest()
    body = wc.SoftBody(mesh, wc.Isotropic(**MATERIAL), device=device)
    sim = wc.Simulation(body, model=MODEL, gravity=(0, 0, 0))
    u, du = random_displacement(mesh, rng, 0.9), random_displacement(mesh, rng, 2e-3)
    energies, work = [], []
    for step in (-1, 0, 1):
        body.displacements = u + step * du
        energies.append(sim.energy().elastic)
        work.append(-(sim.forces().numpy().astype(float) * du).sum())
    assert energies[2] - energies[0] == pytest.approx((work[0] + 4 * work[1] + work[2]) / 3, rel=2e-3)


@pytest.mark.parametrize(("alpha", "young"), [(20.0, 500.0), pytest.param(-20.0, 500.0, marks=pytest.mark.slow)])
def test_beam_under_its_weight_is_stable(alpha, young, device):
    mesh = wc.TetForest.box((1, 1, 3), 0.064, 1)
    body = wc.SoftBody(mesh, wc.Isotropic(young, 0.45, 10.0), device=device)
    body.fix("z == zmin")
    sim = wc.Simulation(body, model=wc.Ogden(mu=1.0, alpha=alpha), integrator=wc.SymplecticEuler(damping=2.0))
    start = sim.energy().total
    sim.advance(0.5)
    assert np.isfinite(body.displacements.numpy()).all()
    assert sim.energy().total < start
    assert body.displacements.numpy().min() < -1e-3


def test_worlds_shared_dilatation_and_checkpoints(device, tmp_path):
    """Fields of the material, one for each world, and a dilatation that elements share."""
    mesh = wc.TetForest.box((1, 1, 2), 0.064, 3)
    body = wc.SoftBody(mesh, wc.Isotropic(np.array([[500.0], [2000.0]]), 0.49, 10.0), worlds=2, device=device)
    body.fix("z == zmin")
    sim = wc.Simulation(body, model=wc.Ogden(mu=(1.4, 0.6), alpha=(8.0, -4.0)))
    assert sim.fields[0].shares_dilatation
    sim.advance(0.02)
    assert sim.world_energies().kinetic[0] > 1.2 * sim.world_energies().kinetic[1]
    sim.save(tmp_path / "ogden.npz")
    assert wc.Simulation.load(tmp_path / "ogden.npz").models == sim.models


def test_refuses_numbers_out_of_range():
    for options in ({"mu": -1.0}, {"alpha": 0.0}, {"alpha": 100.0}, {"mu": (1, 2)}, {"mu": (), "alpha": ()}):
        with pytest.raises(wc.InputError, match=r"mu|alpha"):
            wc.Ogden(**options)
