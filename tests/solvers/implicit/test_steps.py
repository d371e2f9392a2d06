"""Implicit steps: orders against exact motions, supports, worlds, states that they keep, and what they refuse."""

from dataclasses import replace

import numpy as np
import oracle
import pytest
import warp as wp
from beams import beam
from cases import oracle_mesh
from scipy.linalg import eigh

import warp_corot as wc

SCHEMES = {
    "backward-euler": (wc.BackwardEuler, 1),
    "newmark": (wc.Newmark, 2),
    "bdf2": (wc.BDF2, 2),
    "generalized-alpha": (wc.GeneralizedAlpha, 2),
}
YOUNG, POISSON, DENSITY = 5e3, 0.44, 1000.0


@pytest.fixture(scope="module")
def slowest():
    """The slowest vibration of the linear beam, float64: its shape [N, 3], and its angular frequency [rad/s]."""
    body = beam()
    mesh, fixed = oracle_mesh(body.mesh), body.mesh.points[:, 2] < 1e-9
    free = np.repeat(~fixed, 3)
    K = oracle.tangent_matrix("linear", mesh, mesh.points, *oracle.lame(YOUNG, POISSON)).toarray()
    M = np.diag(np.repeat(mesh.masses(DENSITY), 3))
    values, vectors = eigh(K[np.ix_(free, free)], M[np.ix_(free, free)], subset_by_index=[0, 0])
    shape = np.zeros(len(free))
    shape[free] = vectors[:, 0] / np.abs(vectors[:, 0]).max()
    return shape.reshape(-1, 3), float(np.sqrt(values[0]))


def swung(integrator, slowest, device, seconds):
    """The displacement along the slowest vibration after some time, starting from the rest shape with a velocity of 1
    m/s."""
    shape, _ = slowest
    body = beam(device)
    body.velocities = shape
    sim = wc.Simulation(body, model=wc.Linear(), integrator=integrator, gravity=(0, 0, 0))
    sim.advance(seconds)
    u, masses = body.displacements.numpy().astype(float), body.masses[:, None]
    return (masses * shape * u).sum() / (masses * shape * shape).sum(), u


@pytest.mark.parametrize("name", SCHEMES)
def test_order_on_a_vibration(name, slowest, device):
    """One quarter of a period in 20 and 40 steps: the error against sin(w t) / w falls by 2 or by 4."""
    scheme, order = SCHEMES[name]
    _, w = slowest
    seconds = 0.5 * np.pi / w
    errors = []
    for steps in (20, 40):
        found, _ = swung(scheme(dt=seconds / steps, tolerance=None, linear_tolerance=1e-6), slowest, device, seconds)
        errors.append(abs(found * w - 1.0))
    print(f"{name}: errors {errors[0]:.2e} and {errors[1]:.2e}, order {np.log2(errors[0] / errors[1]):.2f}")
    assert np.log2(errors[0] / errors[1]) == pytest.approx(order, abs=0.25)
    assert errors[1] < {1: 0.05, 2: 2e-3}[order]


