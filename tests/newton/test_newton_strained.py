"""Soft bodies under load through Newton's solver with defaults: finite, and without energy from nowhere."""

import contextlib
import warnings

import loaded
import numpy as np
import pytest
import warp as wp
from newton_scenes import add_grid, builder, newton, stepped, wc, wn

FRAME = 1.0 / 60.0
GRAVITY = 9.81
SOFT = wc.Isotropic(young=3e3, poisson=0.4, density=1000.0)


def followed(model, frames, *, up=2, contact=True, limit=1.05):
    """Step frames from the model's state with defaults; kinetic and potential energy never exceed the initial ones.

    The energy of contacts and elements is not counted, so the sum is at most the initial energy. Symplectic Euler keeps
    a nearby energy that oscillates by a few per cent: 5 % of the potential energy of the fall.

    Returns:
        The solver, and the number of substeps of every frame.
    """
    solver = wn.SolverCorotated(model)
    pipeline = newton.CollisionPipeline(model, soft_contact_gap=0.05) if contact else None
    m = model.particle_mass.numpy().astype(float)
    floor = 0.0 if contact else lowest_point(model, up)
    counts, energies = [], [energy(model.state(), m, up, floor)]
    for now in stepped(solver, model, frames, FRAME, pipeline=pipeline):
        counts.append(solver.substeps_made)
        energies.append(energy(now, m, up, floor))
    assert np.isfinite(energies).all()
    assert max(energies) < limit * energies[0], int(np.argmax(energies))
    return solver, counts


def lowest_point(model, up):
    """The lowest possible place of a hanging body's end: as far below its support as it is long."""
    x = model.particle_q.numpy()
    return float(x[:, up].min() - np.linalg.norm(np.ptp(x, axis=0)))


def energy(state, m, up, floor):
    x, v = (array.numpy().astype(float) for array in (state.particle_q, state.particle_qd))
    return GRAVITY * (m @ (x[:, up] - floor)) + 0.5 * (m @ (v**2).sum(axis=1))


def falling_block(kind, device):
    """A block of 12 cm and 3 kPa, 10 cm above the ground."""
    made = builder(radius=0.002)
    made.add_ground_plane()
    if kind == "grid":
        add_grid(made, (6, 6, 6), 0.02, (0.0, 0.0, 0.1), SOFT.mu, SOFT.lam)
    else:
        forest = wc.TetForest.box((1, 1, 1), 0.12, 8, up_axis="Z")
        wn.add_forest(made, forest, SOFT, pos=(0.0, 0.0, 0.1), particle_radius=0.002)
    model = made.finalize(device=device)
    assert model.particle_q.numpy()[:, 2].min() == pytest.approx(0.1, abs=1e-6)
    return model


def leaning_capsule(kind, count, device):
    """A capsule of 112 mm and 5 kPa with its lowest tenth fixed."""
    mesh = loaded.SHAPES["capsule"][0](count)
    if kind == "general":
        mesh = wc.TetMesh(mesh.points, mesh.tets, up_axis=mesh.up_axis)
    heights = mesh.points[:, 1]
    made = builder(gravity=(0.0, -GRAVITY, 0.0))
    add = wn.add_mesh if kind == "general" else wn.add_forest
    material = wc.Isotropic(young=5e3, poisson=0.45, density=1000.0)
    add(made, mesh, material, fixed=heights < heights.min() + 0.1 * np.ptp(heights))
    return made.finalize(device=device)


@pytest.mark.parametrize("kind", ["grid", "forest"])
def test_a_soft_block_falls_on_the_ground(device, kind):
    _, counts = followed(falling_block(kind, device), 45)
    # It is squeezed to a fraction of its height and may stiffen then.
    assert max(counts) > counts[0]


@pytest.mark.parametrize("kind", ["general", "forest"])
def test_a_leaning_capsule_bends_over(device, kind):
    followed(leaning_capsule(kind, 1500, device), 30, up=1, contact=False)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["grid", "forest"])
