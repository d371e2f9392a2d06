"""Stepping: constraints, loads, prescribed motion, hooks, recording, the stable step, and errors."""

import warnings

import numpy as np
import pytest

import warp_corot as wc

RUBBER = wc.Isotropic(young=2e4, poisson=0.4, density=1000.0)
MODELS = [
    wc.Linear(),
    wc.Corotated(),
    wc.Corotated(rotation_level=1),
    wc.StVenantKirchhoff(),
    wc.NeoHookean(),
    wc.EdgeStVK(),
    wc.MassSpring(),
]


def bar(device, model=None, *, dt=None, damping=0.0, gravity=(0.0, -9.81, 0.0), level=3, fixed=True):
    mesh = wc.TetForest.box(cells=(1, 1, 2), cell_size=0.1, level=level)
    body = wc.SoftBody(mesh, RUBBER, device=device)
    if fixed:
        body.fix(mesh.points[:, 2] < 1e-9)
    integrator = wc.SymplecticEuler(dt=dt, damping=damping)
    return wc.Simulation(body, model=model or wc.Corotated(), integrator=integrator, gravity=gravity)


@pytest.mark.parametrize("model", MODELS, ids=repr)
def test_supports_carry_the_weight_of_a_body_at_rest(device, model):
    sim = bar(device, model, damping=12.0)
    sim.advance(4.0)
    weight = sim.body.masses.sum() * 9.81
    # Float32 sums of opposing elastic forces: 1e-4 of the weight is two digits above rounding.
    np.testing.assert_allclose(sim.body.reactions.numpy().sum(axis=0), [0, weight, 0], atol=2e-4 * weight)
    assert sim.energy().kinetic < 1e-6 * sim.energy().elastic


def test_fixed_nodes_stay_and_free_ones_have_no_reaction(device):
    sim = bar(device)
    held = sim.body.constrained
    sim.advance(0.05)
    moved = np.linalg.norm(sim.body.positions.numpy() - sim.body.mesh.points, axis=1)
    assert moved[held].max() < 1e-8
    assert moved[~held].min() > 0
    assert np.abs(sim.body.reactions.numpy()[~held]).max() == 0


@pytest.mark.parametrize("dt", [None, 5e-4])
def test_released_nodes_fall(device, dt):
    sim = bar(device, dt=dt)
    sim.advance(0.05)
    sim.body.release(sim.body.constrained)
    momentum = sim.body.masses @ sim.body.velocities.numpy()
    before = sim.time
    sim.advance(0.1)
    gained = sim.body.masses @ sim.body.velocities.numpy() - momentum
    expected = sim.body.masses.sum() * -9.81 * (sim.time - before)
    # Velocities are half a step behind, and the step may have changed.
    late = 0.0 if dt else 0.5 * (sim.dt_range[1] - sim.dt_range[0]) / (sim.time - before)
    np.testing.assert_allclose(gained, [0, expected, 0], atol=(2e-4 + late) * abs(expected))
    assert np.abs(sim.body.reactions.numpy()).max() == 0


def test_nodal_loads_act_like_gravity(device):
    by_gravity, by_load = bar(device, dt=2e-4), bar(device, dt=2e-4, gravity=(0, 0, 0))
    by_load.body.load(np.arange(by_load.body.node_count), by_load.body.masses[:, None] * [0, -9.81, 0])
    for sim in (by_gravity, by_load):
        sim.advance(0.05)
    np.testing.assert_allclose(by_load.body.positions.numpy(), by_gravity.body.positions.numpy(), atol=2e-7)


def test_loads_written_in_place_take_effect_in_a_recorded_graph(device):
    sim = bar(device, gravity=(0, 0, 0), fixed=False)
    sim.body.load([0], [0, 0, 0])
    sim.advance(0.02)
    assert np.abs(sim.body.velocities.numpy()).max() < 1e-6
    force = np.zeros((sim.body.node_count, 3), np.float32)
    force[3] = [1.0, 0, 0]
    sim.body.loads.assign(force)
    start = sim.time
    sim.advance(0.02)
    momentum = sim.body.masses @ sim.body.velocities.numpy()
    np.testing.assert_allclose(momentum, [sim.time - start, 0, 0], atol=1e-5)


