"""Prony series: relaxation, creep and loss against closed forms; rotations, stiffness, energy, resumed and remeshed
runs."""

import numpy as np
import oracle
import pytest
import warp as wp
from cases import mixed_forest, random_displacement
from tangents import assert_diagonal, assert_symmetric, on_device, product

import warp_corot as wc
from warp_corot.elasticity.float64 import displacement_gradients, green_strain

MATERIAL = {"young": 500.0, "poisson": 0.3, "density": 10.0}
MU, LAM = oracle.lame(MATERIAL["young"], MATERIAL["poisson"])
G, TAU = (0.5, 1.5), (0.02, 0.3)
LAW = wc.Corotated(dilatation="element")


# Bodies here are put where they are, whatever the step.
pytestmark = pytest.mark.filterwarnings("ignore::warp_corot.StabilityWarning")


class Cube:
    """A cube whose nodes are placed by hand in each step of a given length."""

    def __init__(self, device, dt, model=None, make=None):
        self.mesh = wc.TetForest.box((1, 1, 1), 1.0, 1) if make is None else make()
        self.body = wc.SoftBody(self.mesh, wc.Isotropic(**MATERIAL), device=device)
        model = wc.Prony(G, TAU, LAW) if model is None else model
        integrator = wc.SymplecticEuler(dt=dt)
        self.sim = wc.Simulation(self.body, model=model, integrator=integrator, gravity=(0, 0, 0))
        self.field = self.sim.fields[0]

    def move(self, u):
        self.body.displacements = np.asarray(u, np.float32)
        self.field.complete_step(self.body.state.displacements, self.sim.pace.arrays)

    def shear(self, amount):
        """Apply a shear of this amount in one step."""
        self.move(np.outer(self.mesh.points[:, 1], [amount, 0, 0]))

    @property
    def shear_stress(self):
        top = self.mesh.points[:, 1] > self.mesh.points[:, 1].max() - 1e-9
        return -self.sim.forces().numpy()[top, 0].sum()


@pytest.mark.parametrize("dt", [1e-3, 0.1, 5.0])
def test_relaxation_is_exact_for_steps_of_any_length(dt, device):
    """A shear that grows evenly over one step, and is held."""
    cube, strain = Cube(device, dt), 1e-3
    for step in range(1, 5):
        cube.shear(strain)
        left = [
            g * tau / dt * -np.expm1(-dt / tau) * np.exp(-(step - 1) * dt / tau) for g, tau in zip(G, TAU, strict=True)
        ]
        assert cube.shear_stress == pytest.approx(MU * strain * (1 + sum(left)), rel=2e-5)


def test_loss_angle(device):
    """tan(delta) = sum(g wt / (1 + w^2t^2)) / (1 + sum(g w^2t^2 / (1 + w^2t^2)))."""
    w, steps, strain = 2 * np.pi * 2.0, 60, 1e-3
    cube = Cube(device, 2 * np.pi / w / steps)
    stresses = []
    for step in range(1, 7 * steps + 1):
        cube.shear(strain * np.sin(2 * np.pi * step / steps))
        if step > 6 * steps:
            stresses.append(cube.shear_stress)
    wave = np.fft.fft(stresses)[1] * np.exp(-2j * np.pi / steps) * 2j / steps
    found = np.angle(wave)
    x = w * np.array(TAU)
    storage, loss = 1 + np.sum(np.array(G) * x**2 / (1 + x**2)), np.sum(np.array(G) * x / (1 + x**2))
    assert np.abs(wave) == pytest.approx(MU * strain * np.hypot(storage, loss), rel=2e-3)
    assert np.tan(found) == pytest.approx(loss / storage, rel=5e-3)


