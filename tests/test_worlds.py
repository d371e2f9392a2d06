"""Many copies of a body: each does what it would do alone, whatever the others do.

On the CPU that is bit for bit: a world's elements come in the same order as a body's of its own. On CUDA forces are
added in any order; ``TOLERANCE`` of the largest value is what some ten steps make of that.
"""

import json

import numpy as np
import pytest
import warp as wp
from cases import jittered, mixed_forest, random_displacement
from pxr import Usd, UsdGeom

import warp_corot as wc
from warp_corot.io.animate import record

CUBE, WORLDS, DT = 0.064, 3, 2e-4
TOLERANCE = 1e-4

MESHES = {
    "uniform": lambda: wc.TetForest.box((1, 1, 1), CUBE, 3),  # six subtrees: worlds share the lanes of a vector
    "adaptive": lambda: mixed_forest(passes=2),
    "general": lambda: jittered(cells=(1, 1, 1), level=2),
}
FOREST_MODELS = [
    wc.Corotated(rotation_level=0),
    wc.Corotated(rotation_level=1),
    wc.Corotated(rotation="warm", rotation_level=0),
    wc.Corotated(stiffness="sparse"),
    wc.Corotated(stiffness="dense", rotation_level=1),
    wc.Corotated(subtrees=False),
]
ALL_MODELS = [
    wc.Corotated(),
    wc.Corotated(rotation="warm"),
    wc.Corotated(rotation="svd"),
    wc.Corotated(iterations=4),
    wc.Linear(),
    wc.StVenantKirchhoff(),
    wc.NeoHookean(),
    wc.EdgeStVK(),
    wc.EdgeStVK(springs="quadratic"),
    wc.MassSpring(),
]
CASES = [(mesh, model) for mesh in MESHES for model in (FOREST_MODELS if mesh != "general" else []) + ALL_MODELS]


def simulated(bodies, model=None, **options):
    integrator = wc.SymplecticEuler(dt=DT, damping=2.0)
    return wc.Simulation(bodies, model=model, integrator=integrator, gravity=(0.3, -9.8, 0.1), **options)


def beam(device, *, worlds=WORLDS, young=5e3, mesh=None):
    """Copies of a small block, held at z = 0."""
    mesh = mesh or wc.TetForest.box((1, 1, 1), CUBE, 3)
    body = wc.SoftBody(mesh, wc.Isotropic(young, 0.4, 1000.0), worlds=worlds, device=device)
    body.fix(mesh.points[:, 2] < 1e-9)
    return body


def states(body, worlds=WORLDS):
    """Displacements, velocities and reactions, [worlds, 3, N, 3]."""
    arrays = [getattr(body, name).numpy() for name in ("displacements", "velocities", "reactions")]
    return np.stack([a.reshape(worlds, -1, 3) for a in arrays], axis=1)


def assert_same(device, actual, expected):
    """Equal bit for bit on the CPU, to rounding in each kind of value on CUDA; of one or more ``states``."""
    assert np.isfinite(expected).all()
    if device == "cpu":
        np.testing.assert_array_equal(actual, expected)
    scale = np.abs(expected).max(axis=(-2, -1), keepdims=True)
    assert (np.abs(actual - expected) <= TOLERANCE * scale).all()


# --- alone or together ---------------------------------------------------------------------------------------------