@pytest.mark.parametrize("tolerance", [None, pytest.param(1e-6, marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", SCHEMES)
def test_order_on_a_large_motion(name, tolerance, device):
    """A beam that falls until it bends by half its length: differences between runs with steps halved twice."""
    scheme, order = SCHEMES[name]
    seconds, ends = 0.16, []
    for steps in (16, 32, 64):
        body = beam(device)
        integrator = scheme(dt=seconds / steps, tolerance=tolerance, linear_tolerance=1e-6)
        sim = wc.Simulation(body, integrator=integrator, gravity=(0, -9.8, 0))
        sim.advance(seconds)
        ends.append(body.displacements.numpy().astype(float))
        assert sim.solves.unfinished == 0
        assert sim.solves.steps == steps
    coarse, fine = np.abs(ends[0] - ends[1]).max(), np.abs(ends[1] - ends[2]).max()
    print(f"{name}, {tolerance}: {coarse:.2e} and {fine:.2e} m, order {np.log2(coarse / fine):.2f}")
    assert np.abs(ends[2]).max() > 0.08
    assert np.log2(coarse / fine) > order - 0.35
    explicit = beam(device)
    wc.Simulation(explicit, integrator=wc.SymplecticEuler(dt=1e-4), gravity=(0, -9.8, 0)).advance(seconds)
    assert np.abs(ends[2] - explicit.displacements.numpy()).max() < {1: 0.01, 2: 5e-4}[order]


def test_newmark_keeps_energy_and_backward_euler_loses_it(slowest, device):
    kept = {}
    for name in ("newmark", "backward-euler"):
        body = beam(device)
        body.velocities = slowest[0]
        scheme = SCHEMES[name][0](dt=0.02, tolerance=None, linear_tolerance=1e-6)
        sim = wc.Simulation(body, model=wc.Linear(), integrator=scheme, gravity=(0, 0, 0))
        sim.advance_steps(2)  # the first one is backward Euler's
        before = sim.energy().total
        sim.advance_steps(100)
        kept[name] = sim.energy().total / before
    print(kept)
    assert kept["newmark"] == pytest.approx(1.0, abs=1e-3)
    assert kept["backward-euler"] == pytest.approx((1.0 + (0.02 * slowest[1]) ** 2) ** -100, rel=0.01)


@pytest.mark.parametrize("damping", ["damping", "viscosity"])
@pytest.mark.parametrize("name", SCHEMES)
def test_vibrations_decay_at_the_stated_rate(name, damping, slowest, device):
    """A vibration decays by damping / 2, or by viscosity w^2 / 2, to the order of the scheme."""
    scheme, order = SCHEMES[name]
    shape, w = slowest
    rate = 1.0  # [1/s]
    turning = np.sqrt(w * w - rate * rate)
    seconds, errors = 0.5 * np.pi / turning, []
    for steps in (20, 40):
        body = beam(device)
        body.velocities = 1e-4 * shape
        options = {"damping": 2.0 * rate} if damping == "damping" else {"viscosity": 2.0 * rate / w**2}
        integrator = scheme(dt=seconds / steps, linear_tolerance=1e-6, tolerance=None, **options)
        sim = wc.Simulation(body, model=wc.Linear(), integrator=integrator, gravity=(0, 0, 0))
        sim.advance(seconds)
        u, masses = body.displacements.numpy().astype(float), body.masses[:, None]
        found = (masses * shape * u).sum() / (masses * shape * shape).sum() * turning / 1e-4
        errors.append(abs(found - np.exp(-rate * seconds)))
    print(f"{name}, {damping}: errors {errors[0]:.2e} and {errors[1]:.2e}, order {np.log2(errors[0] / errors[1]):.2f}")
    assert np.log2(errors[0] / errors[1]) == pytest.approx(order, abs=0.25)
    assert errors[1] < {1: 0.05, 2: 4e-3}[order]


@pytest.mark.parametrize("name", ["backward-euler", "bdf2", "generalized-alpha"])
def test_long_steps_end_in_the_static_answer(name, device):
    """Steps of a tenth of a second, a hundred times as long as explicit ones, in which the beam comes to rest."""
    body, rest = beam(device), beam(device)
    sim = wc.Simulation(body, integrator=SCHEMES[name][0](dt=0.1, damping=20.0), gravity=(0, -9.8, 0))
    sim.advance(8.0)
    assert wc.solve_static(rest, gravity=(0, -9.8, 0)).converged
    expected = rest.displacements.numpy()
    assert np.abs(body.displacements.numpy() - expected).max() < 1e-5
    weight = body.masses.sum() * 9.8
    assert body.reactions.numpy().sum(0) == pytest.approx([0, weight, 0], abs=2e-3 * weight)
    assert np.abs(rest.reactions.numpy() - body.reactions.numpy()).max() < 2e-3 * weight


@pytest.mark.parametrize("name", SCHEMES)
def test_prescribed_nodes_follow_their_keyframes(name, device):
    """Exactly, with the rest of the body behind them; the work of the supports is what the body has gained."""
    body = beam(device)
    end = np.flatnonzero(body.mesh.points[:, 2] > 0.19)
    body.prescribe(end, times=[0.0, 0.2], displacements=[[0, 0, 0], [0.0, 0.03, 0.05]])
    sim = wc.Simulation(body, integrator=SCHEMES[name][0](dt=0.01), gravity=(0, 0, 0))
    sim.advance(0.1)
    u = body.displacements.numpy()
    assert np.abs(u[end] - [0.0, 0.015, 0.025]).max() < 1e-6
    assert not u[body.mesh.points[:, 2] < 1e-9].any()
    inside = (body.mesh.points[:, 2] > 0.03) & (body.mesh.points[:, 2] < 0.19)
    assert (u[inside, 2] > 0.0).all()
    sim.advance(0.3)
    assert np.abs(body.displacements.numpy()[end] - [0.0, 0.03, 0.05]).max() < 1e-6
    assert np.abs(body.velocities.numpy()[end]).max() < 1e-5


@pytest.mark.parametrize("moves", [False, True], ids=["held", "moving"])
def test_reactions_and_the_work_of_supports_do_not_depend_on_how_a_run_is_divided(moves, device):
    """In long runs reactions may be found at the end only, where no held node moves. After 19 steps the nodes that
    followed keyframes stand still."""
    found = []
    for parts in ([27], [1] * 27):
        body = beam(device)
        if moves:
            end = np.flatnonzero(body.mesh.points[:, 2] > 0.19)
            moved = np.zeros((3, len(end), 3))
            moved[1:, :, 1] = 0.01
            body.prescribe(end, times=[0.0, 0.1, 0.19], displacements=moved)
        sim = wc.Simulation(body, integrator=wc.BackwardEuler(dt=0.01), gravity=(0.0, -9.81, 0.0))
        for steps in parts:
            sim.advance_steps(steps)
        found.append((body.reactions.numpy(), sim.system.support_work.numpy(), body.displacements.numpy()))
    for whole, single in zip(*found, strict=True):
        # On CUDA sums come in any order.
        np.testing.assert_allclose(whole, single, rtol=0, atol=1e-4 * np.abs(single).max())
    assert (found[0][1][1] > 0.0) == moves


def test_a_free_body_falls_freely(device):
    """Newmark's steps are exact for a constant acceleration, but for the first one; nothing is strained."""
    mesh = wc.TetForest.box((1, 1, 1), 0.064, 3)
    body = wc.SoftBody(mesh, wc.Isotropic(YOUNG, POISSON, DENSITY), device=device)
    sim = wc.Simulation(body, integrator=wc.Newmark(dt=0.02, tolerance=None), gravity=(0, -9.8, 0))
    sim.advance(0.4)
    fall = body.displacements.numpy()
    assert np.ptp(fall[:, 1]) < 1e-5
    assert fall[:, 1].mean() == pytest.approx(-0.5 * 9.8 * 0.4**2, abs=9.8 * 0.02**2)
    assert body.velocities.numpy()[:, 1].mean() == pytest.approx(-9.8 * 0.4, rel=1e-5)


@pytest.mark.parametrize("name", ["backward-euler", "generalized-alpha"])
def test_worlds_step_by_themselves_and_are_reset(name, device):
    integrator = SCHEMES[name][0](dt=0.01)
    body, alone = beam(device, worlds=2), beam(device)
    both, one = (wc.Simulation(each, integrator=integrator, gravity=(0, -9.8, 0)) for each in (body, alone))
    body.load(np.arange(len(alone.mesh.points)), [[[0.0, 0.0, 0.0]], [[0.002, 0.0, 0.0]]])
    for sim in (both, one):
        sim.advance_steps(10)
    u = body.displacements.numpy().reshape(2, -1, 3)
    assert np.abs(u[0] - alone.displacements.numpy()).max() < 1e-5
    assert np.abs(u[1] - u[0]).max() > 1e-3
    both.reset(1)
    again = body.displacements.numpy().reshape(2, -1, 3)
    assert np.array_equal(again[0], u[0])
    assert not again[1].any()
    both.advance_steps(1)
    assert np.isfinite(body.displacements.numpy()).all()


@pytest.mark.parametrize("name", SCHEMES)
def test_a_resumed_run_is_the_uninterrupted_one(name, device, tmp_path):
    body = beam(device)
    sim = wc.Simulation(body, integrator=SCHEMES[name][0](dt=0.01), gravity=(0, -9.8, 0))
    sim.advance_steps(5)
    sim.save(tmp_path / "state.npz")
    sim.advance_steps(5)
    later = wc.Simulation.load(tmp_path / "state.npz")
    assert later.integrator == sim.integrator
    later.advance_steps(5)
    error = np.abs(later.body.displacements.numpy() - body.displacements.numpy()).max()
    assert error <= (0.0 if body.device.is_cpu else 1e-6)


def test_a_body_thrown_flat_recovers(device):
    """Pressed into a plane, with steps of 20 ms: finite all the way, and at rest where it hangs in the end."""
    body = beam(device)
    u = body.mesh.points * [0.0, 0.0, -1.0]
    u[body.mesh.points[:, 2] < 1e-9] = 0.0
    body.displacements = u
    sim = wc.Simulation(body, integrator=wc.BackwardEuler(dt=0.02, damping=5.0), gravity=(0, 0, 0))
    sim.advance(6.0)
    assert np.isfinite(body.displacements.numpy()).all()
    assert np.abs(body.displacements.numpy()).max() < 2e-4


def test_a_state_that_is_not_finite_is_undone(device):
    body = beam(device)
    sim = wc.Simulation(body, integrator=wc.BackwardEuler(dt=0.01), gravity=(0, 0, 0))
    sim.advance_steps(3)
    before = body.displacements.numpy()
    body.load([len(body.mesh.points) - 1], [3e38, 3e38, 0.0])
    with pytest.raises(wc.UnstableError, match="the state is that of t = "):
        sim.advance_steps(3)
    assert np.array_equal(body.displacements.numpy(), before)


@pytest.mark.parametrize("near", [None, wc.Ground(normal=(0, 0, 1), offset=-0.01)])
def test_a_thin_sheet_that_is_pulled_keeps_its_volume(near, device):
    """Its tension, which R K R^T lacks, is what keeps it straight, also where it may touch something."""
    domain = wc.Domain.box((0.0, 0.0, 0.0), (0.1, 0.1, 0.003), device="cpu")
    mesh = wc.TetForest.from_domain(domain, target_elements=1000)
    body = wc.SoftBody(mesh, wc.Isotropic(6e4, 0.49, 1000.0), device=device)
    x = mesh.points
    pulled = np.flatnonzero(x[:, 0] > 0.088)
    body.fix(x[:, 0] < 0.012)
    body.prescribe(pulled, times=[0.0, 0.3, 1.0], displacements=[(0, 0, 0), (0.05, 0, 0), (0.05, 0, 0)])
    obstacles = [] if near is None else [near]
    sim = wc.Simulation(body, integrator=wc.BackwardEuler(1.0 / 60.0), gravity=(0, 0, 0), obstacles=obstacles)
    surface = mesh.surface()
    for _ in range(10):
        sim.advance(0.05)
        moved = surface.moved(body.displacements.numpy())
        assert replace(surface, points=moved).volume == pytest.approx(surface.volume, rel=0.03)
    still = sim.energy()
    assert still.kinetic < 1e-3 * still.elastic


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"dt": None}, "dt is None"),
        ({"dt": 0.0}, "dt is 0.0"),
        ({"damping": -1.0}, "damping is -1.0"),
        ({"viscosity": np.inf}, "viscosity is inf"),
        ({"tolerance": 2.0}, "tolerance is 2.0"),
        ({"linear_tolerance": None}, "linear_tolerance"),
        ({"iterations": 0}, "iterations"),
        ({"preconditioner": "ilu"}, "preconditioner is 'ilu'"),
    ],
)
def test_invalid_options_are_refused(options, says):
    with pytest.raises(wc.InputError, match=says):
        wc.BackwardEuler(**options)


