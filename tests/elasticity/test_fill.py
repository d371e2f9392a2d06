"""Partly filled elements: mass, stiffness, energy and active stress scale with the filled fraction, stresses do not."""

from dataclasses import replace

import numpy as np
import pytest

import warp_corot as wc

FIBRES = {
    "young_along": 8e3,
    "young_across": 2e3,
    "poisson_along": 0.3,
    "poisson_across": 0.4,
    "shear_along": 1.5e3,
    "density": 1050.0,
}
MODELS = [
    wc.Corotated(),
    wc.Corotated(rotation_level=2),
    wc.Corotated(subtrees=False),
    wc.Linear(),
    wc.StVenantKirchhoff(),
    wc.NeoHookean(),
    wc.EdgeStVK(),
    wc.MassSpring(),
]


@pytest.fixture(scope="module")
def ball():
    """A sphere in elements of two levels, half of them cut by it."""
    mesh = wc.TetForest.from_domain(wc.Domain.sphere(0.05), 0.04, max_level=6, surface_error=1e-3)
    assert mesh.fill is not None
    assert 0.2 < np.mean(mesh.fill != 1.0) < 0.9
    return mesh


def filled(mesh):
    """The same forest without its filled fractions."""
    return replace(mesh, phi=None, fill=None)


def bodies(mesh, device, materials):
    """The body, and one with full elements whose material is reduced by the filled fractions."""
    whole = wc.TetMesh(mesh.points, mesh.tets)
    return [wc.SoftBody(m, material, device=device) for m, material in zip((mesh, whole), materials, strict=True)]


def moved(body, rng):
    edge = np.cbrt(body.mesh.volumes.mean())
    body.displacements = 0.05 * edge * rng.uniform(-1, 1, (body.node_count, 3))


@pytest.mark.parametrize("model", MODELS, ids=str)
def test_forces_and_energy_scale_with_the_filled_fraction(ball, model, device, rng):
    isotropic = [wc.Isotropic(3e3 * share, 0.4, 1000.0 * share) for share in (1.0, ball.fill)]
    body, weak = bodies(ball, device, isotropic)
    if not isinstance(model, wc.Corotated):
        other = model
    elif model.rotation_level is None:
        other = wc.Corotated()
    else:
        # A general mesh has no tree.
        weak, other = wc.SoftBody(filled(ball), isotropic[1], device=device), model
    moved(body, rng)
    weak.displacements = body.displacements.numpy()
    np.testing.assert_allclose(body.masses, weak.masses, rtol=1e-12)
    sims = [wc.Simulation(b, model=m) for b, m in ((body, model), (weak, other))]
    forces, expected = (sim.forces().numpy() for sim in sims)
    np.testing.assert_allclose(forces, expected, atol=1e-5 * np.abs(expected).max())
    energies = [sim.energy().elastic for sim in sims]
    assert energies[0] == pytest.approx(energies[1], rel=1e-4)
    assert sims[0].stable_dt == pytest.approx(sims[1].stable_dt, rel=1e-3)


@pytest.mark.parametrize("model", [MODELS[0], MODELS[1], *MODELS[4:8]], ids=str)
def test_stress_is_that_of_the_material(ball, model, device, rng):
    """The stress is that of the filled part: the same as in full elements of the material."""
    cut, whole = (wc.SoftBody(m, wc.Isotropic(3e3, 0.4, 1000.0), device=device) for m in (ball, filled(ball)))
    moved(cut, rng)
    whole.displacements = cut.displacements.numpy()
    stress, expected = (wc.Simulation(b, model=model).von_mises() for b in (cut, whole))
    np.testing.assert_allclose(stress, expected, rtol=1e-5)


def test_fibres_and_active_stress_scale_with_the_filled_fraction(ball, device, rng):
    share = ball.fill
    weaker = FIBRES | {name: FIBRES[name] * share for name in ("young_along", "young_across", "shear_along", "density")}
    materials = [wc.TransverselyIsotropic(direction=[1.0, 2.0, 0.5], **given) for given in (FIBRES, weaker)]
    body, weak = bodies(ball, device, materials)
    moved(body, rng)
    weak.displacements = body.displacements.numpy()
    body.activate(500.0)
    weak.activate(500.0 * share)
    sims = [wc.Simulation(b) for b in (body, weak)]
    forces, expected = (sim.forces().numpy() for sim in sims)
    np.testing.assert_allclose(forces, expected, atol=1e-5 * np.abs(expected).max())
    assert sims[0].energy().elastic == pytest.approx(sims[1].energy().elastic, rel=1e-4)


def test_mass_is_the_density_times_the_volume_inside_the_surface(ball, device):
    surface = ball.surface()
    a, b, c = surface.points[surface.triangles].transpose(1, 0, 2)
    volume = np.einsum("ti,ti->", a, np.cross(b, c)) / 6.0
    body = wc.SoftBody(ball, wc.Isotropic(3e3, 0.4, 1234.0), worlds=2, device=device)
    assert body.masses.sum() == pytest.approx(2 * 1234.0 * volume, rel=1e-6)
    assert (body.masses > 0).all()