class Scene:
    """Three worlds that differ in everything: what each holds, moves, carries, weighs, and how it starts."""

    def __init__(self, mesh, rng):
        n, t = len(mesh.points), len(mesh.tets)
        self.mesh = mesh
        self.young = rng.uniform(2e3, 2e4, (WORLDS, t))
        self.poisson = rng.uniform(0.2, 0.45, (WORLDS, 1))
        self.density = rng.uniform(500.0, 2000.0, (WORLDS, 1))
        nodes = rng.permutation(n)
        self.fixed, self.moved, self.keyed = nodes[: n // 6], nodes[n // 6 : n // 5], nodes[n // 5 : n // 4 + 3]
        self.forces = rng.normal(0.0, 0.01, (WORLDS, n, 3))
        self.start = np.stack([random_displacement(mesh, rng, 0.1) for _ in range(WORLDS)])
        self.velocities = rng.normal(0.0, 0.05, (WORLDS, n, 3))
        self.keys = CUBE * rng.uniform(-0.05, 0.05, (2, len(self.keyed), 3))

    def constrain(self, body, world, in_body):
        """What one world is held, moved and loaded by; ``in_body`` names it among the body's worlds."""
        if world != 1:
            body.fix(self.fixed, worlds=in_body)
        if world != 2:
            body.prescribe(self.moved, velocity=[0.01 * world, 0.02, 0.0], worlds=in_body)
            keys = (1 + world) * self.keys
            body.prescribe(self.keyed, times=[0.001, 0.004], displacements=keys, worlds=in_body)
        body.load(np.arange(len(self.mesh.points)), self.forces[world], worlds=in_body)

    def together(self, device):
        body = wc.SoftBody(
            self.mesh, wc.Isotropic(self.young, self.poisson, self.density), worlds=WORLDS, device=device
        )
        body.displacements, body.velocities = self.start, self.velocities
        for world in range(WORLDS):
            self.constrain(body, world, world)
        return body

    def alone(self, world, device):
        own = (self.young[world], self.poisson[world, 0], self.density[world, 0])
        body = wc.SoftBody(self.mesh, wc.Isotropic(*own), device=device)
        body.displacements, body.velocities = self.start[world], self.velocities[world]
        self.constrain(body, world, None)
        return body


@pytest.mark.parametrize(("mesh", "model"), CASES, ids=repr)
def test_every_world_is_a_body_of_its_own(mesh, model, device, rng):
    scene = Scene(MESHES[mesh](), rng)
    sim = simulated(scene.together(device), model)
    sim.advance_steps(25)
    stresses = sim.von_mises().reshape(WORLDS, -1)
    energy = np.zeros(3)
    for world in range(WORLDS):
        single = simulated(scene.alone(world, device), model)
        single.advance_steps(25)
        assert_same(device, states(sim.body)[world], states(single.body, 1)[0])
        assert_same(device, stresses[world][:, None], single.von_mises()[:, None])
        np.testing.assert_allclose(sim.body.masses.reshape(WORLDS, -1)[world], single.body.masses, rtol=1e-14)
        energy += single.energy()
    np.testing.assert_allclose(sim.energy(), energy, rtol=1e-4)


@pytest.mark.parametrize("model", [wc.Corotated(), wc.Corotated(rotation_level=0), wc.MassSpring()], ids=repr)
def test_a_number_for_each_world_is_as_a_number_for_a_body(model, device):
    """Shared rotations of one material go by another kernel than those of several: the same but for rounding."""
    young = [2e3, 5e3, 9e3]
    sim = simulated(beam(device, young=np.reshape(young, (3, 1))), model)
    sim.advance_steps(100)
    for world, own in enumerate(young):
        single = simulated(beam(device, worlds=1, young=own), model)
        single.advance_steps(100)
        u = single.body.displacements.numpy()
        off = np.abs(sim.body.world(world).displacements.numpy() - u).max()
        assert off < 1e-5 * np.abs(u).max()


def test_subtrees_turned_inside_out_in_one_world_leave_the_others(device, rng):
    """The fast kernels leave such subtrees out, and they are done again one by one."""
    for model in (wc.Corotated(), wc.Corotated(rotation_level=0)):
        mesh = MESHES["uniform"]()
        start = np.stack([random_displacement(mesh, rng, amount) for amount in (0.1, 1.0, 0.1)])
        bodies = [wc.SoftBody(mesh, wc.Isotropic(5e3, 0.3, 1e3), worlds=w, device=device) for w in (3, 1, 1, 1)]
        for body, u in zip(bodies, [start, *start], strict=True):
            body.displacements = u
        sims = [simulated(body, model) for body in bodies]
        forces = [sim.forces().numpy().reshape(-1, len(mesh.points), 3) for sim in sims]
        assert_same(device, forces[0], np.concatenate(forces[1:]))


MATERIALS = {
    "one number": lambda w, t: 0.7,
    "of each element": lambda w, t: np.linspace(0.5, 1.5, t),
    "of each world": lambda w, t: np.linspace(0.5, 1.5, w)[:, None],
    "of one row for all": lambda w, t: np.linspace(0.5, 1.5, t)[None],
    "of each element in each world": lambda w, t: np.linspace(0.5, 1.5, w * t).reshape(w, t),
}


@pytest.mark.parametrize("model", [wc.Corotated(), wc.MassSpring()], ids=repr)
@pytest.mark.parametrize("form", MATERIALS)
def test_material_of_worlds_and_elements(form, model, device, rng):
    """All forms mean what they broadcast to; masses are a quarter of each element's at each of its nodes."""
    mesh = MESHES["adaptive"]()
    t, n = len(mesh.tets), len(mesh.points)
    share = MATERIALS[form](WORLDS, t)
    values = [1e4 * share, 0.3 * share, 1e3 * (2.0 - share)]
    everywhere = np.stack([np.broadcast_to(value, (WORLDS, t)) for value in values])
    body = wc.SoftBody(mesh, wc.Isotropic(*values), worlds=WORLDS, device=device)
    u = random_displacement(mesh, rng, 0.1)
    body.displacements = u
    forces = simulated(body, model).forces().numpy().reshape(WORLDS, n, 3)
    for world in range(WORLDS):
        mass = np.zeros(n)
        np.add.at(mass, mesh.tets, 0.25 * (mesh.volumes * everywhere[2, world])[:, None])
        np.testing.assert_allclose(body.masses.reshape(WORLDS, n)[world], mass, rtol=1e-12)
        single = wc.SoftBody(mesh, wc.Isotropic(*everywhere[:, world]), device=device)
        single.displacements = u
        assert_same(device, forces[world], simulated(single, model).forces().numpy())


def test_the_stable_step_is_that_of_the_stiffest_world(device):
    young = np.array([[1e3], [9e3], [4e3]])
    together = wc.Simulation(beam(device, young=young))
    stiffest = wc.Simulation(beam(device, worlds=1, young=9e3))
    assert together.stable_dt == pytest.approx(stiffest.stable_dt, rel=0.02)


# --- what is done to chosen worlds ---------------------------------------------------------------------------------


def test_loads_of_all_shapes(device):
    body = beam(device)
    n, nodes = body.world_node_count, np.array([4, 1, 7])
    each = np.arange(9.0).reshape(3, 3) + 1
    expected = np.zeros((WORLDS, n, 3))

    def check(force, worlds, values):
        body.load(nodes, force, worlds=worlds)
        chosen = np.arange(WORLDS) if worlds is None else worlds
        expected[np.ix_(chosen, nodes)] = values
        np.testing.assert_array_equal(body.loads.numpy().reshape(WORLDS, n, 3), expected)

    check([1, 2, 3], None, [1, 2, 3])
    check(each, None, each)
    by_world = np.array([[[1.0, 0, 0]], [[0, 2.0, 0]], [[0, 0, 3.0]]])
    check(by_world, None, by_world)
    check(by_world + each, None, by_world + each)
    check((by_world - each).reshape(-1, 3), None, by_world - each)
    check(by_world[:2] + each, [2, 0], by_world[:2] + each)  # in the order of the worlds given
    check(2 * each[None], [1], 2 * each)
    check(by_world[:0], [], by_world[:0])
    mask = np.zeros((WORLDS, n), bool)
    mask[0, 3] = mask[2, 5] = True
    body.load(mask, [[1, 1, 1], [2, 2, 2]])
    expected[0, 3], expected[2, 5] = 1, 2
    np.testing.assert_array_equal(body.loads.numpy().reshape(WORLDS, n, 3), expected)


def test_held_nodes_of_chosen_worlds(device):
    body = wc.SoftBody(MESHES["uniform"](), wc.Isotropic(5e3, 0.4, 1e3), worlds=WORLDS, device=device)
    n = body.world_node_count
    held = np.zeros((WORLDS, n), bool)

    def check():
        np.testing.assert_array_equal(body.constrained.reshape(WORLDS, n), held)
        inverse = body.node_inverse_mass.numpy().reshape(WORLDS, n)
        np.testing.assert_array_equal(inverse == 0, held)

    body.fix([0, -1])
    held[:, [0, -1]] = True
    check()
    body.release([0], worlds=1)
    held[1, 0] = False
    check()
    body.fix(np.arange(n) < 3, worlds=np.array([True, False, True]))
    held[[0, 2], :3] = True
    check()
    mask = np.zeros((WORLDS, n), bool)
    mask[1, 5] = mask[2, 6] = True
    body.fix(mask)
    body.fix(mask.ravel())
    held |= mask
    check()
    body.prescribe([8, 9], velocity=[[[1, 0, 0], [2, 0, 0]], [[3, 0, 0], [4, 0, 0]]], worlds=[2, 1])
    held[1:, [8, 9]] = True
    check()
    speeds = body.velocities.numpy().reshape(WORLDS, n, 3)[:, [8, 9], 0]
    np.testing.assert_array_equal(speeds, [[0, 0], [3, 4], [1, 2]])
    body.release(held)
    held[:] = False
    check()


def test_masks_and_shapes_of_all_worlds_also_of_one_world(device):
    """What is written for any number of worlds works for one."""
    body = beam(device, worlds=1)
    n = body.world_node_count
    body.fix(np.arange(n)[None] == 5)
    assert body.constrained[5]
    body.load([1, 2], np.ones((1, 1, 3)))
    body.load([1, 2], [[[1, 2, 3], [4, 5, 6]]])
    np.testing.assert_array_equal(body.loads.numpy()[[1, 2]], [[1, 2, 3], [4, 5, 6]])
    body.positions = body.mesh.points[None] + 1.0
    np.testing.assert_allclose(body.displacements.numpy(), 1.0, rtol=1e-6)


@pytest.mark.parametrize("worlds", [1, 3])
@pytest.mark.parametrize("count", [1, 2, 3])
def test_keyframes_for_all_nodes_alike(count, worlds, device):
    """[K, 3], also where as many nodes are named as a vector has components."""
    body = beam(device, worlds=worlds)
    end = np.array([0.001, 0.002, 0.003])
    top = np.flatnonzero(body.mesh.points[:, 2] > CUBE - 1e-9)[:count]
    body.prescribe(top, times=[0.0, 0.001], displacements=[[0, 0, 0], end])
    simulated(body).advance(0.002)
    moved = body.displacements.numpy().reshape(worlds, -1, 3)[:, top]
    np.testing.assert_allclose(moved, np.broadcast_to(end, moved.shape), atol=1e-8)


def test_keyframes_of_each_world_begin_anew_when_it_is_reset(device):
    body = beam(device)
    top = np.flatnonzero(body.mesh.points[:, 2] > CUBE - 1e-9)
    times = np.array([0.0, 0.004, 0.01])
    ends = 0.003 * np.array([[1.0, 0, 0], [0, 1.0, 0], [0, 0, 1.0]])
    rise = np.array([0.0, 1.0, -1.0])
    for world, end in enumerate(ends):
        each = np.linspace(0.5, 1.5, len(top))[:, None] * end
        body.prescribe(top, times=times, displacements=rise[:, None, None] * each, worlds=[world])
    sim = simulated(body)
    starts = np.zeros(WORLDS)
    for steps, reset in ((13, [1]), (9, [0, 1]), (21, None), (17, [2]), (60, [])):
        sim.advance_steps(steps)
        height = np.interp(sim.time - starts, times, rise)
        expected = height[:, None, None] * np.linspace(0.5, 1.5, len(top))[:, None] * ends[:, None]
        moved = body.displacements.numpy().reshape(WORLDS, -1, 3)[:, top]
        np.testing.assert_allclose(moved, expected, atol=1e-7)
        sim.reset(reset)
        starts[slice(None) if reset is None else reset] = sim.time
    assert sim.steps == 77  # since all were reset
    assert sim.total_steps == 120


# --- views ---------------------------------------------------------------------------------------------------------


def test_views_of_a_world_are_live(device, rng):
    body = beam(device)
    n = body.world_node_count
    sim = simulated(body)
    sim.advance_steps(5)
    view = body.world(1)
    assert (view.nodes, view.elements) == (slice(n, 2 * n), slice(48, 96))
    for name in ("positions", "displacements", "velocities", "reactions", "loads"):
        every = getattr(body, name).numpy().reshape(WORLDS, n, 3)
        np.testing.assert_array_equal(getattr(view, name).numpy(), every[1], err_msg=name)
    before = states(body)
    moved = body.mesh.points + 0.01 * rng.random((n, 3))
    view.positions.assign(moved.astype(np.float32))
    view.velocities.assign(np.full((n, 3), 0.5, np.float32))
    view.loads.assign(np.full((n, 3), 0.25, np.float32))
    after = states(body)
    np.testing.assert_array_equal(after[[0, 2]], before[[0, 2]])
    np.testing.assert_allclose(after[1, 0], moved - body.mesh.points, atol=1e-8)
    np.testing.assert_array_equal(after[1, 1], 0.5)
    np.testing.assert_array_equal(body.loads.numpy().reshape(WORLDS, n, 3)[:, :, 0], [[0.0] * n, [0.25] * n, [0.0] * n])
    sim.step()
    held = body.constrained[:n]
    np.testing.assert_allclose(view.positions.numpy()[held], moved[held] + 0.5 * DT, atol=1e-7)


# --- reset ---------------------------------------------------------------------------------------------------------


WAYS = {
    "all": (lambda device: None, [0, 1, 2]),
    "an index": (lambda device: 1, [1]),
    "a list": (lambda device: [2, 0], [0, 2]),
    "a mask": (lambda device: np.array([False, True, True]), [1, 2]),
    "none": (lambda device: [], []),
    "on the device": (lambda device: wp.array([0, 7, 0], dtype=wp.int32, device=device), [1]),
}


@pytest.mark.parametrize("way", WAYS)
def test_reset_of_chosen_worlds(way, device):
    given, chosen = WAYS[way][0](device), WAYS[way][1]
    sim = simulated(beam(device, young=np.array([[2e3], [5e3], [9e3]])))
    sim.advance_steps(20)
    positions, before = sim.body.positions.numpy().copy(), states(sim.body)
    sim.reset(given)
    kept = [world for world in range(WORLDS) if world not in chosen]
    after = states(sim.body)
    np.testing.assert_array_equal(after[kept], before[kept])
    assert np.abs(before[chosen]).max(initial=1.0) > 0
    assert not after[chosen].any()
    now = sim.body.positions.numpy().reshape(WORLDS, -1, 3)
    np.testing.assert_array_equal(now[kept], positions.reshape(now.shape)[kept])
    rest = np.broadcast_to(sim.body.mesh.points.astype(np.float32), now.shape)
    np.testing.assert_array_equal(now[chosen], rest[chosen])
    assert sim.steps == (0 if given is None else 20)
    sim.advance_steps(20)
    assert_same(device, states(sim.body)[chosen], before[chosen])


@pytest.mark.parametrize("initial", [False, True], ids=["from rest", "from a state of their own"])
@pytest.mark.parametrize(
    ("mesh", "model"),
    [
        ("uniform", wc.Corotated()),
        ("adaptive", wc.Corotated(rotation_level=1)),
        ("adaptive", wc.Corotated(rotation="warm")),
        ("uniform", wc.Corotated(rotation="warm", rotation_level=0)),
        ("general", wc.Corotated()),
        ("general", wc.NeoHookean()),
    ],
    ids=repr,
)
def test_a_world_that_is_reset_repeats_its_first_run(mesh, model, initial, device, rng):
    mesh = MESHES[mesh]()
    body = beam(device, young=np.array([[2e3], [5e3], [9e3]]), mesh=mesh)
    top = np.flatnonzero(mesh.points[:, 2] > mesh.points[:, 2].max() - 1e-3)[:4]
    body.prescribe(top, times=[0.0, 0.01], displacements=[[0, 0, 0], [0.002, 0, 0]], worlds=[0, 1])
    if initial:
        u = np.stack([random_displacement(mesh, rng, 0.1) for _ in range(WORLDS)]).reshape(-1, 3)
        body.displacements = u
        body.velocities = rng.normal(0.0, 0.1, u.shape) * ~body.constrained[:, None]
        body.set_initial_state()
    sim = simulated(body, model)
    sim.advance_steps(30)
    first = states(body)
    sim.advance_steps(11)
    sim.reset([1])
    sim.advance_steps(30)
    assert_same(device, states(body)[1], first[1])
    sim.reset()
    sim.advance_steps(30)
    assert_same(device, states(body), first)


def test_held_nodes_are_held_and_moved_ones_moved_after_a_reset(device):
    """Without an initial state of its own, a world keeps what it was told about its nodes."""
    body = beam(device)
    top = np.flatnonzero(body.mesh.points[:, 2] > CUBE - 1e-9)
    body.prescribe(top, velocity=[0.01, 0, 0], worlds=[1])
    sim = simulated(body)
    sim.advance_steps(10)
    sim.reset([1])
    sim.advance_steps(7)
    moved = body.displacements.numpy().reshape(WORLDS, -1, 3)
    np.testing.assert_allclose(moved[1, top, 0], 0.01 * 7 * DT, rtol=1e-5)
    assert not moved[:, body.mesh.points[:, 2] < 1e-9].any()


@pytest.mark.xfail(strict=True, reason="a reset gives held nodes the velocities of the initial state")
def test_nodes_that_are_held_since_the_initial_state_stay_held(device):
    body = beam(device)
    body.velocities = np.full((body.node_count, 3), 0.1) * ~body.constrained[:, None]
    body.set_initial_state()
    top = np.flatnonzero(body.mesh.points[:, 2] > CUBE - 1e-9)
    body.fix(top[:4])
    body.prescribe(top[4:], velocity=[0.0, 0.0, 0.03])
    sim = simulated(body)
    sim.advance_steps(10)
    sim.reset()
    sim.advance_steps(7)
    moved = body.displacements.numpy().reshape(WORLDS, -1, 3)
    assert not moved[:, top[:4]].any()
    np.testing.assert_allclose(moved[:, top[4:], 2], 0.03 * 7 * DT, rtol=1e-5)


def test_a_hook_may_reset_and_the_run_still_ends(device):
    sim = simulated(beam(device))
    seen = []

    def again(s):
        seen.append(s.steps)
        s.reset()

    sim.on_step(again, every=10)
    sim.advance_steps(35)
    assert seen == [10, 10, 10]
    assert sim.steps == 5
    assert sim.total_steps == 35


# --- worlds that come to grief -------------------------------------------------------------------------------------


def blow(body):
    """Velocities at which nothing holds together, of the free nodes of a world."""
    n = body.world_node_count
    velocities = np.random.default_rng(0).normal(0, 1e4, (n, 3)) * ~body.constrained[:n, None]
    return velocities.astype(np.float32)


def test_an_unstable_world_is_named_and_leaves_the_others(device):
    """StVK turns inside out and runs away from a blow that is much too hard."""
    quiet, sim = (simulated(beam(device), wc.StVenantKirchhoff()) for _ in range(2))
    sim.body.world(1).velocities.assign(blow(sim.body))
    with pytest.raises(wc.UnstableError, match=r"not finite since step \d+ .* in world 1; dt is"):
        sim.advance_steps(100)
    quiet.advance_steps(sim.steps)
    assert_same(device, states(sim.body)[[0, 2]], states(quiet.body)[[0, 2]])
    for s in (sim, quiet):
        s.reset(1)
    sim.advance_steps(50)
    quiet.advance_steps(50)
    assert_same(device, states(sim.body), states(quiet.body))


def test_many_unstable_worlds_are_counted():
    body = beam("cpu", worlds=6)
    body.velocities = blow(body) * (np.arange(6) != 2)[:, None, None]
    with pytest.raises(wc.UnstableError, match="in world 0, 1, 3 and 2 more; dt is"):
        simulated(body, wc.StVenantKirchhoff()).advance_steps(100)


def test_a_reset_before_anybody_looked_forgets_what_was_unstable(device):
    """Recorded steps look at nothing; a world that has been put back since is no reason to stop."""
    for worlds in (None, [1]):
        sim = simulated(beam(device), wc.StVenantKirchhoff())
        with wp.ScopedCapture(device=device) as capture:
            sim.step()
        sim.body.world(1).velocities.assign(blow(sim.body))
        for _ in range(100):
            wp.capture_launch(capture.graph)
        assert not np.isfinite(sim.body.world(1).positions.numpy()).all()
        sim.reset(worlds)
        sim.advance_steps(3)
        assert np.isfinite(sim.body.positions.numpy()).all()


# --- kept, drawn, summed -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("model", [wc.Corotated(), wc.Corotated(rotation="warm"), wc.MassSpring()], ids=repr)
def test_a_checkpoint_keeps_all_worlds(model, device, tmp_path, rng):
    scene = Scene(MESHES["adaptive"](), rng)
    sims = [simulated(scene.together(device), model, deterministic=True) for _ in range(2)]
    for sim in sims:
        sim.body.set_initial_state()
        sim.advance_steps(8)
        sim.reset([1])
        sim.advance_steps(5)
    sims[0].save(tmp_path / "state.npz")
    resumed = wc.Simulation.load(tmp_path / "state.npz")
    assert (resumed.worlds, resumed.steps, resumed.deterministic) == (WORLDS, 13, True)
    for worlds in ([], [2], None):
        for sim in (resumed, sims[1]):
            sim.reset(worlds)
            sim.advance_steps(9)
        assert_same(device, states(resumed.body), states(sims[1].body))
    np.testing.assert_array_equal(resumed.body.constrained, sims[1].body.constrained)


def test_a_checkpoint_of_version_1_is_one_world(tmp_path, rng):
    scene = Scene(MESHES["adaptive"](), rng)
    sim = simulated(scene.alone(0, "cpu"))
    sim.advance_steps(12)
    sim.save(tmp_path / "now.npz")
    with np.load(tmp_path / "now.npz") as archive:
        arrays = {name: archive[name] for name in archive.files if not name.endswith("world_starts")}
    header = json.loads(arrays["header"].tobytes()) | {"version": 1}
    del header["worlds"], header["deterministic"]
    arrays["header"] = np.frombuffer(json.dumps(header).encode(), np.uint8)
    np.savez(tmp_path / "old.npz", **arrays)
    old = wc.Simulation.load(tmp_path / "old.npz")
    assert (old.worlds, old.deterministic, old.steps) == (1, False, 12)
    for s in (sim, old):
        s.advance_steps(15)
    np.testing.assert_array_equal(states(old.body, 1), states(sim.body, 1))


def test_one_world_is_recorded(device, tmp_path):
    young = np.array([[2e3], [5e3], [9e3]])
    sim = simulated([beam(device, young=young), beam(device)], [wc.Corotated(), wc.Linear()])
    with pytest.raises(wc.InputError, match=r"3 worlds; say which one to draw, as in world=0"):
        record(sim, tmp_path / "a.usd", duration=0.1)
    for wrong in (3, -1, 0.5, "first"):
        with pytest.raises(wc.InputError, match="must be a whole number from 0 to 2"):
            record(sim, tmp_path / "a.usd", duration=0.1, world=wrong)
    assert not list(tmp_path.iterdir())
    done = record(sim, tmp_path / "a.usd", duration=0.1, fps=50, world=2)
    stage = Usd.Stage.Open(str(tmp_path / "a.usd"))
    tets = UsdGeom.TetMesh.Get(stage, "/SoftBody/tetrahedra")
    drawn = np.array(tets.GetPointsAttr().Get(5))
    expected = np.concatenate([body.world(2).positions.numpy() for body in sim.bodies])
    np.testing.assert_array_equal(drawn, expected)
    primvar = UsdGeom.PrimvarsAPI(tets).GetPrimvar("young").Get()
    np.testing.assert_allclose(primvar, np.repeat([9e3, 5e3], 48))
    largest = max(np.linalg.norm(b.world(2).displacements.numpy(), axis=1).max() for b in sim.bodies)
    assert done.final_displacement == pytest.approx(largest, rel=1e-5)


def test_a_recording_goes_on_over_a_reset(tmp_path):
    sim = simulated(beam("cpu"))
    sim.on_step(lambda s: s.reset() if s.total_steps == 150 else None, every=50)
    done = record(sim, tmp_path / "a.usd", duration=0.1, fps=50, world=0)
    assert (done.frames, done.steps) == (6, 500)
    assert (sim.steps, sim.total_steps) == (350, 500)


# --- mistakes ------------------------------------------------------------------------------------------------------


def int32(n):
    return wp.zeros(n, dtype=wp.int32, device="cpu")


MISTAKES = {
    "no world": (lambda b: beam("cpu", worlds=0), "worlds is 0; it must be a whole number, at least 1"),
    "half a world": (lambda b: beam("cpu", worlds=1.5), "worlds is 1.5"),
    "a word": (lambda b: beam("cpu", worlds="many"), "worlds is 'many'"),
    "more than can be numbered": (lambda b: beam("cpu", worlds=2**30), "elements; there can be 2147483647 at most"),
    "no such world": (lambda b: b.world(3), "world is 3; it must be a whole number from 0 to 2"),
    "world before the first": (lambda b: b.world(-1), "world is -1"),
    "true for a world": (lambda b: b.world(True), "world is True"),
    "a word for a world": (lambda b: b.world("a"), "world is 'a'"),
    "NaN for a world": (lambda b: b.world(np.nan), "world is nan"),
    "materials of other worlds": (lambda b: beam("cpu", young=np.ones((2, 1))), r"\(2, 1\); there are 3 worlds of 48"),
    "materials of other elements": (lambda b: beam("cpu", young=np.ones((3, 7))), r"young has shape \(3, 7\)"),
    "a material of three dimensions": (lambda b: beam("cpu", young=np.ones((3, 1, 1))), r"shape \(3, 1, 1\)"),
    "bad in one world": (lambda b: beam("cpu", young=np.array([[1.0], [0.0], [2.0]])), "young in world 1 is 0 Pa"),
    "bad element in one world": (
        lambda b: beam("cpu", young=np.where(np.arange(144) == 50, -1.0, 1.0).reshape(3, 48)),
        "young of element 2 in world 1 is -1 Pa",
    ),
    "fixed in no such world": (lambda b: b.fix([0], worlds=3), "world 3 is out of range: there are 3"),
    "world mask too short": (lambda b: b.fix([0], worlds=[True, False]), r"world mask has shape \(2,\)"),
    "mask turned over": (lambda b: b.fix(np.ones((b.world_node_count, 3), bool)), "node mask has shape"),
    "mask of all worlds in one": (
        lambda b: b.fix(np.ones((3, b.world_node_count), bool), worlds=1),
        "says which worlds are meant",
    ),
    "node of another world": (lambda b: b.fix([b.world_node_count]), "is out of range"),
    "loads of other worlds": (lambda b: b.load([0, 1], np.ones((2, 2, 3))), r"or \[3, 2, 3\]"),
    "a word for a load": (lambda b: b.load([0], "down"), "force is 'down'"),
    "velocities of other worlds": (lambda b: b.prescribe([0], velocity=np.ones((2, 1, 3))), "velocity has shape"),
    "loads through a mask of all worlds": (
        lambda b: b.load(np.ones((3, b.world_node_count), bool), np.ones((3, 1, 3))),
        "force has shape",
    ),
    "keyframes of other nodes": (
        lambda b: b.prescribe([0, 1], times=[0, 1], displacements=np.zeros((2, 5, 3))),
        "displacements has shape",
    ),
    "state of another number": (lambda b: setattr(b, "velocities", np.zeros((2, 27, 3))), "velocities has shape"),
    "reset of no such world": (lambda b: simulated(b).reset([3]), "world 3 is out of range"),
    "reset by name": (lambda b: simulated(b).reset("all"), "world indices have dtype"),
    "reset by a short array": (lambda b: simulated(b).reset(int32(2)), r"int32 \[2\] on cpu; it must be int32 \[3\]"),
    "reset by floats": (lambda b: simulated(b).reset(wp.zeros(3, dtype=float, device="cpu")), r"worlds is float32 \[3"),
    "bodies of other numbers": (lambda b: simulated([b, beam("cpu", worlds=2)]), "bodies are in 3 and 2 worlds"),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_mistakes_with_worlds_are_named(mistake):
    act, message = MISTAKES[mistake]
    with pytest.raises(wc.InputError, match=message):
        act(beam("cpu"))