def test_a_soft_block_falls_for_long(device, kind):
    followed(falling_block(kind, device), 120)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["general", "forest"])
def test_a_leaning_capsule_swings_for_long(device, kind):
    followed(leaning_capsule(kind, 5000, device), 120, up=1, contact=False)


class TestWhatWentWrong:
    """Failed steps: a body whose assumed substep is eight times as long as the stable one."""

    def solver(self, device):
        made = builder(gravity=(0.0, 0.0, 0.0))
        add_grid(made, (4, 2, 2), vel=(0.0, 0.0, 0.0))
        model = made.finalize(device=device)
        truth = wn.SolverCorotated(model)
        solver = wn.SolverCorotated(model, stable_dt=8.0 * truth.stable_dt)
        pushed = model.state()
        rng = np.random.default_rng(20130705)
        v = 0.1 * rng.standard_normal((model.particle_count, 3))
        pushed.particle_qd.assign(v.astype(np.float32))
        return model, solver, pushed, 64 * truth.stable_dt

    @pytest.mark.parametrize("in_place", [False, True])
    def test_is_said_and_later_steps_have_more_substeps(self, in_place):
        """On CPUs at once: the state stays, and the same step goes well as soon as its substeps are short enough."""
        model, solver, before, dt = self.solver("cpu")
        after = before if in_place else model.state()
        began = before.particle_q.numpy()
        start = energy(before, model.particle_mass.numpy(), 2, 0.0)
        with pytest.raises(wc.UnstableError, match="from now on steps have twice the substeps"):
            solver.step(before, after, None, None, dt)
        first = solver.substeps_made
        for _ in range(3):
            np.testing.assert_array_equal(before.particle_q.numpy(), began)
            with contextlib.suppress(wc.UnstableError):
                solver.step(before, after, None, None, dt)
                break
        assert solver.substeps_made >= max(2 * first, 64)
        assert energy(after, model.particle_mass.numpy(), 2, 0.0) < 2.0 * start

    def test_is_said_when_recorded(self, device):
        """A recorded step cannot change; the next recording has more substeps."""
        _, solver, before, dt = self.solver(device)
        with wp.ScopedCapture(device=device) as capture:
            solver.step(before, before, None, None, dt)
        first = solver.substeps_made
        kept = before.particle_q.numpy()
        for _ in range(20):
            wp.capture_launch(capture.graph)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with pytest.raises(wc.UnstableError, match="recorded again"):
                solver.check()
        assert np.isfinite(before.particle_q.numpy()).all()
        assert np.abs(before.particle_q.numpy() - kept).max() < 100.0
        with wp.ScopedCapture(device=device):
            solver.step(before, before, None, None, dt)
        # Twice as many, less what the recorded measurement gives back.
        assert solver.substeps_made > 1.8 * first

    def test_a_recorded_step_with_too_few_substeps(self, device):
        """Recorded at rest, it steps a body that is stretched to a thread.

        At stretches s, the stiffness against rotation about the long axis is (lambda tr(S - I) - 2 mu) / (s_2 + s_3),
        twice that at rest.
        """
        made = builder(gravity=(0.0, 0.0, 0.0))
        add_grid(made, (4, 2, 2))
        model = made.finalize(device=device)
        solver = wn.SolverCorotated(model)
        state, after = model.state(), model.state()
        dt = 10.0 * solver.stable_dt
        solver.step(state, after, None, None, dt)
        with wp.ScopedCapture(device=device) as capture:
            solver.step(state, after, None, None, dt)
        wp.capture_launch(capture.graph)
        solver.check()
        drawn = state.particle_q.numpy() * np.float32([6.0, 0.3, 0.2])
        for _ in range(4):
            state.particle_q.assign(drawn)
            wp.capture_launch(capture.graph)
        with pytest.warns(UserWarning, match="record it again"):
            solver.check()
        with wp.ScopedCapture(device=device):
            solver.step(state, after, None, None, dt)
        # More than a recording at rest adds, which is half as many again.
        assert solver.substeps_made > 1.1 * 1.5 * 10.0 / 0.9