def test_options_of_single_schemes():
    with pytest.raises(wc.InputError, match=r"spectral_radius is 1\.5"):
        wc.GeneralizedAlpha(spectral_radius=1.5)
    with pytest.raises(wc.InputError, match=r"beta is 0\.1"):
        wc.Newmark(beta=0.1)
    with pytest.raises(wc.InputError, match=r"gamma is 0\.2"):
        wc.Newmark(gamma=0.2)


def test_quasi_static_steps_are_static_answers(device):
    """Where keyframes have pulled the end of the beam, ``solve_static`` finds the same state with the end held
    there."""
    body, rest = beam(device), beam(device)
    end = np.flatnonzero(body.mesh.points[:, 2] > 0.19)
    body.prescribe(end, times=[0.0, 1.0], displacements=[[0, 0, 0], [0.0, 0.04, 0.02]])
    sim = wc.Simulation(body, integrator=wc.QuasiStatic(dt=0.25), gravity=(0, -9.8, 0))
    sim.advance(1.0)
    assert sim.solves.unfinished == 0
    u = np.zeros_like(rest.mesh.points)
    u[end] = [0.0, 0.04, 0.02]
    rest.displacements = u
    rest.fix(end)
    assert wc.solve_static(rest, gravity=(0, -9.8, 0)).converged
    assert np.abs(body.displacements.numpy() - rest.displacements.numpy()).max() < 1e-6
    free = wc.SoftBody(body.mesh, wc.Isotropic(YOUNG, POISSON, DENSITY), device=device)
    with pytest.raises(wc.InputError, match="no node of the body is held"):
        wc.Simulation(free, integrator=wc.QuasiStatic(dt=0.25))