def test_prescribed_velocity_moves_nodes_at_it(device):
    sim = bar(device, gravity=(0, 0, 0), damping=20.0)
    top = sim.body.mesh.points[:, 2] > 0.2 - 1e-9
    sim.body.prescribe(top, velocity=(0.0, 0.0, 0.05))
    sim.advance(0.2)
    moved = sim.body.positions.numpy()[top] - sim.body.mesh.points[top]
    np.testing.assert_allclose(moved, np.tile([0, 0, 0.05 * sim.time], (top.sum(), 1)), atol=1e-6)
    pull = sim.body.reactions.numpy()[top].sum(axis=0)
    assert pull[2] > 0  # the support pulls a stretched bar further


def test_keyframes_are_followed_and_then_held(device):
    sim = bar(device, gravity=(0, 0, 0), damping=20.0, dt=5e-4)
    top = np.flatnonzero(sim.body.mesh.points[:, 2] > 0.2 - 1e-9)
    keys = np.zeros((3, len(top), 3))
    keys[1, :, 0] = 0.02
    keys[2, :, 0] = 0.01
    keys[2, :, 1] = np.linspace(0, 0.01, len(top))
    sim.body.prescribe(top, times=[0.0, 0.1, 0.2], displacements=keys)
    for until, expected in ((0.05, 0.5 * keys[1]), (0.1, keys[1]), (0.15, 0.5 * (keys[1] + keys[2])), (0.3, keys[2])):
        sim.advance(until - sim.time)
        moved = (sim.body.positions.numpy() - sim.body.mesh.points)[top]
        np.testing.assert_allclose(moved, expected, atol=1e-6)
    np.testing.assert_allclose(sim.body.velocities.numpy()[top], 0, atol=1e-5)


def test_nodes_let_go_of_keyframes_leave_the_others_to_them(device):
    sim = bar(device, gravity=(0, 0, 0), damping=20.0, dt=5e-4)
    top = np.flatnonzero(sim.body.mesh.points[:, 2] > 0.2 - 1e-9)
    keys = np.zeros((2, len(top), 3))
    keys[1, :, 0] = np.linspace(0.01, 0.02, len(top))
    sim.body.prescribe(top, times=[0.0, 0.1], displacements=keys)
    sim.advance(0.05)
    sim.body.release(top[::2])
    sim.body.fix(top[1:2])
    sim.advance(0.1)
    moved = (sim.body.positions.numpy() - sim.body.mesh.points)[top]
    np.testing.assert_allclose(moved[3::2], keys[1, 3::2], atol=1e-6)
    np.testing.assert_allclose(moved[1], keys[1, 1] / 2, atol=1e-6)
    assert (np.abs(moved[::2] - keys[1, ::2]).max(axis=1) > 1e-4).all()
    assert not sim.body.constrained[top[::2]].any()


def test_positions_written_by_the_user_are_where_the_next_step_starts(device):
    sim = bar(device, gravity=(0, 0, 0), fixed=False)
    moved = sim.body.mesh.points + np.array([0.3, -0.2, 0.1])
    sim.body.positions.assign(moved.astype(np.float32))
    sim.step()
    np.testing.assert_allclose(sim.body.positions.numpy(), moved, atol=1e-6)
    sim.body.positions = moved * 1.1
    assert sim.energy().elastic > 0
    np.testing.assert_allclose(sim.body.displacements.numpy(), moved * 1.1 - sim.body.mesh.points, atol=1e-7)


def test_untouched_positions_leave_every_digit_of_the_state(device):
    one, other = bar(device, dt=5e-4), bar(device, dt=5e-4)
    one.advance(0.064)
    for _ in range(128):
        other.step()
        other.body.positions.numpy()
    if one.device.is_cpu:
        np.testing.assert_array_equal(one.body.displacements.numpy(), other.body.displacements.numpy())
    np.testing.assert_allclose(one.body.displacements.numpy(), other.body.displacements.numpy(), atol=1e-6)
    assert one.steps == other.steps == 128


