"""Runs that are reproducible bit for bit, and equal on every device to rounding.

On the CPU every run is reproducible; on CUDA runs of ``Simulation(deterministic=True)`` are. Meshes are large enough
there for threads to reach nodes in a different order every time.
"""

from functools import cache

import numpy as np
import oracle
import pytest
import warp as wp
from cases import CUBE, jittered, oracle_mesh, random_displacement

import warp_corot as wc
from warp_corot.discretization.planner import ForcePlan

YOUNG, POISSON, DENSITY, DAMPING = 2e3, 0.4, 500.0, 15.0
GRAVITY = (0.3, -9.8, 0.1)


@cache
def adaptive(level=6, cuts=(1.0, 1.5)):
    """Three levels side by side: groups of subtrees (from level 6 on), single subtrees and single leaves."""
    forest = wc.TetForest.box((2, 1, 1), CUBE, level)
    for cut in cuts:
        forest = forest.refine(forest.points[forest.tets, 0].mean(axis=1) > cut * CUBE)
    plan = ForcePlan.of_forest(forest, None, wp.get_device("cpu"))
    assert {batch.shape for batch in plan.batches} == {0, 1, 2}
    assert len(plan.flat) > 90
    return forest


@cache
def uniform(level, cells=(2, 1, 1)):
    return wc.TetForest.box(cells, CUBE, level)


@cache
def general(level=4):
    return jittered(cells=(2, 1, 1), level=level)


MESHES = {
    "level 5": lambda: uniform(5),
    "level 6": lambda: uniform(6),
    "level 7": lambda: uniform(7),
    "600 subtrees": lambda: uniform(6, (5, 5, 1)),
    "adaptive": adaptive,
    "general": general,
}
COROTATED = [
    wc.Corotated(),
    wc.Corotated(rotation_level=3),
    wc.Corotated(rotation_level=1),
    wc.Corotated(rotation_level=4),
    wc.Corotated(rotation="svd", rotation_level=2),
    wc.Corotated(subtrees=False),
]
OTHERS = [
    wc.Corotated(rotation="svd"),
    wc.Linear(),
    wc.StVenantKirchhoff(),
    wc.NeoHookean(),
    wc.EdgeStVK(),
    wc.MassSpring(),
]
CASES = [
    *((mesh, model) for mesh in ("level 6", "adaptive") for model in COROTATED),
    *((mesh, COROTATED[0]) for mesh in ("level 5", "level 7", "600 subtrees", "general")),
    *((mesh, COROTATED[1]) for mesh in ("level 7", "600 subtrees")),
    *((mesh, model) for mesh in ("adaptive", "general") for model in OTHERS),
]

ON_CPU = [("adaptive", COROTATED[0]), ("adaptive", COROTATED[1]), ("general", COROTATED[0]), ("general", OTHERS[3])]


def body_on(device, mesh, *, amount=0.0, worlds=1, followed=False):
    """A block fixed at x = 0, its other nodes displaced by up to ``amount`` of the shortest edge.

    ``followed``: keyframes hold one of the nodes, so that steps on CUDA are always separate launches.
    """
    rng = np.random.default_rng(7)
    young = YOUNG * rng.uniform(0.5, 2.0, (worlds, len(mesh.tets))) if worlds > 1 else YOUNG
    body = wc.SoftBody(mesh, wc.Isotropic(young, POISSON, DENSITY), worlds=worlds, device=device)
    fixed = np.flatnonzero(mesh.points[:, 0] < 0.1 * CUBE)
    start = np.stack([random_displacement(mesh, rng, amount) for _ in range(worlds)])
    start[:, fixed] = 0.0
    body.displacements = start
    body.fix(fixed)
    if followed:
        body.prescribe(fixed[:1], times=[0.0, 1.0], displacements=np.zeros((2, 3)))
    return body


def simulated(bodies, model=None, *, dt=None, deterministic=False):
    integrator = wc.SymplecticEuler(dt=dt, damping=DAMPING)
    return wc.Simulation(bodies, model=model, integrator=integrator, gravity=GRAVITY, deterministic=deterministic)


