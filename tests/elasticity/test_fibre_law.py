"""The law of Holzapfel, Gasser and Ogden: the float64 formula, closed forms, and everything that carries materials."""

import numpy as np
import oracle
import pytest
from cases import jittered, mixed_forest, oracle_mesh, random_displacement
from fibres import random_axes
from tangents import assert_diagonal, assert_equal, assert_symmetric, difference, product

import warp_corot as wc

MATRIX = {"young": 500.0, "poisson": 0.4, "density": 10.0}
MU, LAM = oracle.lame(MATRIX["young"], MATRIX["poisson"])
MODEL = wc.HolzapfelGasserOgden(dilatation="element")


def tissue(axes, **changed):
    fibres = {"k1": 300.0, "k2": 2.0, "kappa": 0.1, "angle": 0.6}
    return wc.FibreReinforced(**(MATRIX | fibres | changed), direction=axes[..., 0, :], across=axes[..., 1, :])


def plain(F, material):
    """Energy density and P of each element, without any continuation."""
    psi, P = oracle.neo_hookean(F, MU, LAM)
    C = np.swapaxes(F, 1, 2) @ F
    k1, k2, kappa, angle = (np.broadcast_to(getattr(material, name), len(F)) for name in ("k1", "k2", "kappa", "angle"))
    axes = np.broadcast_to(material.frames(), F.shape)
    for sign in (1, -1):
        a = np.cos(angle)[:, None] * axes[..., 0] + sign * np.sin(angle)[:, None] * axes[..., 1]
        B = kappa[:, None, None] * np.eye(3) + (1 - 3 * kappa)[:, None, None] * np.einsum("ti,tj->tij", a, a)
        e = np.maximum(np.einsum("tij,tij->t", B, C - np.eye(3)), 0.0)
        psi = psi + k1 / (2 * k2) * np.expm1(k2 * e**2)
        P = P + (2 * k1 * e * np.exp(k2 * e**2))[:, None, None] * (F @ B)
    return psi, P


def of_mesh(mesh, x, material):
    reference = oracle_mesh(mesh)
    return oracle.continuum(lambda F, _mu, _lam: plain(F, material), reference, x, MU, LAM)


@pytest.mark.parametrize("make", [mixed_forest, pytest.param(jittered, marks=pytest.mark.slow)])
def test_forces_and_stiffness_equal_the_float64_formula(make, device, rng):
    """Directions, k1, dispersion and angle of each element; some families are slack."""
    mesh = make()
    count = len(mesh.tets)
    material = tissue(
        random_axes(rng, count),
        k1=rng.uniform(100, 400, count),
        kappa=rng.uniform(0, 0.3, count),
        angle=rng.uniform(0.2, 1, count),
    )
    turn = oracle.polar(rng.standard_normal((3, 3)))
    u = random_displacement(mesh, rng, 0.08)
    u = ((mesh.points + u) @ turn.T - mesh.points).astype(np.float32)
    x, p = mesh.points + u.astype(float), random_displacement(mesh, rng, 1.0)
    body = wc.SoftBody(mesh, material, device=device)
    sim = wc.Simulation(body, model=MODEL, gravity=(0, 0, 0))
    body.displacements = u
    energies, forces = of_mesh(mesh, x, material)
    assert_equal(sim.forces().numpy(), forces)
    assert sim.energy().elastic == pytest.approx(energies.sum(), rel=1e-5)
    F = oracle_mesh(mesh).deformation_gradients(x)
    s = plain(F, material)[1] @ np.swapaxes(F, 1, 2) / np.linalg.det(F)[:, None, None]
    s = s - np.trace(s, axis1=1, axis2=2)[:, None, None] / 3 * np.eye(3)
    assert_equal(sim.von_mises(), np.sqrt(1.5 * (s * s).sum((1, 2))))
    field = sim.fields[0]
    # Stiffness jumps where families become slack, which differences do not survive: here all bear.
    u = 0.25 * mesh.points + random_displacement(mesh, rng, 0.03)
    u = ((mesh.points + u) @ turn.T - mesh.points).astype(np.float32)
    expected = difference(lambda x: of_mesh(mesh, x, material)[1], mesh.points + u.astype(float), p)
    assert_equal(product(field, u, p), expected)
    assert_symmetric(field, mesh, u, rng)
    assert_diagonal(field, u, rng.choice(len(u), 2, replace=False))