@pytest.mark.parametrize("model", [wc.Linear(), wc.MassSpring(), wc.StVenantKirchhoff()], ids=repr)
@pytest.mark.parametrize("level", [2, 3, 4])
def test_stable_step_is_the_edge_of_stability(device, model, level):
    """Just below 2/omega small motions stay bounded, just above they grow exponentially."""

    def growth(share):
        probe = bar(device, model, gravity=(0, 0, 0), level=level)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            sim = bar(device, model, dt=share * probe.stable_dt, gravity=(0, 0, 0), level=level)
        rng = np.random.default_rng(0)
        start = 1e-7 * rng.standard_normal((sim.body.node_count, 3))
        sim.body.velocities = start * ~sim.body.constrained[:, None]
        try:
            sim.advance_steps(256)
        except wc.UnstableError:
            return np.inf
        return np.abs(sim.body.displacements.numpy()).max() / (1e-7 * sim.dt)

    assert growth(0.98) < 1e3
    assert growth(1.03) > 1e5


def one_by_one(sim, count):
    for _ in range(count):
        sim.advance_steps(1)


def test_a_step_beyond_stability_warns_and_stops_with_its_number(device):
    limit = bar(device, wc.StVenantKirchhoff()).stable_dt
    with pytest.warns(wc.StabilityWarning, match="beyond the largest stable"):
        sim = bar(device, wc.StVenantKirchhoff(), dt=3 * limit)
    with pytest.raises(wc.UnstableError, match=r"not finite since step (\d+)") as caught:
        sim.advance(1.0)
    step = int(str(caught.value).split("since step ")[1].split(" ")[0])
    with pytest.warns(wc.StabilityWarning):
        again = bar(device, wc.StVenantKirchhoff(), dt=3 * limit)
    sim.body.positions = sim.body.mesh.points
    sim.body.velocities = np.zeros((sim.body.node_count, 3))
    sim.advance_steps(1)  # a good state may continue
    # Energy from nowhere is detected long before that.
    with pytest.raises(wc.UnstableError, match="J of energy came from nowhere"):
        one_by_one(again, step)
    assert again.steps < step - 1
    assert np.isfinite(again.body.positions.numpy()).all()


def test_hooks_are_called_after_every_nth_step(device):
    sim = bar(device, dt=5e-4)
    seen, all_steps = [], []
    sim.on_step(lambda s: seen.append((s.steps, s.time)), every=10)
    sim.on_step(lambda s: all_steps.append(s.steps))
    sim.advance_steps(25)
    sim.step()
    sim.advance_steps(5)
    assert [steps for steps, _ in seen] == [10, 20, 30]
    assert seen[0][1] == pytest.approx(10 * 5e-4)
    assert all_steps == list(range(1, 32))


def test_steps_that_a_hook_makes_count(device):
    sim = bar(device, dt=5e-4)
    seen = []

    def also(s):
        seen.append(s.steps)
        if s.steps == 10:
            s.advance_steps(7)

    sim.on_step(also, every=5)
    sim.advance_steps(30)
    assert sim.steps == 30
    assert seen == [5, 10, 15, 20, 25, 30]


def test_a_hook_that_always_advances_is_refused():
    sim = bar("cpu", dt=5e-4)
    sim.on_step(lambda s: s.step())
    for _ in range(2):
        with pytest.raises(wc.InputError, match=r"the hook .*<lambda> advances the simulation, which calls it again"):
            sim.advance_steps(1)


def test_an_error_in_a_hook_leaves_a_state_to_go_on_from(device):
    sim, other = bar(device, dt=5e-4), bar(device, dt=5e-4)

    def fail(s):
        if s.steps == 7:
            raise ZeroDivisionError

    sim.on_step(fail, every=7)
    with pytest.raises(ZeroDivisionError):
        sim.advance_steps(20)
    assert sim.steps == 7
    sim.advance_steps(13)
    other.advance_steps(20)
    np.testing.assert_allclose(sim.body.positions.numpy(), other.body.positions.numpy(), atol=1e-6)


