"""Stiffness-proportional damping: the energy it removes, the motion it leaves alone, and its stable step."""

import numpy as np
import pytest

import warp_corot as wc
from warp_corot.elasticity.added_stress import Viscosity

BOX = wc.TetForest.box((1, 1, 2), 0.1, 3)
GENERAL = wc.TetMesh(BOX.points, BOX.tets)
SKEW = np.array([[0.0, -0.3, 0.5], [0.3, 0.0, -0.2], [-0.5, 0.2, 0.0]])


def forces(mesh, displacements, velocities, device, seconds=0.1, deterministic=False, **options) -> np.ndarray:
    """Viscous forces of a body in a state [N], float64 [N, 3]."""
    body = wc.SoftBody(mesh, wc.Isotropic(1e5, 0.3, 1000.0), device=device, **options)
    body.displacements, body.velocities = displacements, velocities
    field = wc.Corotated().bind(body, deterministic=deterministic)
    Viscosity(body, field, seconds).add_forces()
    return body.state.forces.numpy()[:, :3].astype(np.float64)


def strained(mesh, rng, amount=0.25) -> np.ndarray:
    """Displacements of a body that is rotated by a radian and strained."""
    from scipy.spatial.transform import Rotation

    x = mesh.points
    stretched = x @ (np.eye(3) + amount * rng.uniform(-1.0, 1.0, (3, 3))) + 0.02 * amount * rng.normal(size=x.shape)
    return Rotation.from_rotvec([0.4, -0.7, 0.6]).apply(stretched) - x


@pytest.mark.parametrize("mesh", [BOX, GENERAL], ids=["forest", "general"])
def test_at_rest_it_is_the_linear_stiffness_of_the_velocities(mesh, device, rng):
    v = rng.normal(size=mesh.points.shape)
    linear = wc.Simulation(wc.SoftBody(mesh, wc.Isotropic(1e5, 0.3, 1000.0), device=device), model=wc.Linear())
    linear.body.displacements = 0.1 * v
    expected = linear.forces().numpy()
    np.testing.assert_allclose(
        forces(mesh, np.zeros_like(v), v, device), expected, rtol=0, atol=1e-5 * np.abs(expected).max()
    )


@pytest.mark.parametrize("mesh", [BOX, GENERAL], ids=["forest", "general"])
def test_it_removes_energy_and_conserves_both_momenta(mesh, device, rng):
    u = strained(mesh, rng)
    for _ in range(5):
        v = rng.normal(size=u.shape)
        f = forces(mesh, u, v, device)
        scale = np.abs(f).sum()
        assert np.sum(f * v) < -1e-3 * scale
        np.testing.assert_allclose(f.sum(axis=0), 0.0, atol=1e-6 * scale)
        np.testing.assert_allclose(np.cross(mesh.points + u, f).sum(axis=0), 0.0, atol=1e-6 * scale)


@pytest.mark.parametrize("mesh", [BOX, GENERAL], ids=["forest", "general"])
def test_rigid_rotation_is_not_damped(mesh, device, rng):
    """At any strain."""
    u = strained(mesh, rng)
    stretching = np.abs(forces(mesh, u, (mesh.points + u) @ (SKEW + SKEW.T + np.eye(3)), device)).max()
    turning = np.abs(forces(mesh, u, (mesh.points + u) @ SKEW.T + [1.0, 2.0, 3.0], device)).max()
    assert turning < 2e-5 * stretching


def test_crushed_elements_are_finite_and_lose_energy(device, rng):
    for flat in (0.0, -0.5, 1e-6):
        u = (BOX.points * [1.0, flat, 1.0]) - BOX.points
        v = rng.normal(size=u.shape)
        f = forces(BOX, u, v, device)
        assert np.isfinite(f).all()
        assert np.sum(f * v) < 0.0


def test_its_power_is_bounded_at_any_strain(device, rng):
    """For a rate A the power is at most (2 mu + 3 lambda) |A|^2, also in elements turned inside out, so that explicit
    steps stay stable."""
    x, corners = BOX.points, BOX.tets
    seconds, sides = 0.1, np.moveaxis(x[corners[:, 1:]] - x[corners[:, :1]], 1, 2)
    volumes = np.abs(np.linalg.det(sides)) / 6.0
    mu, lam = 1e5 / 2.6, 1e5 * 0.3 / (1.3 * 0.4)
    for last in (-0.2, -0.45, -0.49, -1.01, -1.5):
        u, v = x * [5.0, 0.5, last] - x, rng.normal(size=x.shape)
        rates = np.moveaxis(v[corners[:, 1:]] - v[corners[:, :1]], 1, 2) @ np.linalg.inv(sides)
        most = seconds * (2.0 * mu + 3.0 * lam) * np.sum(volumes * np.sum(rates**2, axis=(1, 2)))
        assert 0.0 < -np.sum(forces(BOX, u, v, device, seconds) * v) < most


