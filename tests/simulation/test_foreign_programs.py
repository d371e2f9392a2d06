"""Steps inside another Warp program: in its capture, on its stream, between its launches."""

import numpy as np
import pytest
import warp as wp
from foreign import FORMS, allocates, bar, dawdle, read, three_of, vec3, vec3_among_others, vec4, write

import warp_corot as wc

STIFFNESS, RATE = 40.0, 3.0  # stiffness of the springs in the other program's kernel [N/m], and its sampling rate
AWAY = np.array([0.0, 0.02, 0.01])  # offset of the springs' goals from the nodes at rest [m]


@wp.kernel(enable_backward=False)
def pull(goals: wp.array[wp.vec3], positions: wp.array[wp.vec3], forces: wp.array[wp.vec3]):
    """The work before a step: a spring from each node to its goal."""
    i = wp.tid()
    forces[i] = STIFFNESS * (goals[i] - positions[i])


@wp.kernel(enable_backward=False)
def look(positions: wp.array[wp.vec3], seen: wp.array[wp.vec3]):
    """The work after a step: a running sum that depends on every step's positions."""
    i = wp.tid()
    seen[i] = 0.5 * seen[i] + RATE * positions[i]


class Stranger:
    """A program with its own arrays, and a body that it pulls and observes."""

    def __init__(self, sim, form=vec3_among_others):
        self.sim, self.device = sim, sim.device
        n, x = sim.body.node_count, np.tile(sim.body.mesh.points, (sim.worlds, 1))
        self.goals = wp.array(x + AWAY, dtype=wp.vec3, device=self.device)
        self.forces, self.positions = form(n, self.device), form(n, self.device)
        self.seen = vec3(n, self.device)
        sim.body.use_loads(self.forces)
        sim.body.use_positions(self.positions)
        # Views of these arrays, in any form, that the kernels above take.
        self.pulled, self.watched = (three_of(array) for array in (self.forces, self.positions))

    def before(self):
        n = self.sim.body.node_count
        wp.launch(pull, dim=n, inputs=[self.goals, self.watched, self.pulled], device=self.device)

    def after(self):
        n = self.sim.body.node_count
        wp.launch(look, dim=n, inputs=[self.watched, self.seen], device=self.device)

    def step(self):
        self.before()
        self.sim.step()
        self.after()


def by_hand(sim, steps):
    """The same program through the host, with only the body's own arrays; returns its observations."""
    x = sim.body.mesh.points
    goals = np.tile((x + AWAY).astype(np.float32), (sim.worlds, 1))
    seen = np.zeros_like(goals)
    for _ in range(steps):
        sim.body.loads.assign(np.float32(STIFFNESS) * (goals - sim.body.positions.numpy()))
        sim.step()
        seen = np.float32(0.5) * seen + np.float32(RATE) * sim.body.positions.numpy()
    return seen


def assert_as_by_hand(stranger, sim, steps):
    """Equal except for rounding: the kernels may round a product and a sum once, NumPy rounds twice."""
    seen = by_hand(sim, steps)
    assert np.abs(sim.body.displacements.numpy()).max() > 1e-5
    np.testing.assert_allclose(stranger.sim.body.displacements.numpy(), sim.body.displacements.numpy(), atol=2e-8)
    np.testing.assert_allclose(stranger.seen.numpy(), seen, atol=1e-6)


@pytest.mark.parametrize("worlds", [1, 3])
def test_several_steps_between_launches_in_one_capture(worlds, device):
    stranger = Stranger(bar(device, worlds=worlds))
    with wp.ScopedCapture(device=device) as capture:
        for _ in range(3):
            stranger.step()
    assert stranger.sim.steps == 0  # recorded, not run
    for _ in range(20):
        wp.capture_launch(capture.graph)
    assert stranger.sim.steps == 60
    assert_as_by_hand(stranger, bar(device, worlds=worlds), 60)


@pytest.mark.parametrize("model", [wc.Linear(), wc.Corotated(), wc.NeoHookean()], ids=repr)
def test_recorded_and_called_steps_are_the_same_bit_by_bit(model, device):
    called, recorded = Stranger(bar(device, model=model)), Stranger(bar(device, model=model))
    with wp.ScopedCapture(device=device) as capture:
        recorded.step()
    for _ in range(30):
        called.step()
        wp.capture_launch(capture.graph)
    assert np.abs(called.sim.body.displacements.numpy()).max() > 1e-4
    for name in ("displacements", "velocities", "reactions", "positions"):
        a, b = (getattr(each.sim.body, name).numpy() for each in (called, recorded))
        np.testing.assert_array_equal(a, b, err_msg=name)
    np.testing.assert_array_equal(called.seen.numpy(), recorded.seen.numpy())


