"""Gradients of runs of steps against differences of the same steps in float64."""

import numpy as np
import oracle
import pytest
from cases import CUBE, MODELS
from scipy.sparse import diags
from scipy.sparse.linalg import spsolve

import warp_corot as wc

GRAVITY = np.array([0.0, -9.8, 0.0])
DAMPING = 3.0
NAMES = ("young", "density", "loads", "gravity", "rest", "displacements", "velocities")
SIZES = {"displacements": 1e-2 * CUBE, "velocities": 0.05, "rest": 1e-2 * CUBE, "loads": 1e-4}
#: Of a derivative along a random direction, over the larger of it and its entries' sizes.
TOLERANCE = 1e-4


class Run:
    """A bar that begins strained and in motion, with one end held and two of its nodes moving on."""

    def __init__(self, device, law="corotated", level=2):
        self.mesh = wc.TetForest.box((1, 1, 2), CUBE, level)
        self.law, self.rng = law, np.random.default_rng(4)
        nodes = len(self.mesh.points)
        self.held = self.mesh.points[:, 2] < 1e-9
        self.given = {
            "young": 500.0 * self.rng.uniform(0.5, 2.0, len(self.mesh.tets)),
            "density": 10.0,
            "loads": 1e-4 * self.rng.standard_normal((nodes, 3)),
            "gravity": GRAVITY,
            "rest": np.asarray(self.mesh.points),
            "displacements": 0.03 * CUBE * self.rng.standard_normal((nodes, 3)),
            "velocities": 0.1 * self.rng.standard_normal((nodes, 3)),
        }
        self.given["velocities"][self.held] *= np.arange(self.held.sum())[:, None] < 2
        self.weights = self.rng.standard_normal((nodes, 3))
        self.body = wc.SoftBody(self.mesh, wc.Isotropic(self.given["young"], 0.3, 10.0), device=device)
        self.body.fix(self.held)
        self.body.load(np.arange(nodes), self.given["loads"])
        self.begin()

    def begin(self):
        self.body.displacements = self.given["displacements"]
        self.body.state.set_velocities(self.given["velocities"])

    def gradient(self, integrator, steps, **options):
        def objective(x):
            return float((self.weights * x.numpy()).sum()), self.weights

        options = {"wrt": NAMES, "model": MODELS[self.law](), "gravity": GRAVITY} | options
        return wc.run_gradient(self.body, objective, integrator=integrator, steps=steps, **options)

    def value(self, integrator, steps, every=None, **changed):
        """J in float64, with some of the arguments changed."""
        given = self.given | changed
        mesh, lame = oracle.Mesh(given["rest"], self.mesh.tets), oracle.lame(given["young"], 0.3)
        masses = mesh.masses(given["density"])[:, None]
        outer = given["loads"] + masses * given["gravity"]
        if isinstance(integrator, wc.SymplecticEuler):
            states = self.explicit(mesh, lame, masses, outer, integrator, steps, given)
        else:
            states = self.implicit(mesh, lame, masses, outer, integrator, steps, given)
        chosen = [states[-1]] if every is None else states[every - 1 :: every]
        return float(sum(np.sum(self.weights * x) for x in chosen))

    def explicit(self, mesh, lame, masses, outer, integrator, steps, given):
        x, v, states = given["rest"] + given["displacements"], given["velocities"], []
        for _ in range(steps):
            force = oracle.evaluate(self.law, mesh, x, *lame)[1] + outer
            after = (v + integrator.dt * force / masses) / (1.0 + integrator.dt * integrator.damping)
            v = np.where(self.held[:, None], v, after)
            x = x + integrator.dt * v
            states.append(x)
        return states

    def implicit(self, mesh, lame, masses, outer, integrator, steps, given):
        """Steps by the integrator's table: increments d by Newton's method."""
        x, v, states = given["rest"] + given["displacements"], given["velocities"], []
        first, second, held = np.zeros_like(v), np.zeros_like(v), self.held[:, None]
        free = np.flatnonzero(np.repeat(~self.held, 3))
        for step in range(steps):
            rows = (integrator.scheme if step else integrator.start)(integrator.dt)
            inertia, share = rows[0] + integrator.damping * rows[1], rows[5, 0]
            d = share * integrator.dt * v
            for _ in range(20):
                force = oracle.evaluate(self.law, mesh, x + d, *lame)[1] + outer
                pull = inertia[0] * d + inertia[1] * v + inertia[2] * first + inertia[3] * second
                left = (force - masses * pull).ravel()[free]
                matrix = oracle.tangent_matrix(self.law, mesh, x + d, *lame)
                matrix = matrix + diags(np.repeat(inertia[0] * masses.ravel(), 3))
                change = np.zeros(d.size)
                change[free] = spsolve(matrix.tocsr()[free][:, free].tocsc(), left)
                d = d + change.reshape(d.shape)
                if np.abs(change).max() < 1e-13 * CUBE:
                    break
            made = [row[0] * d + row[1] * v + row[2] * first + row[3] * second for row in rows[2:5]]
            v = np.where(held, v, made[0])
            first, second = made[1], made[2]
            x = x + d / share
            states.append(x)
        return states

    def check(self, found, integrator, steps, every=None):
        assert found.value == pytest.approx(self.value(integrator, steps, every), abs=1e-5)
        for name in NAMES:
            way = self.rng.standard_normal(np.shape(self.given[name])) * SIZES.get(name, np.abs(self.given[name]))
            if name == "gravity":
                way = self.rng.standard_normal(3)
            near, far = (
                self.value(integrator, steps, every, **{name: self.given[name] + k * 1e-3 * way})
                - self.value(integrator, steps, every, **{name: self.given[name] - k * 1e-3 * way})
                for k in (1, 2)
            )
            along, right = float(np.sum(found[name] * way)), (8.0 * near - far) / 12e-3
            error = abs(along - right) / max(abs(right), np.linalg.norm(found[name] * way))
            print(f"{name}: {along:.8g} against {right:.8g}, off by {error:.1e}")
            assert error < TOLERANCE