def test_creep_of_a_bar(device):
    """A sudden tension s: e(t) = s / (9 K) + s / (3 G) (1 - g / (1 + g) exp(-t / (tau (1 + g))))."""
    mesh = wc.TetForest.box((1, 1, 2), 0.1, 2)
    body = wc.SoftBody(mesh, wc.Isotropic(**MATERIAL), device=device)
    tension, g, tau, dt = 0.5, 1.0, 1.0, 0.04
    loads = np.zeros_like(mesh.points)
    faces = np.sort(mesh.tets[:, [[0, 1, 2], [0, 1, 3], [0, 2, 3], [1, 2, 3]]].reshape(-1, 3), axis=1)
    for end, sign in ((mesh.points[:, 2].min(), -1), (mesh.points[:, 2].max(), 1)):
        own = faces[(np.abs(mesh.points[faces, 2] - end) < 1e-9).all(1)]
        a, b, c = (mesh.points[own[:, k]] for k in range(3))
        area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
        np.add.at(loads[:, 2], own, sign * tension * np.repeat(area[:, None], 3, 1) / 3)
    body.load(np.arange(len(loads)), loads)
    integrator = wc.BackwardEuler(dt=dt, damping=50.0, tolerance=1e-6)
    sim = wc.Simulation(body, model=wc.Prony(g, tau, LAW), integrator=integrator, gravity=(0, 0, 0))
    bulk = LAM + 2 / 3 * MU
    top, bottom = (np.isclose(mesh.points[:, 2], end) for end in (mesh.points[:, 2].max(), mesh.points[:, 2].min()))
    for time in (0.4, 1.2, 4.0):
        sim.advance_until(time)
        u = body.displacements.numpy()[:, 2]
        strain = (u[top].mean() - u[bottom].mean()) / 0.2
        # The load is there from the middle of the first step on.
        left = g / (1 + g) * np.exp(-(time - 0.5 * dt) / (tau * (1 + g)))
        assert strain == pytest.approx(tension / (9 * bulk) + tension / (3 * MU) * (1 - left), rel=5e-3)


def test_history_turns_with_the_body_and_forces_have_a_gradient(device, rng):
    """Also a time after the last known state, as implicit steps ask for."""
    cube = Cube(device, 0.01, make=mixed_forest)
    mesh, field = cube.mesh, cube.field
    for _ in range(3):
        cube.move(random_displacement(mesh, rng, 0.1))
    u = random_displacement(mesh, rng, 0.1)
    turn = oracle.polar(rng.standard_normal((3, 3)))
    cube.body.displacements = u
    straight, energy = cube.sim.forces().numpy(), cube.sim.energy().elastic
    cube.body.displacements = ((mesh.points + u) @ turn.T - mesh.points).astype(np.float32)
    assert np.abs(cube.sim.forces().numpy() - straight @ turn.T).max() < 2e-5 * np.abs(straight).max()
    assert cube.sim.energy().elastic == pytest.approx(energy, rel=1e-5)
    assert np.abs(straight.sum(0)).max() < 1e-5 * np.abs(straight).max()
    field.elapsed.fill_(0.05)
    du, ends, energies = random_displacement(mesh, rng, 2e-3), [], []
    for sign in (1, -1):
        moved = on_device(u + sign * du, field)
        ends.append(field.elastic_forces(moved).numpy()[:, :3])
        energies.append(field.elastic_energy(moved))
    there = field.elastic_forces(on_device(u, field)).numpy()[:, :3]
    assert energies[0] - energies[1] == pytest.approx(-2 * (there.astype(float) * du).sum(), rel=2e-3)
    change = ends[1] - ends[0]
    exact = product(field, u, 2 * du, exact=True)
    assert np.abs(exact - change).max() < 2e-3 * np.abs(change).max()
    assert_symmetric(field, mesh, u, rng, exact=True)
    assert_diagonal(field, u, rng.choice(len(u), 2, replace=False), exact=True)
    field.elapsed.zero_()