def test_it_is_the_same_with_sums_in_one_order_and_in_all_worlds(device, rng):
    u, v = strained(BOX, rng), rng.normal(size=BOX.points.shape)
    expected = forces(BOX, u, v, device)
    scale = np.abs(expected).max()
    np.testing.assert_allclose(forces(BOX, u, v, device, deterministic=True), expected, rtol=0, atol=1e-6 * scale)
    both = forces(BOX, u, v, device, worlds=2).reshape(2, -1, 3)
    np.testing.assert_allclose(both, [expected, expected], rtol=0, atol=1e-6 * scale)


def test_the_stable_step_is_where_steps_become_unstable():
    """Central differences, damped by the former velocities: roots of z^2 - (2 - dt^2 w^2 - dt c) z + 1 - dt c."""
    w = 40.0
    for viscosity in (0.0, 1e-4, 0.02, 3.0):
        dt = wc.SymplecticEuler(viscosity=viscosity).stable_step(w)
        largest = []
        for step in (0.999 * dt, 1.001 * dt):
            c = viscosity * w**2
            largest.append(np.abs(np.roots([1.0, -(2.0 - step**2 * w**2 - step * c), 1.0 - step * c])).max())
        assert largest[0] <= 1.0 + 1e-12
        assert largest[1] > 1.0 + 1e-6


def test_a_body_follows_the_stable_step(device):
    """Strong damping limits the stable step; a longer step gives a warning and diverges."""
    made = wc.SoftBody(BOX, wc.Isotropic(1e5, 0.3, 1000.0), device=device)
    made.fix(BOX.points[:, 2] == 0.0)
    bare = wc.Simulation(made, gravity=(0.0, 0.0, 0.0)).stable_dt
    sim = wc.Simulation(made, integrator=wc.SymplecticEuler(viscosity=3.0 * bare), gravity=(0.0, -20.0, 0.0))
    assert sim.stable_dt == pytest.approx((10.0**0.5 - 3.0) * bare, rel=1e-6)
    sim.advance(0.5)
    assert sim.energy().kinetic < 0.02
    free = wc.SoftBody(BOX, wc.Isotropic(1e5, 0.3, 1000.0), device=device)
    long = wc.SymplecticEuler(1.2 * sim.stable_dt, viscosity=3.0 * bare)
    with pytest.warns(wc.StabilityWarning, match="beyond the largest stable one"):
        wrong = wc.Simulation(free, integrator=long, gravity=(0.0, 0.0, 0.0))
    free.velocities = 1e-3 * np.random.default_rng(0).normal(size=BOX.points.shape)
    with pytest.raises(wc.UnstableError):
        wrong.advance(3.0)


DECAYS = {
    "viscosity alone": (0.0, 2e-3, wc.SymplecticEuler),
    "both": (1.5, 1e-3, wc.SymplecticEuler),
    "implicit": (1.5, 1e-3, lambda **damped: wc.Newmark(dt=2.5e-3, tolerance=None, **damped)),
}


@pytest.mark.parametrize("case", DECAYS)
def test_the_first_mode_of_a_beam_decays_as_rayleigh_says(case, device):
    """Amplitudes fall at the rate (damping + viscosity w^2) / 2 for an angular frequency w."""
    damping, viscosity, integrator = DECAYS[case]
    mesh = wc.TetForest.box((1, 1, 4), 0.1, 3)
    body = wc.SoftBody(mesh, wc.Isotropic(1e6, 0.3, 1000.0), device=device)
    body.fix(mesh.points[:, 2] == 0.0)
    sim = wc.Simulation(body, integrator=integrator(damping=damping, viscosity=viscosity), gravity=(0.0, 0.0, 0.0))
    kick = np.zeros_like(mesh.points)
    kick[:, 0] = 0.1 * (mesh.points[:, 2] / 0.4) ** 2
    body.velocities = kick
    sim.advance(0.5)  # higher modes decay
    end = int(np.argmax(mesh.points[:, 2]))
    times, tip = [], []
    for _ in range(600):
        sim.advance(0.0025)
        times.append(sim.time)
        tip.append(body.displacements.numpy()[end, 0])
    t, x = np.array(times), np.array(tip, float)
    before = np.flatnonzero(np.diff(np.sign(x)))
    crossings = t[before] - x[before] * np.diff(t)[before] / np.diff(x)[before]
    frequency = np.pi * (len(crossings) - 1) / (crossings[-1] - crossings[0])
    rate = 0.5 * (damping + viscosity * frequency**2)
    # Least squares for the two quadratures in the first and the last cycles.
    amplitudes = []
    for part in (t < t[0] + 4 * np.pi / frequency, t > t[-1] - 4 * np.pi / frequency):
        waves = np.stack([np.cos(frequency * t[part]), np.sin(frequency * t[part])], axis=1)
        envelope = np.exp(-rate * (t[part] - t[part].mean()))
        amplitudes.append((np.linalg.norm(np.linalg.lstsq(waves * envelope[:, None], x[part])[0]), t[part].mean()))
    (first, start), (last, stop) = amplitudes
    assert np.log(first / last) / (stop - start) == pytest.approx(rate, rel=0.02)


@pytest.mark.parametrize("value", [-1.0, np.nan, np.inf])
def test_viscosity_must_be_a_time(value):
    with pytest.raises(wc.InputError, match="viscosity is"):
        wc.SymplecticEuler(viscosity=value)
