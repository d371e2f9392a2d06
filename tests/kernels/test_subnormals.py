"""Subnormal numbers are zero while the CPU steps and as before afterwards: the mode belongs to the thread."""

import numpy as np
import pytest
import warp as wp
from cases import MATERIAL

import warp_corot as wc
from warp_corot.solvers.recorded import FlushedSubnormals

SUBNORMAL = np.float32(1e-40)


def are_kept():
    """Whether this thread's arithmetic produces and accepts subnormal numbers."""
    given, made = np.array([SUBNORMAL]), np.array([np.finfo(np.float32).tiny])
    return bool((given * np.float32(2.0) > 0).all() and (made * np.float32(0.5) > 0).all())


@wp.kernel(enable_backward=False)
def halve(values: wp.array[wp.float32]):
    i = wp.tid()
    values[i] = 0.5 * values[i]


def simulation(**options):
    mesh = wc.TetForest.box((1, 1, 1), 0.064, 6)
    body = wc.SoftBody(mesh, wc.Isotropic(**MATERIAL), device="cpu")
    body.fix(mesh.points[:, 2] < 1e-9)
    return wc.Simulation(body, **options)


@pytest.mark.parametrize("recorded", [False, True])
def test_launches_inside_flush_and_those_outside_do_not(recorded):
    values = wp.array([SUBNORMAL], dtype=wp.float32, device="cpu")
    flushed = FlushedSubnormals(wp.get_device("cpu"))

    def launch():
        with flushed():
            wp.launch(halve, dim=1, inputs=[values], device="cpu")

    launch()  # compiled, so that a capture loads nothing
    assert values.numpy()[0] == 0
    values.fill_(SUBNORMAL)
    if recorded:
        with wp.ScopedCapture(device="cpu") as capture:
            launch()
        values.fill_(SUBNORMAL)
        wp.capture_launch(capture.graph)
    else:
        launch()
    assert values.numpy()[0] == 0
    assert are_kept()
    values.fill_(SUBNORMAL)
    wp.launch(halve, dim=1, inputs=[values], device="cpu")
    assert values.numpy()[0] > 0


def test_nested_ones_put_back_what_they_found():
    device = wp.get_device("cpu")
    outer, inner = FlushedSubnormals(device), FlushedSubnormals(device)
    with outer():
        with inner():
            pass
        assert not are_kept()
    assert are_kept()


def test_an_error_inside_puts_the_mode_back():
    with pytest.raises(KeyError), FlushedSubnormals(wp.get_device("cpu"))():
        raise KeyError
    assert are_kept()


def test_the_mode_is_restored_after_steps_hooks_and_errors():
    sim = simulation(gravity=(0.0, -9.8, 0.0))
    seen = []
    sim.on_step(lambda _: seen.append(are_kept()), every=3)
    sim.step()
    assert are_kept()
    sim.advance_steps(70)
    assert are_kept()
    assert len(seen) == 23
    assert all(seen)
    sim.bodies[0].velocities.fill_(np.inf)
    with pytest.raises(wc.UnstableError):
        sim.step()
    assert are_kept()
    with pytest.raises(wc.UnstableError):
        sim.advance_steps(70)
    assert are_kept()


def test_the_mode_is_restored_in_a_users_capture():
    sim = simulation(gravity=(0.0, 0.0, 0.0))
    sim.step()
    with wp.ScopedCapture(device="cpu") as capture:
        sim.step()
    assert are_kept()
    wp.capture_launch(capture.graph)
    assert are_kept()


def test_the_mode_is_restored_after_a_step_in_newton():
    newton_scenes = pytest.importorskip("newton_scenes")
    model = newton_scenes.grid_model("cpu")
    solver = newton_scenes.wn.SolverCorotated(model)
    before, after = model.state(), model.state()
    solver.step(before, after, None, None, 1e-4)
    assert are_kept()
    before.particle_f.fill_(wp.vec3(3e38, 0.0, 0.0))
    with pytest.raises(wc.UnstableError):
        solver.step(before, after, None, None, 1e-4)
    assert are_kept()