@pytest.mark.parametrize("make", [lambda: None, lambda: wc.BackwardEuler(dt=5e-3)])
def test_a_beam_swings_and_loses_energy(make, device, tmp_path):
    """Explicit steps of a chosen length and implicit ones; worlds, resets and checkpoints."""
    mesh = wc.TetForest.box((1, 1, 3), 0.064, 1)
    body = wc.SoftBody(mesh, wc.Isotropic(np.array([[500.0], [900.0]]), 0.3, 10.0), worlds=2, device=device)
    body.fix("z == zmin")
    sim = wc.Simulation(body, model=wc.Prony(2.0, 0.02, LAW), integrator=make())
    start = sim.world_energies().total
    sim.advance(0.3)
    lost = start - sim.world_energies().total
    assert (lost > 0).all()
    sim.save(tmp_path / "swing.npz")
    again = wc.Simulation.load(tmp_path / "swing.npz", device=device)
    assert again.models == sim.models
    for each in (sim, again):
        each.advance(0.02)
    if wp.get_device(device).is_cpu:
        np.testing.assert_array_equal(again.bodies[0].displacements.numpy(), body.displacements.numpy())
    sim.reset(worlds=[1])
    known = sim.fields[0].state["prony"].numpy().reshape(-1, 2, len(mesh.tets))
    assert np.abs(known[:, 0]).max() > 0
    assert not known[:, 1].any()


def test_the_static_answer_is_relaxed(device):
    mesh = wc.TetForest.box((1, 1, 3), 0.064, 1)
    found = []
    for model in (LAW, wc.Prony(3.0, 1.0, LAW)):
        body = wc.SoftBody(mesh, wc.Isotropic(**MATERIAL), device=device)
        body.fix("z == zmin")
        assert wc.solve_static(body, model=model).converged
        found.append(body.displacements.numpy())
    assert np.abs(found[1] - found[0]).max() < 1e-5 * np.abs(found[0]).max()


def test_refuses_numbers_out_of_range():
    for options in ({"g": -1.0}, {"tau": 0.0}, {"g": (1.0, 2.0), "tau": 1.0}, {"model": 3}, {"model": wc.Prony()}):
        with pytest.raises(wc.InputError):
            wc.Prony(**options)


def test_elements_carry_their_history_where_the_mesh_changes(device, tmp_path):
    """While elements are bisected and merged, a swinging beam sinks by an amount between those of a coarse and a fine
    mesh, and a saved run continues exactly."""
    tips = {}
    for name, level, remesh in (
        ("coarse", 3, None),
        ("remeshed", 3, wc.OnlineRemesh(refine_above=1.02, simplify_below=1.01, max_level=6)),
        ("fine", 6, None),
    ):
        body = wc.SoftBody(wc.TetForest.box((1, 1, 3), 0.064, level), wc.Isotropic(**MATERIAL), device=device)
        body.fix("z == zmin")
        sim = wc.Simulation(body, model=wc.Prony(2.0, 0.05, LAW), remesh=remesh)
        sim.advance(0.25)
        tips[name] = body.displacements.numpy()[np.argmax(body.rest_positions[:, 2])].copy()
        if remesh is not None:
            assert body.element_count > 200
            known = sim.fields[0].state["prony"].numpy().reshape(12, -1)[:, : body.element_count]
            f = displacement_gradients(body.mesh.points, body.mesh.tets, body.displacements.numpy())
            strain = green_strain(f)
            strain -= np.trace(strain, axis1=1, axis2=2)[:, None, None] / 3 * np.eye(3)
            assert np.abs(known[3] - strain[:, 0, 1]).max() < 0.02 * np.abs(strain).max()
            sim.save(tmp_path / "remeshed.npz")
            again = wc.Simulation.load(tmp_path / "remeshed.npz", device=device)
            for each in (sim, again):
                each.advance(0.02)
            if wp.get_device(device).is_cpu:
                np.testing.assert_array_equal(again.bodies[0].displacements.numpy(), body.displacements.numpy())
    print(tips)
    # Elements that lost their history would resist as if they had never moved.
    assert tips["coarse"][1] > tips["remeshed"][1] > tips["fine"][1]