def state(sim):
    """The complete final state of a run."""
    arrays = [getattr(b, name).numpy() for b in sim.bodies for name in ("displacements", "velocities", "reactions")]
    return np.concatenate(arrays + [sim.forces(b).numpy() for b in sim.bodies])


def assert_repeats(make, steps=200):
    """Two equal runs end in the same state, bit for bit, after finite motion."""
    ends = []
    for _ in range(2):
        sim = make()
        start = sim.body.displacements.numpy()
        sim.advance_steps(steps)
        assert (sim.body.displacements.numpy() != start).any()
        ends.append((sim.dt, state(sim)))
    assert np.isfinite(ends[0][1]).all()
    assert ends[0][0] == ends[1][0]
    np.testing.assert_array_equal(ends[0][1], ends[1][1])


# --- bit by bit ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("mesh", "model"), CASES, ids=repr)
def test_runs_repeat_bit_by_bit(mesh, model, device):
    """Each run finds its steps again, from the same forces."""
    if device == "cpu" and (mesh, model) not in ON_CPU:
        pytest.skip("sums are in one order for all laws there")
    assert_repeats(lambda: simulated(body_on(device, MESHES[mesh](), amount=0.1), model, deterministic=True))


@pytest.mark.parametrize("followed", [False, True])
@pytest.mark.parametrize("model", [wc.Corotated(), wc.Corotated(rotation_level=3)], ids=repr)
@pytest.mark.parametrize("mesh", ["level 6", "adaptive", "general"])
def test_runs_from_crushed_and_inverted_elements_repeat(mesh, model, followed, device):
    """Subtrees that the fast rotation leaves out add their forces in a fixed order, too."""
    if mesh == "general" and model.rotation_level is not None:
        pytest.skip("general meshes have no tree")
    started = body_on(device, MESHES[mesh](), amount=0.9)
    x = started.mesh.points + started.displacements.numpy().astype(float)
    F = oracle_mesh(started.mesh).deformation_gradients(x)
    assert (np.linalg.det(F) < -0.1).sum() > 20
    dt = 0.2 * min_step(started.mesh)  # recovering from inversion is stiffer than the state for which steps are found

    def make():
        body = body_on(device, started.mesh, amount=0.9, followed=followed)
        return simulated(body, model, dt=dt, deterministic=True)

    assert_repeats(make)


def test_runs_of_worlds_and_of_several_bodies_repeat(device):
    def make():
        bodies = [body_on(device, mesh, amount=0.1, worlds=3) for mesh in (uniform(6), adaptive(), general())]
        models = [wc.Corotated(), wc.Corotated(rotation_level=2), wc.MassSpring()]
        return simulated(bodies, models, deterministic=True)

    assert_repeats(make)


@pytest.mark.parametrize(("mesh", "model"), CASES, ids=repr)
@pytest.mark.parametrize("amount", [0.1, 0.9])
def test_sums_in_one_order_give_the_same_forces(mesh, model, amount, device):
    """Up to some fifty forces at a node, each rounded to 6e-8: 1e-6 of the largest times a few."""
    if device == "cpu":
        pytest.skip("one thread, one order: nothing is done differently")
    body = body_on(device, MESHES[mesh](), amount=amount, worlds=2)
    forces = [simulated(body, model, dt=1e-4, deterministic=d).forces().numpy() for d in (False, True)]
    assert np.isfinite(forces[0]).all()
    assert np.abs(forces[0] - forces[1]).max() < 5e-6 * np.abs(forces[0]).max()


# --- from device to device -----------------------------------------------------------------------------------------

#: How far float32 may be from float64 after 1000 steps, relative to the largest displacement. The corotated force is
#: off by some 1.5e-7 over the strain, at this block's strains of 0.1 and more by 1e-6; motion is damped 15 times a
#: second and nearly at rest at the end, so that nothing grows. One CPU core is off by 1e-7 to 5e-7.
NEAR = 5e-6
STEPS = 1000

