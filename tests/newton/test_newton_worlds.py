"""Many worlds of a Newton model: independent, reset separately, recorded in graphs."""

import warnings

import numpy as np
import pytest
import warp as wp
from foreign import dawdle
from newton_scenes import adaptive_forest, add_grid, builder, checked_step, newton, run, wc, wn

WORLDS = 64


def one_world():
    made = builder(gravity=(0.0, 0.0, -9.81))
    add_grid(made, dims=(2, 1, 1), fix_left=True)
    wn.add_forest(made, adaptive_forest(1, 0.2), wc.Isotropic(2e4, 0.3, 500.0), pos=(0.0, 0.5, 0.22), k_damp=5.0)
    body = made.add_body(xform=wp.transform(wp.vec3(0.1, 0.6, 0.101), wp.quat_identity()))
    made.add_shape_box(body, hx=0.3, hy=0.3, hz=0.1, cfg=newton.ModelBuilder.ShapeConfig(density=100.0))
    return made


def worlds(count, device, attributes=False):
    part = one_world()
    if attributes:
        wn.register_custom_attributes(part)
    made = builder()
    made.add_ground_plane()
    made.replicate(part, count)
    return made.finalize(device=device)


def by_world(array, count):
    return array.numpy().reshape(count, -1, array.numpy().shape[-1])