def nominal(F, material, device):
    """The first Piola stress of a cube [Pa]."""
    mesh = wc.TetForest.box((1, 1, 1), 1.0, 0)
    body = wc.SoftBody(mesh, material, device=device)
    sim = wc.Simulation(body, model=MODEL, gravity=(0, 0, 0))
    body.displacements = mesh.points @ (np.asarray(F, float) - np.eye(3)).T
    f = sim.forces().numpy()
    return -np.array([[f[mesh.points[:, j] > 0.5].sum(0)[i] for j in range(3)] for i in range(3)])


def test_closed_forms(device):
    """The deformations are isochoric, and the stress of the lateral faces is subtracted as a pressure: along fibres, in
    the plane of two families at right angles, in shear, and in compression, where fibres bear nothing."""
    k1, k2 = 300.0, 2.0

    def pull(e, stretch):
        return 2 * k1 * stretch * e * np.exp(k2 * e**2)

    one = tissue(np.eye(3), kappa=0.0, angle=0.0)
    for stretch in (1.3, 0.8):
        across = stretch**-0.5
        P = nominal(np.diag([stretch, across, across]), one, device)
        expected = MU * (stretch - stretch**-2) + pull(max(stretch**2 - 1, 0), stretch)
        assert P[0, 0] - P[1, 1] * across / stretch == pytest.approx(expected, rel=1e-4)
    stretch = 1.2
    P = nominal(np.diag([stretch, stretch, stretch**-2]), tissue(np.eye(3), kappa=0.0, angle=np.pi / 4), device)
    expected = MU * (stretch - stretch**-5) + pull(stretch**2 - 1, stretch)
    assert P[0, 0] - P[2, 2] * stretch**-3 == pytest.approx(expected, rel=1e-4)
    shear = 0.5
    upright = tissue(np.eye(3)[[1, 0, 2]], kappa=0.0, angle=0.0)
    P = nominal([[1, shear, 0], [0, 1, 0], [0, 0, 1]], upright, device)
    assert P[0, 1] == pytest.approx(MU * shear + pull(shear**2, shear), rel=1e-4)
    # Full dispersion is a function of tr C alone.
    P = nominal(np.diag([stretch, stretch**-0.5, stretch**-0.5]), tissue(np.eye(3), kappa=1 / 3, angle=0.0), device)
    e = (stretch**2 + 2 / stretch - 3) / 3
    expected = (MU + 2 * k1 * e * np.exp(k2 * e**2) / 3) * (stretch - stretch**-2)
    assert P[0, 0] - P[1, 1] * stretch**-1.5 == pytest.approx(expected, rel=1e-4)


def test_force_is_the_gradient_where_elements_are_turned_over(device, rng):
    mesh = mixed_forest()
    body = wc.SoftBody(mesh, tissue(np.eye(3)), device=device)
    sim = wc.Simulation(body, model=MODEL, gravity=(0, 0, 0))
    u, du = random_displacement(mesh, rng, 0.9), random_displacement(mesh, rng, 2e-3)
    energies, work = [], []
    for step in (-1, 0, 1):
        body.displacements = u + step * du
        energies.append(sim.energy().elastic)
        work.append(-(sim.forces().numpy().astype(float) * du).sum())
    assert energies[2] - energies[0] == pytest.approx((work[0] + 4 * work[1] + work[2]) / 3, rel=2e-3)