def test_a_hook_may_change_loads_and_constraints(device):
    sim = bar(device, dt=5e-4, gravity=(0, 0, 0), fixed=False)

    def push(s):
        s.body.load([0], [0, 0, 0.1 * s.steps])
        if s.steps == 8:
            s.body.fix([1])

    sim.on_step(push, every=4)
    sim.advance_steps(8)
    before = sim.body.displacements.numpy()
    sim.advance_steps(8)
    after = sim.body.displacements.numpy()
    assert (after[1] == before[1]).all()
    assert after[0, 2] > before[0, 2] > 0


def test_several_bodies_each_follow_their_own_model(device):
    models = [wc.Linear(), wc.Corotated(), wc.StVenantKirchhoff()]
    alone = [bar(device, model, dt=2e-4, damping=5.0) for model in models]
    for sim in alone:
        sim.advance(0.1)
    bodies = [bar(device).body for _ in models]
    together = wc.Simulation(bodies, model=models, integrator=alone[0].integrator, gravity=(0, -9.81, 0))
    together.advance(0.1)
    for sim, body in zip(alone, bodies, strict=True):
        np.testing.assert_allclose(body.positions.numpy(), sim.body.positions.numpy(), atol=1e-6)
    total = [sum(sim.energy()[k] for sim in alone) for k in range(3)]
    np.testing.assert_allclose(together.energy(), total, rtol=1e-4, atol=1e-7)


def test_advance_takes_the_nearest_whole_number_of_steps(device):
    sim = bar(device, dt=3e-4)
    sim.advance(1e-3)
    assert sim.steps == 3
    assert sim.time == pytest.approx(9e-4)
    sim.advance(0.0)
    assert sim.steps == 3


def test_default_gravity_is_down_the_up_axis(device):
    mesh = wc.TetForest.box(level=0, up_axis="Z")
    sim = wc.Simulation(wc.SoftBody(mesh, RUBBER, device=device))
    assert sim.gravity == (0.0, 0.0, -9.81)


BODY_MISTAKES = {
    "mask of the wrong length": (lambda b: b.fix(np.zeros(3, bool)), r"node mask has shape \(3,\)"),
    "index out of range": (lambda b: b.fix([10**6]), "node 1000000 is out of range"),
    "fractions for nodes": (lambda b: b.fix([0.5]), "must be a mask"),
    "NaN force": (lambda b: b.load([0], [np.nan, 0, 0]), "finite"),
    "force of the wrong shape": (lambda b: b.load([0], [1.0, 0]), "must be finite"),
    "both ways to prescribe": (lambda b: b.prescribe([0], velocity=(0, 0, 0), times=[0, 1]), "either velocity"),
    "no way to prescribe": (lambda b: b.prescribe([0]), "either velocity"),
    "times that do not increase": (
        lambda b: b.prescribe([0], times=[0, 0], displacements=np.zeros((2, 3))),
        "increasing",
    ),
    "keyframes of the wrong shape": (
        lambda b: b.prescribe([0], times=[0, 1], displacements=np.zeros((3, 3))),
        "displacements has shape",
    ),
    "positions of the wrong shape": (lambda b: setattr(b, "positions", np.zeros((2, 3))), "positions has shape"),
    "positions not finite": (lambda b: setattr(b, "positions", b.mesh.points * np.nan), "positions of node 0 are"),
    "velocities not finite": (
        lambda b: setattr(b, "velocities", np.where(np.arange(b.node_count)[:, None] == 3, np.inf, b.mesh.points)),
        r"velocities of node 3 are \[inf, inf, inf\]",
    ),
}


@pytest.mark.parametrize("mistake", BODY_MISTAKES)
def test_mistakes_with_a_body_are_named(mistake):
    act, message = BODY_MISTAKES[mistake]
    body = wc.SoftBody(wc.TetForest.box(level=1), RUBBER, device="cpu")
    with pytest.raises(wc.InputError, match=message):
        act(body)