PATHS = {
    "own rotations": (lambda: uniform(4), wc.Corotated(), {}),
    "own rotations, launches": (lambda: uniform(4), wc.Corotated(), {"followed": True}),
    "shared three levels up": (lambda: uniform(4), wc.Corotated(rotation_level=1), {}),
    "shared three levels up, launches": (lambda: uniform(4), wc.Corotated(rotation_level=1), {"followed": True}),
    "shared above": (lambda: uniform(4), wc.Corotated(rotation_level=0), {}),
    "groups": (lambda: uniform(6), wc.Corotated(), {"followed": True}),
    "more subtrees than a block holds": (MESHES["600 subtrees"], wc.Corotated(), {}),
    "adaptive": (lambda: adaptive(4, (0.7, 1.4)), wc.Corotated(), {}),
    "adaptive, shared": (lambda: adaptive(4, (0.7, 1.4)), wc.Corotated(rotation_level=1), {}),
    "adaptive, groups": (adaptive, wc.Corotated(), {}),
    "general": (lambda: general(3), wc.Corotated(), {}),
    "worlds": (lambda: uniform(4), wc.Corotated(), {"worlds": 3}),
    "in one order": (adaptive, wc.Corotated(), {"deterministic": True}),
    "linear": (lambda: uniform(4), wc.Linear(), {}),
    "neo-Hookean": (lambda: general(3), wc.NeoHookean(), {}),
}


def settled(path, device):
    """Displacements after ``STEPS`` steps of half the stable one, float64 [worlds, N, 3], and how it was simulated."""
    make, model, options = PATHS[path]
    options = dict(options)
    deterministic = options.pop("deterministic", False)
    mesh = make()
    dt = 0.4 * min_step(mesh)
    sim = simulated(body_on(device, mesh, **options), model, dt=dt, deterministic=deterministic)
    sim.advance_steps(STEPS)
    return sim.body.displacements.numpy().astype(float).reshape(sim.worlds, -1, 3), sim


@cache
def min_step(mesh):
    """The stable step on the CPU: the same on every device."""
    return simulated(body_on("cpu", mesh)).stable_dt


def difference(u, expected):
    return np.abs(u - expected).max() / np.abs(expected).max()


AGAINST_FLOAT64 = ["own rotations", "own rotations, launches", "adaptive", "general", "linear", "worlds"]


@pytest.mark.parametrize("path", AGAINST_FLOAT64)
def test_a_thousand_steps_against_float64(path, device):
    """The same scheme in float64 with the oracle: the float32 error of 1000 steps on each path."""
    u, sim = settled(path, device)
    mesh, worlds = sim.body.mesh, sim.worlds
    reference = oracle_mesh(mesh)
    model = "linear" if path == "linear" else "corotated"
    fixed = sim.body.constrained[: len(mesh.points)]
    for world in range(worlds):
        young = np.broadcast_to(sim.body.material.young, (worlds, len(mesh.tets)))[world]
        x, _ = oracle.symplectic_euler(
            model,
            reference,
            mesh.points,
            np.zeros_like(mesh.points),
            *oracle.lame(young, POISSON),
            reference.masses(DENSITY),
            sim.dt,
            STEPS,
            gravity=GRAVITY,
            damping=DAMPING,
            fixed=fixed,
        )
        off = difference(u[world], x - mesh.points)
        print(f"{path}, {device}, world {world}: off by {off:.1e} of {np.abs(x - mesh.points).max():.2e} m")
        assert off < NEAR


@pytest.mark.parametrize("path", PATHS)
def test_a_thousand_steps_are_the_same_on_cpu_and_cuda(path, device):
    if device == "cpu":
        pytest.skip("nothing to compare with")
    u, _ = settled(path, device)
    expected, _ = settled(path, "cpu")
    off = difference(u, expected)
    print(f"{path}: {device} and cpu differ by {off:.1e} of {np.abs(expected).max():.2e} m")
    assert off < 2 * NEAR