class Springs:
    """Springs [N/m] from nodes to their rest positions; their energy counts in the balance."""

    def __init__(self, body, nodes, stiffness):
        self.body, self.stiffness = body, stiffness
        at_nodes = np.zeros(body.node_count, np.float32)
        at_nodes[nodes] = stiffness
        self._of_nodes = wp.array(at_nodes, dtype=wp.float32, device=body.device)

    def add_forces(self):
        self._add(self.body.state.displacements, self.body.state.forces, -1.0)

    def add_stiffness(self, body, p, y):
        self._add(p, y, 1.0)

    def add_diagonal(self, body, blocks):
        wp.launch(add_spring_blocks, body.node_count, [self._of_nodes], [blocks], device=body.device)

    def _add(self, u, f, sign):
        wp.launch(add_springs, self.body.node_count, [self._of_nodes, sign, u], [f], device=self.body.device)


@wp.kernel(enable_backward=False)
def add_springs(stiffness: wp.array[wp.float32], sign: float, u: wp.array[wp.vec4], f: wp.array[wp.vec4]):
    i = wp.tid()
    f[i] = f[i] + sign * stiffness[i] * u[i]


@wp.kernel(enable_backward=False)
def add_spring_blocks(stiffness: wp.array[wp.float32], blocks: wp.array[wp.mat33]):
    i = wp.tid()
    blocks[i] = blocks[i] + stiffness[i] * wp.identity(3, dtype=wp.float32)