SIMULATION_MISTAKES = {
    "nothing to simulate": (lambda b: wc.Simulation([]), "at least one body"),
    "one body twice": (lambda b: wc.Simulation([b, b]), "given twice"),
    "no body": (lambda b: wc.Simulation(b.mesh), "body is <TetForest of "),
    "a model's name": (lambda b: wc.Simulation(b, model="linear"), "model is 'linear'; it must be a model such as"),
    "a model's class": (lambda b: wc.Simulation(b, model=wc.Linear), "it must be a model such as"),
    "an integrator's class": (lambda b: wc.Simulation(b, integrator=wc.SymplecticEuler), "it must be an integrator"),
    "a word for gravity": (lambda b: wc.Simulation(b, gravity="down"), "gravity is 'down'"),
    "step beyond float32": (lambda b: wc.SymplecticEuler(dt=1e-60), "dt is 1e-60"),
    "half a step": (lambda b: wc.Simulation(b).advance_steps(0.5), "count is 0.5"),
    "a number of steps less than none": (lambda b: wc.Simulation(b).advance_steps(-1), "count is -1"),
    "a hook that cannot be called": (lambda b: wc.Simulation(b).on_step(None), "callback is None"),
    "hooks every so often": (lambda b: wc.Simulation(b).on_step(print, every="often"), "every is 'often'"),
    "all nodes held": (lambda b: (b.fix(np.ones(b.node_count, bool)), wc.Simulation(b)), "nodes of the body are held"),
    "too many models": (lambda b: wc.Simulation(b, model=[wc.Linear()] * 2), "2 models for 1 bodies"),
    "gravity of two numbers": (lambda b: wc.Simulation(b, gravity=(0, 1)), "three finite accelerations"),
    "negative step": (lambda b: wc.SymplecticEuler(dt=-1.0), "dt is -1.0"),
    "negative damping": (lambda b: wc.SymplecticEuler(damping=-1.0), "damping is -1.0"),
    "going back in time": (lambda b: wc.Simulation(b).advance(-1.0), "cannot advance"),
    "hooks every half step": (lambda b: wc.Simulation(b).on_step(print, every=0.5), "every is 0.5"),
    "rotation level below the roots": (lambda b: wc.Corotated(rotation_level=-1), "rotation_level is -1"),
    "unknown rotation": (lambda b: wc.Corotated(rotation="qr"), "'byers-xu' or 'svd'"),
    "one iteration": (lambda b: wc.Corotated(iterations=1), "iterations is 1"),
    "unknown springs": (lambda b: wc.EdgeStVK(springs="cubic"), "biquadratic"),
    "no such device": (lambda b: wc.SoftBody(b.mesh, RUBBER, device="cuda:77"), "no device 'cuda:77'"),
    "E beyond float32": (lambda b: wc.SoftBody(b.mesh, wc.Isotropic(1e60, 0.3, 1.0)), "stiffness .* float32"),
    "E = 0": (lambda b: wc.Isotropic(0.0, 0.3, 1.0), "young is 0"),
    "nu = 1/2": (lambda b: wc.Isotropic(1.0, 0.5, 1.0), "poisson is 0.5"),
    "nu = -1": (lambda b: wc.Isotropic(1.0, -1.0, 1.0), "poisson is -1"),
    "rho < 0": (lambda b: wc.Isotropic(1.0, 0.3, -5.0), "density is -5"),
    "NaN modulus": (lambda b: wc.Isotropic(np.nan, 0.3, 1.0), "young is nan"),
    "modulus of one element": (lambda b: wc.Isotropic([1.0, -2.0], 0.3, 1.0), "young of element 1 is -2"),
    "material array too short": (
        lambda b: wc.SoftBody(b.mesh, wc.Isotropic([1.0, 2.0], 0.3, 1.0), device="cpu"),
        "young has 2 entries",
    ),
}


@pytest.mark.parametrize("mistake", SIMULATION_MISTAKES)
def test_mistakes_with_a_simulation_are_named(mistake):
    act, message = SIMULATION_MISTAKES[mistake]
    body = wc.SoftBody(wc.TetForest.box(level=1), RUBBER, device="cpu")
    with pytest.raises(wc.InputError, match=message):
        act(body)


def test_tree_rotations_need_a_tree():
    forest = wc.TetForest.box(level=1)
    body = wc.SoftBody(wc.TetMesh(forest.points, forest.tets), RUBBER, device="cpu")
    with pytest.raises(wc.InputError, match="needs a forest"):
        wc.Simulation(body, model=wc.Corotated(rotation_level=1))