def test_a_beam_swings_while_it_is_remeshed(device, tmp_path):
    """Fields of k1, directions that are a function, active stress, a checkpoint, and a stable step."""
    mesh = wc.TetForest.box((1, 1, 3), 0.064, 3)
    around = wc.FibreReinforced(
        **MATRIX,
        k1=lambda x: 200.0 + 1e3 * x[:, 2],
        k2=2.0,
        direction=lambda x: np.column_stack([-x[:, 1] - 1, x[:, 0] + 1, np.zeros(len(x))]),
        kappa=0.05,
        angle=0.5,
        across=(0.0, 0.0, 1.0),
    )
    body = wc.SoftBody(mesh, around, device=device)
    body.fix("z == zmin")
    body.activate(wc.Activation([0.0, 0.1], [0.0, 20.0]))
    remesh = wc.OnlineRemesh(refine_above=1.03, simplify_below=1.01)
    sim = wc.Simulation(body, model=MODEL, integrator=wc.SymplecticEuler(damping=2.0), remesh=remesh)
    sim.advance(0.2)
    assert body.element_count > len(mesh.tets)
    k1 = body.material.k1
    assert np.abs(k1 - 200.0 - 1e3 * body.mesh.points[body.mesh.tets].mean(1)[:, 2]).max() < 70
    sim.save(tmp_path / "beam.npz")
    again = wc.Simulation.load(tmp_path / "beam.npz")
    for each in (sim, again):
        each.advance(0.01)
    # On CUDA sums come in any order.
    moved = body.displacements.numpy()
    off = 0.0 if body.device.is_cpu else 1e-4 * np.abs(moved).max()
    np.testing.assert_allclose(again.bodies[0].displacements.numpy(), moved, rtol=0, atol=off)


def test_worlds_share_their_dilatation(device):
    mesh = wc.TetForest.box((1, 1, 2), 0.064, 3)
    material = tissue(np.eye(3)[[2, 0, 1]], poisson=0.49, k1=np.array([[300.0], [3e4]]))
    body = wc.SoftBody(mesh, material, worlds=2, device=device)
    body.fix("z == zmin")
    sim = wc.Simulation(body, model=wc.HolzapfelGasserOgden(), gravity=(0, 0, 9.81))
    assert sim.fields[0].shares_dilatation
    sim.advance(0.02)
    u = body.displacements.numpy().reshape(2, -1, 3)[..., 2].max(1)
    assert u[0] > 1.02 * u[1] > 0


def test_invalid_arguments_are_refused(device):
    mesh = wc.TetForest.box((1, 1, 1), 0.064, 0)
    body = wc.SoftBody(mesh, tissue(np.eye(3)), device=device)
    for model in (wc.Corotated(), wc.NeoHookean(dilatation="element")):
        with pytest.raises(wc.InputError, match="HolzapfelGasserOgden"):
            model.bind(body)
    with pytest.raises(wc.InputError, match="must be FibreReinforced"):
        MODEL.bind(wc.SoftBody(mesh, wc.Isotropic(**MATRIX), device=device))
    for changed in ({"kappa": 0.4}, {"k2": 0.0}, {"angle": 2.0}):
        with pytest.raises(wc.InputError, match=next(iter(changed))):
            tissue(np.eye(3), **changed)
    with pytest.raises(wc.InputError, match="across"):
        wc.FibreReinforced(**MATRIX, k1=1.0, k2=1.0, direction=(1, 0, 0), angle=0.5)
    with pytest.raises(wc.InputError, match="right angles"):
        tissue(np.array([[1, 0, 0], [1, 1, 0], [0, 0, 1.0]]))


@pytest.mark.parametrize("poisson", [0.4, 0.49], ids=["own dilatation", "shared"])
def test_active_fibres_shorten_a_beam_at_rest(poisson, device):
    """Forces balance there, because the energy of Newton's line search includes the active stress."""
    mesh = wc.TetForest.box((1, 1, 2), 0.064, 2)
    fibres = wc.FibreReinforced(3e3, poisson, 200.0, 1.0, [0.0, 0.0, 1.0], 1000.0)
    body = wc.SoftBody(mesh, fibres, device=device)
    body.fix("z == zmin")
    body.activate(300.0)
    report = wc.solve_static(body, model=wc.HolzapfelGasserOgden(), gravity=(0, 0, 0))
    assert report.converged, report.message
    end = mesh.points[:, 2] > mesh.points[:, 2].max() - 1e-9
    assert body.displacements.numpy()[end, 2].max() < -0.001
    assert np.abs(body.displacements.numpy()[end, 2]).max() < 0.03