def test_worlds_are_independent(device):
    """Each moves as it would alone: with its own gravity, activation and velocities, one with invalid values."""
    model = worlds(WORLDS, device)
    solver = wn.SolverCorotated(model)
    assert [group.copies for group in solver.tetrahedra.groups] == [WORLDS]
    gravity = model.gravity.numpy().copy()
    gravity[:WORLDS, 0] = np.linspace(-3.0, 3.0, WORLDS)
    model.gravity.assign(gravity)
    activation = np.repeat(np.linspace(0.0, 0.2, WORLDS), model.tet_count // WORLDS).astype(np.float32)
    model.tet_activations.assign(activation)
    velocity = model.particle_qd.numpy().reshape(WORLDS, -1, 3)
    velocity[7] = np.nan
    model.particle_qd.assign(velocity.reshape(-1, 3))
    pipeline = newton.CollisionPipeline(model)
    now, after = model.state(), model.state()
    contacts = pipeline.contacts()
    told = []
    for _ in range(10):
        pipeline.collide(now, contacts)
        try:
            solver.step(now, after, None, contacts, 5e-4)
            solver.check()
        except wc.InputError as error:
            told.append(str(error))
        now, after = after, now
    assert told
    assert all("in world 7" in line for line in told)
    x, q = by_world(now.particle_q, WORLDS), by_world(now.body_q, WORLDS)
    np.testing.assert_array_equal(x[7], by_world(model.particle_q, WORLDS)[7])
    for world in (0, 6, 8, 50):
        single = worlds(1, device)
        single.gravity.assign(gravity[[world] * len(single.gravity)])
        single.tet_activations.fill_(float(activation[world * single.tet_count]))
        alone = run(wn.SolverCorotated(single), single, 10, 5e-4, pipeline=newton.CollisionPipeline(single))
        np.testing.assert_allclose(x[world], alone.particle_q.numpy(), atol=1e-6)
        np.testing.assert_allclose(q[world], alone.body_q.numpy(), atol=1e-6)
    assert np.ptp(x[[0, 20, 40, 63]], axis=0).max() > 1e-5


def test_one_world_is_reset_alone(device):
    model = worlds(8, device, attributes=True)
    solver = wn.SolverCorotated(model)
    pipeline = newton.CollisionPipeline(model)
    moved = run(solver, model, 50, 5e-4, pipeline=pipeline)
    before = {name: getattr(moved, name).numpy().copy() for name in ("particle_q", "particle_qd", "body_q", "body_qd")}
    rotations = by_world(moved.warp_corot.rotation, 8).copy()
    mask = np.zeros(9, bool)
    mask[3] = True
    solver.reset(moved, wp.array(mask, dtype=wp.bool, device=device))
    for name, values in before.items():
        now, then = getattr(moved, name).numpy(), values
        initial = getattr(model, name).numpy().reshape(8, -1)
        now, then = now.reshape(8, -1), then.reshape(8, -1)
        np.testing.assert_array_equal(now[3], initial[3])
        np.testing.assert_array_equal(np.delete(now, 3, axis=0), np.delete(then, 3, axis=0))
        assert np.abs(then[3] - initial[3]).max() > 0
    q = by_world(moved.warp_corot.rotation, 8)
    np.testing.assert_allclose(q[3], np.broadcast_to([0, 0, 0, 1], q[3].shape), atol=1e-6)
    np.testing.assert_array_equal(q[2], rotations[2])
    assert np.abs(rotations[3] - q[3]).max() > 0

    after = model.state()
    kept = by_world(moved.particle_q, 8).copy()
    solver.reset(after, wp.array(mask, dtype=wp.bool, device=device), newton.StateFlags.PARTICLE_QD)
    with pytest.raises(wc.InputError, match="world_mask is"):
        solver.reset(after, wp.zeros(8, dtype=wp.bool, device=device))
    np.testing.assert_array_equal(by_world(moved.particle_q, 8), kept)


def test_recorded_steps_are_the_same(device):
    """Captured and replayed, nothing is allocated, and the result equals single steps, bit for bit on CPUs."""
    model = worlds(2, device)
    pipeline = newton.CollisionPipeline(model)
    ends = []
    for each in (None, lambda state: None):
        state = run(wn.SolverCorotated(model), model, 40, 5e-4, pipeline=pipeline, each=each)
        ends.append(np.concatenate([state.particle_q.numpy().ravel(), state.body_q.numpy().ravel()]))
    np.testing.assert_allclose(*ends, atol=0.0 if model.device.is_cpu else 1e-5)
    assert np.abs(ends[0][: 3 * model.particle_count] - model.particle_q.numpy().ravel()).max() > 1e-4


def test_a_replayed_step_says_what_was_wrong(device):
    model = worlds(2, device)
    solver = wn.SolverCorotated(model)
    before, after = model.state(), model.state()
    solver.step(before, after, None, None, 1e-4)
    with wp.ScopedCapture(device=device) as capture:
        solver.step(before, after, None, None, 1e-4)
    wp.capture_launch(capture.graph)
    solver.check()
    before.particle_q.fill_(wp.vec3(np.nan))
    good = after.particle_q.numpy()
    wp.capture_launch(capture.graph)
    np.testing.assert_array_equal(after.particle_q.numpy(), good)
    with pytest.raises(wc.InputError, match="state_in is not finite"):
        solver.check()
    solver.check()


@pytest.mark.parametrize(
    ("steps", "copied", "stuck"), [(1, False, True), (3, False, True), (2, False, False), (1, True, False)]
)
def test_a_recording_that_does_not_go_on_is_said_once(device, steps, copied, stuck):
    """A graph with an odd number of swaps reads the same state again, unless the result is copied back."""
    model = worlds(1, device)
    solver = wn.SolverCorotated(model)
    states = [model.state(), model.state()]
    solver.step(states[0], states[0], None, None, 1e-4)
    with wp.ScopedCapture(device=device) as capture:
        for number in range(steps):
            solver.step(states[number % 2], states[1 - number % 2], None, None, 1e-4)
        if copied:
            states[0].assign(states[1])
    heights = []
    for _ in range(2):
        wp.capture_launch(capture.graph)
        heights.append(states[steps % 2].particle_q.numpy()[:, 2].mean())
    assert (heights[0] == heights[1]) == (stuck and steps == 1)  # else a replay repeats the last step of the one before
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        solver.check()
        solver.check()
    assert len([each for each in said if "nothing copies it back" in str(each.message)]) == stuck


@pytest.mark.parametrize("recorded", [False, True])
@pytest.mark.parametrize("in_place", [False, True])
def test_substeps_are_taken_all_or_none(device, in_place, recorded):
    """A failure in the second of three substeps has moved things by then; its world, bodies too, is restored."""
    model = worlds(2, device)
    solver = wn.SolverCorotated(model, substeps=3)
    before, dt = model.state(), 3e-4
    after = before if in_place else model.state()
    solver.step(before, after, None, None, dt)
    pushed = np.zeros((2, model.particle_count // 2, 3), np.float32)
    pushed[1, :, 0] = model.particle_mass.numpy().reshape(2, -1)[1] * 6e4 / (dt / 3)
    before.particle_f.assign(pushed.reshape(-1, 3))
    names = ("particle_q", "particle_qd", "body_q", "body_qd")
    began = [by_world(getattr(before, name), 2).copy() for name in names]
    if recorded:
        with wp.ScopedCapture(device=device) as capture:
            solver.step(before, after, None, None, dt)
        wp.capture_launch(capture.graph)
        with pytest.raises(wc.UnstableError, match="world 1"):
            solver.check()
    else:
        with pytest.raises(wc.UnstableError, match="world 1"):
            checked_step(solver, before, after, dt=dt)
    for name, had in zip(names, began, strict=True):
        has = by_world(getattr(after, name), 2)
        np.testing.assert_array_equal(has[1], had[1])
        assert np.abs(has[0] - had[0]).max() > 0


def with_everything(device, substeps=1):
    """A solver with forests, general tetrahedra, contact, attachments and attributes, and the arguments of a step."""
    made = builder()
    made.add_ground_plane()
    wn.register_custom_attributes(made)
    add_grid(made, dims=(2, 1, 1), damp=5.0)
    wn.add_forest(made, adaptive_forest(2, 0.2), wc.Isotropic(2e4, 0.3, 500.0), pos=(0.0, 0.5, 0.0))
    body = made.add_link(mass=1.0, inertia=wp.mat33(np.eye(3)))
    made.add_attachment_particle_body(0, body, stiffness=100.0)
    model = made.finalize(device=device)
    pipeline = newton.CollisionPipeline(model)
    before, contacts = model.state(), pipeline.contacts()
    pipeline.collide(before, contacts)
    return wn.SolverCorotated(model, substeps=substeps), (before, model.state(), model.control(), contacts, 1e-4)


def test_nothing_is_allocated_after_the_first_step(device, monkeypatch):
    solver, arguments = with_everything(device, substeps=2)
    solver.step(*arguments)
    solver.reset(arguments[1])
    asked = []
    for allocator in {wp.get_device_allocator(device), wp.get_device_allocator("cpu")}:
        allocate = allocator.allocate
        monkeypatch.setattr(
            allocator, "allocate", lambda size, allocate=allocate: asked.append(size) or allocate(size), raising=True
        )
    wp.zeros(1, device=device)
    assert len(asked) == 1
    for _ in range(3):
        solver.step(*arguments)
        solver.reset(arguments[1])
    assert len(asked) == 1


def test_steps_do_not_wait_for_the_device(device):
    """They return while long work that was queued before them is still running."""
    if not wp.get_device(device).is_cuda:
        pytest.skip("the CPU has no queue")
    solver, arguments = with_everything(device, substeps=2)
    done = wp.zeros(1, dtype=wp.float32, device=device)
    wp.launch(dawdle, dim=1, inputs=[1], outputs=[done], device=device)
    solver.step(*arguments)
    solver.reset(arguments[1])
    wp.synchronize_device(device)
    wp.launch(dawdle, dim=1, inputs=[30_000_000], outputs=[done], device=device)
    dawdled = wp.record_event(wp.Event(device))
    # A thousand launches are CUDA's queue limit: those of more steps would wait.
    for _ in range(4):
        solver.step(*arguments)
        solver.reset(arguments[1])
    assert not dawdled.is_complete
    solver.check()
    assert dawdled.is_complete


def test_steps_on_another_programs_stream(device):
    """A stream that waits for no other: work on another stream would come too early."""
    if not wp.get_device(device).is_cuda:
        pytest.skip("streams are for CUDA")
    ends = []
    for stream in (wp.get_stream(device), wp.Stream(device)):
        solver, arguments = with_everything(device)
        before, after, *_ = arguments
        wp.synchronize_device(device)
        rest, x = wp.clone(before.particle_q), before.particle_q
        done = wp.zeros(1, dtype=wp.float32, device=device)
        wp.launch(dawdle, dim=1, inputs=[1], outputs=[done], device=device)
        wp.synchronize_device(device)
        with wp.ScopedStream(stream, sync_enter=False):
            for _ in range(5):
                x.fill_(wp.vec3(np.nan))
                wp.launch(dawdle, dim=1, inputs=[200_000], outputs=[done], device=device)
                wp.copy(x, rest)
                solver.step(*arguments)
                wp.copy(rest, after.particle_q)
                wp.copy(before.particle_qd, after.particle_qd)
            with wp.ScopedCapture(stream=stream) as capture:
                solver.step(*arguments)
            wp.capture_launch(capture.graph)
        wp.synchronize_stream(stream)
        solver.check()
        ends.append(after.particle_qd.numpy())
    assert np.abs(ends[0]).max() > 1e-4
    np.testing.assert_allclose(ends[1], ends[0], rtol=1e-4, atol=1e-6)