def test_nothing_is_allocated_after_the_first_step(device):
    """By Warp on any device, or in the device's memory pool; not for newly used arrays either."""
    assert allocates(lambda: wp.zeros(5, device=device))  # it would be detected
    stranger = Stranger(bar(device))
    n = stranger.sim.body.node_count
    others = [form(n, device) for form in FORMS]
    for array in others:
        stranger.sim.body.use_positions(array)
        stranger.step()
    pooled = wp.get_device(device).is_mempool_supported
    used = wp.get_mempool_used_mem_current(device) if pooled else 0

    def work():
        for array in others:
            stranger.sim.body.use_loads(array)
            stranger.sim.body.use_positions(stranger.positions)
            stranger.sim.body.use_loads(stranger.forces)
            for _ in range(3):
                stranger.step()

    assert not allocates(work)
    with wp.ScopedCapture(device=device) as capture:
        stranger.step()
    assert not allocates(lambda: [wp.capture_launch(capture.graph) for _ in range(5)])
    if pooled:
        assert wp.get_mempool_used_mem_current(device) == used


def test_recording_allocates_nothing(device):
    stranger = Stranger(bar(device))
    stranger.step()

    def record():
        with wp.ScopedCapture(device=device):
            stranger.step()

    assert not allocates(record)


def test_steps_on_another_programs_stream(device):
    """A stream that waits for no other: work on another stream would come too early."""
    if not wp.get_device(device).is_cuda:
        pytest.skip("streams are for CUDA")
    stranger = Stranger(bar(device))
    done = wp.zeros(1, dtype=wp.float32, device=device)
    stream = wp.Stream(device)
    with wp.ScopedStream(stream):
        for _ in range(5):
            stranger.goals.fill_(wp.vec3(9.0, 9.0, 9.0))
            wp.launch(dawdle, dim=1, inputs=[200_000], outputs=[done], device=device)
            stranger.goals.assign(stranger.sim.body.mesh.points + AWAY)
            stranger.step()
        with wp.ScopedCapture(stream=stream) as capture:
            stranger.step()
        for _ in range(5):
            wp.capture_launch(capture.graph)
    wp.synchronize_stream(stream)
    assert stranger.sim.steps == 10
    assert_as_by_hand(stranger, bar(device), 10)


@pytest.mark.parametrize("form", [vec3, vec3_among_others, vec4], ids=lambda form: form.__name__)
@pytest.mark.parametrize("deterministic", [True, False])
def test_steps_do_not_wait_for_the_device(form, deterministic, device):
    """They return while long work that was queued before them is still running."""
    if not wp.get_device(device).is_cuda:
        pytest.skip("the CPU has no queue")
    sim = bar(device)
    if not deterministic:
        sim = wc.Simulation(sim.body, integrator=sim.integrator, gravity=(0, 0, 0))
    stranger = Stranger(sim, form)
    done = wp.zeros(1, dtype=wp.float32, device=device)
    another = form(sim.body.node_count, device)
    wp.launch(dawdle, dim=1, inputs=[1], outputs=[done], device=device)
    stranger.step()
    wp.synchronize_device(device)
    wp.launch(dawdle, dim=1, inputs=[30_000_000], outputs=[done], device=device)
    dawdled = wp.record_event(wp.Event(device))
    for _ in range(20):
        stranger.step()
    stranger.sim.body.use_loads(another)
    stranger.sim.body.use_loads(stranger.forces)
    stranger.sim.body.use_positions(None)
    stranger.sim.body.use_positions(stranger.positions)
    stranger.sim.step()
    assert not dawdled.is_complete
    assert stranger.sim.steps == 22


@pytest.mark.parametrize("form", FORMS, ids=lambda form: form.__name__)
def test_small_bodies_in_blocks_take_any_array(form, device, rng):
    """The same steps in one launch; compared bit for bit with the body's own arrays."""
    if not wp.get_device(device).is_cuda:
        pytest.skip("blocks are for CUDA")
    own, theirs = bar(device, level=3), bar(device, level=3)
    own, theirs = (wc.Simulation(sim.body, integrator=sim.integrator, gravity=(0, 0, 0)) for sim in (own, theirs))
    assert all(sim.recorded.in_blocks for sim in (own, theirs))
    loads = form(theirs.body.node_count, device)
    theirs.body.use_loads(loads)
    for _ in range(3):
        forces = rng.uniform(-0.05, 0.05, (own.body.node_count, 3)).astype(np.float32)
        write(loads, forces)
        own.body.loads.assign(forces)
        for sim in (own, theirs):
            sim.step()
            sim.advance_steps(100)
        np.testing.assert_array_equal(theirs.body.positions.numpy(), own.body.positions.numpy())
    assert np.abs(read(loads)).max() > 0