@pytest.mark.parametrize("every", [None, 7])
def test_explicit_steps(every, device):
    """30 steps in segments, with an objective at the end, or as a sum over times that cut the segments."""
    run, integrator = Run(device), wc.SymplecticEuler(dt=2e-3, damping=DAMPING)
    found = run.gradient(integrator, 30, every=every)
    run.check(found, integrator, 30, every)
    assert found.kept <= 20


def test_explicit_steps_are_those_of_a_simulation(device):
    run, integrator = Run(device), wc.SymplecticEuler(dt=2e-3, damping=DAMPING)
    run.gradient(integrator, 30, wrt="young")
    found = run.body.positions.numpy()
    run.begin()
    wc.Simulation(run.body, model=MODELS["corotated"](), integrator=integrator, gravity=GRAVITY).advance_steps(30)
    assert found == pytest.approx(run.body.positions.numpy(), abs=1e-6 * CUBE)


@pytest.mark.parametrize(
    "make",
    [
        pytest.param(wc.BackwardEuler, marks=pytest.mark.slow),
        pytest.param(wc.Newmark, marks=pytest.mark.slow),
        wc.GeneralizedAlpha,
        pytest.param(wc.BDF2, marks=pytest.mark.slow),
    ],
)
def test_implicit_steps(make, device):
    run, integrator = Run(device), make(dt=0.02, damping=DAMPING, tolerance=1e-6)
    found = run.gradient(integrator, 6, every=2)
    run.check(found, integrator, 6, 2)
    assert found.kept == 7


@pytest.mark.slow
def test_a_long_run(device):
    """1,000 steps of 1,152 elements in 66 states; differences of float32 runs leave 1e-3."""
    mesh = wc.TetForest.box((1, 1, 3), CUBE, 6)
    tip = mesh.points[:, 2] > 3 * CUBE - 1e-9

    def run(young):
        body = wc.SoftBody(mesh, wc.Isotropic(young, 0.4, 1000.0), device=device)
        body.fix(mesh.points[:, 2] < 1e-9)
        weights = np.zeros_like(mesh.points)
        weights[tip, 1] = 1.0 / tip.sum()
        return wc.run_gradient(
            body,
            lambda x: (float((weights * x.numpy()).sum()), weights),
            integrator=wc.SymplecticEuler(dt=2e-4, damping=10.0),
            steps=1000,
            gravity=GRAVITY,
        )

    found = run(50e3)
    difference = (run(50.5e3).value - run(49.5e3).value) / 1e3
    print(f"{found.young:.6g} against {difference:.6g}, {found.kept} states")
    assert found.kept < 70
    assert found.young == pytest.approx(difference, rel=2e-3)


def test_refusals(device):
    run = Run(device)
    for integrator, options, message in (
        (wc.SymplecticEuler(), {}, "dt of SymplecticEuler is None"),
        (wc.SymplecticEuler(1e-3, viscosity=1e-3), {}, "viscosity is 0.001"),
        (wc.BackwardEuler(0.01), {}, "tolerance of the integrator is None"),
        (wc.QuasiStatic(0.01), {}, "it must be SymplecticEuler or an implicit one with inertia"),
        (wc.SymplecticEuler(1e-3), {"model": wc.Prony(), "wrt": "loads"}, "forces of Prony depend on what happened"),
        (wc.SymplecticEuler(1e-3), {"wrt": "boundary"}, "wrt has 'boundary'"),
        (wc.SymplecticEuler(1e-3), {"every": 40}, "every is 40; the run has 30 steps"),
    ):
        with pytest.raises(wc.InputError, match=message):
            run.gradient(integrator, 30, **options)
    with pytest.raises(wc.UnstableError, match="take shorter steps"):
        run.gradient(wc.SymplecticEuler(0.5), 60)
    run.body.prescribe(run.held, times=[0.0, 1.0], displacements=np.zeros((2, run.held.sum(), 3)))
    with pytest.raises(wc.InputError, match="follow keyframes"):
        run.gradient(wc.SymplecticEuler(1e-3), 30)
