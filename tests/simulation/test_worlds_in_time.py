"""Worlds in time: keyframes, resets, worlds that fail, checkpoints and recordings."""

import numpy as np
import pytest
import warp as wp
from cases import random_displacement
from pxr import Usd, UsdGeom
from worlds import CUBE, DT, MESHES, WORLDS, Scene, assert_same, beam, simulated, states

import warp_corot as wc
from warp_corot.io.write.animate import record

# --- keyframes -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("worlds", [1, 3])
@pytest.mark.parametrize("count", [1, 2, 3])
def test_keyframes_shared_by_all_nodes(count, worlds, device):
    """[K, 3], even if the number of nodes equals the number of vector components."""
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


def test_nodes_let_go_in_one_world_still_follow_in_the_others(device):
    body = beam(device)
    top = np.flatnonzero(body.mesh.points[:, 2] > CUBE - 1e-9)
    keys = np.zeros((2, len(top), 3))
    keys[1, :, 0] = np.linspace(0.001, 0.002, len(top))
    body.prescribe(top, times=[0.0, 0.01], displacements=keys)
    sim = simulated(body)
    sim.advance_steps(25)
    body.release(top, worlds=1)
    body.fix(top[:2], worlds=2)
    sim.advance_steps(50)
    moved = body.displacements.numpy().reshape(WORLDS, -1, 3)[:, top]
    np.testing.assert_allclose(moved[0], keys[1], atol=1e-8)
    np.testing.assert_allclose(moved[2, 2:], keys[1, 2:], atol=1e-8)
    np.testing.assert_allclose(moved[2, :2], 0.5 * keys[1, :2], atol=1e-8)
    assert (np.abs(moved[1] - keys[1]).max(axis=1) > 1e-5).all()
    np.testing.assert_array_equal(body.constrained.reshape(WORLDS, -1)[:, top].all(axis=1), [True, False, True])


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
        ("uniform", wc.Corotated(rotation_level=0)),
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
    """Without an initial state of its own, a world keeps the conditions of its nodes."""
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


def test_resets_are_recorded_with_the_steps(device):
    """A reset by an array on the device only launches kernels: a recording may choose worlds at each replay."""
    recorded, other = (simulated(beam(device)) for _ in range(2))
    chosen = wp.zeros(WORLDS, dtype=wp.int32, device=device)
    with wp.ScopedCapture(device=device) as capture:
        recorded.reset(chosen)
        recorded.step()
    for step in range(30):
        which = [step % WORLDS] if step % 4 == 3 else []
        mask = np.zeros(WORLDS, np.int32)
        mask[which] = 1
        chosen.assign(mask)
        wp.capture_launch(capture.graph)
        other.reset(which)
        other.step()
    assert recorded.steps == other.steps == 30
    assert_same(device, states(recorded.body), states(other.body))


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
    """Destructive velocities for the free nodes of a world."""
    n = body.world_node_count
    velocities = np.random.default_rng(0).normal(0, 1e4, (n, 3)) * ~body.constrained[:n, None]
    return velocities.astype(np.float32)


def test_an_unstable_world_is_named_and_leaves_the_others(device):
    """StVK inverts and diverges after a blow that is much too hard."""
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


def test_a_reset_before_the_check_forgets_an_unstable_world(device):
    """Recorded steps are not checked; a world that has been reset since does not stop the run."""
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


@pytest.mark.parametrize("model", [wc.Corotated(), wc.MassSpring()], ids=repr)
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


def test_one_world_is_recorded(device, tmp_path):
    young = np.array([[2e3], [5e3], [9e3]])
    sim = simulated([beam(device, young=young), beam(device)], [wc.Corotated(), wc.Linear()])
    with pytest.raises(wc.InputError, match=r"3 worlds; choose the one to draw, for example world=0"):
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
