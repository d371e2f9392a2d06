"""The float64 spectrum against the step that simulations find at rest, its own definition, and steps."""

import cases
import numpy as np
import oracle
import pytest
import spectrum

import warp_corot as wc

TISSUE = wc.Isotropic(young=5e3, poisson=0.44, density=1000.0)

MESHES = {"mixed levels": lambda: cases.mixed_forest(passes=1), "general": cases.jittered}


def held(mesh, model=None, device="cpu"):
    body = wc.SoftBody(mesh, TISSUE, device=device)
    body.fix(mesh.points[:, 1] < 0.1 * cases.CUBE)
    return wc.Simulation(body, model=model, gravity=(0, 0, 0))


def bent(mesh, amount=0.5):
    """Positions [N, 3] of a smooth large deformation: stretched, sheared and rotated."""
    x, y, z = mesh.points.T / cases.CUBE
    turn = amount * y
    moved = [
        np.cos(turn) * x + np.sin(turn) * z + 0.2 * amount * y**2,
        y * (1 + 0.6 * amount * x),
        -np.sin(turn) * x + np.cos(turn) * z,
    ]
    return cases.CUBE * np.stack(moved, axis=1)


@pytest.mark.parametrize("mesh", MESHES)
@pytest.mark.parametrize("law", list(cases.MODELS))
def test_at_rest_it_gives_the_step_that_simulations_find(law, mesh):
    sim = held(MESHES[mesh](), cases.MODELS[law]())
    # Lanczos' residual is added to the frequency there, so that the step is never above 2 / omega; float32 forces of
    # probing displacements are good to four digits.
    assert 0.98 < sim.stable_dt / spectrum.stable_step(law, sim.body) < 1.001


def test_at_rest_elements_that_the_surface_cuts_count_by_their_share():
    mesh = wc.TetForest.from_domain(wc.Domain.sphere(0.05), 0.04, max_level=6, surface_error=1e-3)
    sim = wc.Simulation(wc.SoftBody(mesh, TISSUE, device="cpu"), gravity=(0, 0, 0))
    assert 0.98 < sim.stable_dt / spectrum.stable_step("corotated", sim.body) < 1.001


@pytest.mark.parametrize("law", list(oracle.TANGENTS))
def test_differences_of_forces_give_the_exact_tangents(law):
    mesh = cases.oracle_mesh(cases.mixed_forest(passes=1))
    x = bent(mesh)
    exact = spectrum.stiffness(law, mesh, x, 3.0, 5.0)
    found = spectrum.stiffness(oracle.DENSITIES[law], mesh, x, 3.0, 5.0)
    # Central differences with steps of 1e-4 are off by 1e-8 times the third derivatives over the second.
    assert abs(found - exact).max() < 1e-6 * abs(exact).max()


def test_anisotropic_bodies_are_stiff_along_their_fibres():
    mesh = cases.oracle_mesh(wc.TetForest.box((1, 1, 1), cases.CUBE, 3))
    masses = mesh.masses(1000.0)

    def largest(*along):
        young, ratios, shear = oracle.transverse(*along)
        C = np.broadcast_to(oracle.elasticity(young, ratios, shear), (len(mesh.tets), 3, 3, 3, 3))
        return spectrum.largest_frequency(spectrum.stiffness(oracle.anisotropic, mesh, mesh.points, C, None), masses)

    mu, lam = oracle.lame(5e3, 0.45)
    isotropic = spectrum.largest_frequency(spectrum.stiffness("corotated", mesh, mesh.points, mu, lam), masses)
    shear = 5e3 / (2 * 1.45)
    # P is itself a difference, good to 1e-10, and is differenced again.
    assert largest(5e3, 5e3, 0.45, 0.45, shear) == pytest.approx(isotropic, rel=1e-5)
    assert largest(5e4, 5e3, 0.45, 0.45, shear) > 1.2 * isotropic


def test_shared_rotations_at_the_leaves_level_are_own_rotations():
    mesh = cases.oracle_mesh(wc.TetForest.box((1, 1, 1), cases.CUBE, 3))
    x = bent(mesh)
    own = spectrum.stiffness("corotated", mesh, x, 3.0, 5.0)
    shared = spectrum.shared_stiffness(mesh.tets, mesh, x, 3.0, 5.0)
    assert abs(shared - own).max() < 1e-6 * abs(own).max()


@pytest.mark.parametrize("law", ["corotated", "stvk", "neo_hookean"])
def test_a_strained_state_leaves_its_rest_above_the_step_only(law):
    """About equilibrium under load, steps just below 2 / omega are stable, and just above they grow exponentially."""
    mesh = cases.oracle_mesh(wc.TetForest.box((1, 1, 2), cases.CUBE, 3))
    mu, lam = (float(value) for value in oracle.lame(5e3, 0.4))
    masses, fixed = mesh.masses(1000.0), mesh.points[:, 2] < 1e-9
    gravity = np.array([0.0, 3.0, 4.0])
    x = oracle.equilibrium(law, mesh, mu, lam, fixed, masses[:, None] * gravity)
    assert np.abs(x - mesh.points).max() > 0.05 * cases.CUBE
    limit = 2 / spectrum.largest_frequency(spectrum.stiffness(law, mesh, x, mu, lam), masses, ~fixed)
    start = 1e-9 * np.random.default_rng(0).standard_normal(x.shape) * ~fixed[:, None]

    def growth(share):
        state = mesh, x + start, np.zeros_like(x), mu, lam, masses, share * limit, 45
        moved, _ = oracle.symplectic_euler(law, *state, gravity=gravity, fixed=fixed)
        return np.abs(moved - x).max() / np.abs(start).max()

    assert growth(0.98) < 1e2
    assert growth(1.02) > 1e4