@pytest.mark.parametrize("preconditioner", [None, "diagonal"])
@pytest.mark.parametrize(
    "integrator", [wc.BackwardEuler(dt=0.1, damping=10.0), wc.BDF2(dt=0.1, damping=10.0), wc.QuasiStatic(dt=1.0)]
)
def test_stiff_springs_are_in_the_tangent(integrator, preconditioner, device):
    """Springs far stiffer than the body, with which steps of this length would explode if their stiffness were left
    out: the held end comes to rest where its springs carry what a support there would carry."""
    integrator = replace(integrator, preconditioner=preconditioner)
    body, held = beam(device), beam(device)
    end = np.flatnonzero(body.mesh.points[:, 2] > 0.19)
    sim = wc.Simulation(body, integrator=integrator, gravity=(0, -9.8, 0))
    sim.add_forces(Springs(body, end, 1e5))
    sim.advance(4.0)
    held.fix(end)
    assert wc.solve_static(held, gravity=(0, -9.8, 0)).converged
    u = body.displacements.numpy().astype(float)
    assert np.abs(u - held.displacements.numpy()).max() < 1e-4
    carried = held.reactions.numpy()[end].astype(float)
    assert (-1e5 * u[end]).sum(0) == pytest.approx(carried.sum(0), abs=0.02 * np.abs(carried).sum())
