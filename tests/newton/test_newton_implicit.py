"""Implicit steps in Newton's scenes: the same states of rest as those of explicit ones and of static answers, contact,
bodies, worlds, and what is refused."""

import numpy as np
import pytest
import warp as wp
from newton_scenes import builder, newton, wc, wn
from scipy.spatial.transform import Rotation

DT = 1 / 60
TISSUE = wc.Isotropic(young=1e5, poisson=0.35, density=1000.0)


def stepped(model, count, *, dt=DT, gap=0.05, state=None, **options):
    """The solver, and the state after ``count`` steps in contact with what is there."""
    solver = wn.SolverCorotated(model, integrator="implicit", **options)
    pipeline = newton.CollisionPipeline(model, soft_contact_gap=gap) if model.shape_count else None
    contacts = None if pipeline is None else pipeline.contacts()
    state = model.state() if state is None else state
    for _ in range(count):
        state.clear_forces()
        if pipeline is not None:
            pipeline.collide(state, contacts)
        solver.step(state, state, None, contacts, dt)
    return solver, state, contacts


def block(to, *, z=0.0, radius=0.005, k_damp=20.0, **options):
    forest = wc.TetForest.box(cells=(2, 2, 1), cell_size=0.1, level=3, up_axis="Z")
    tissue = wc.Isotropic(young=3e4, poisson=0.4, density=1000.0)
    return wn.add_forest(to, forest, tissue, pos=(0, 0, z), k_damp=k_damp, particle_radius=radius, **options)


@pytest.mark.parametrize("kind", [pytest.param("mesh", marks=pytest.mark.slow), "forest"])
def test_a_beam_comes_to_rest_where_the_static_answer_is(device, kind):
    forest = wc.TetForest.box((3, 1, 1), 0.1, 3, up_axis="Z")
    mesh = forest if kind == "forest" else wc.TetMesh(forest.points, forest.tets, up_axis="Z")
    held = forest.points[:, 0] == 0
    body = wc.SoftBody(mesh, TISSUE, device=device)
    body.fix(held)
    report = wc.solve_static(body, model=wc.Corotated(dilatation="element"), gravity=(0.0, 0.0, -9.81))
    assert report.converged
    wanted = body.displacements.numpy()
    made = builder()
    (wn.add_forest if kind == "forest" else wn.add_mesh)(made, mesh, TISSUE, fixed=held)
    model = made.finalize(device=device)
    solver, state, _ = stepped(model, 30, dt=0.5)
    found = state.particle_q.numpy() - model.particle_q.numpy()
    assert np.abs(found - wanted).max() < 1e-3 * np.abs(wanted).max()
    assert solver.solves.steps == 30
    assert solver.solves.unfinished == 0


def test_steps_agree_with_short_explicit_ones(device):
    """The difference halves with the step."""
    forest = wc.TetForest.box((3, 1, 1), 0.1, 3, up_axis="Z")
    made = builder()
    wn.add_forest(made, forest, TISSUE, fixed=forest.points[:, 0] == 0, k_damp=50.0)
    model = made.finalize(device=device)
    solver, wanted = wn.SolverCorotated(model, substeps=400), model.state()
    for _ in range(6):
        wanted.clear_forces()
        solver.step(wanted, wanted, None, None, DT)
    ends = []
    for count in (8, 16, 32):
        _, state, _ = stepped(model, 6, substeps=count)
        ends.append(np.abs(state.particle_q.numpy() - wanted.particle_q.numpy()).max())
    assert ends[0] > 1.7 * ends[1] > 1.7**2 * ends[2] > 0.0


@pytest.mark.parametrize("kind", ["mesh", "forest"])
def test_bodies_that_turn_far_in_a_step_keep_their_size(device, kind):
    """Two cubes in one world that turn by 0.19 and -0.1 rad in a step, however viscous, and one that is held."""
    forest = wc.TetForest.box((1, 1, 1), 0.02, level=3, up_axis="Z")
    mesh = forest if kind == "forest" else wc.TetMesh(forest.points, forest.tets, up_axis="Z")
    made = builder(gravity=(0.0, 0.0, 0.0))
    held = [False, False, forest.points[:, 0] == 0]
    tissue = wc.Isotropic(young=1e6, poisson=0.4, density=1000.0)
    blocks = [
        (wn.add_forest if kind == "forest" else wn.add_mesh)(
            made, mesh, tissue, pos=(0, 0.1 * i, 0), k_damp=1000.0, **({} if i < 2 else {"fixed": held[i]})
        ).particles
        for i in range(3)
    ]
    model = made.finalize(device=device)
    state = model.state()
    q = state.particle_q.numpy()
    arms = [q[block] - q[block].mean(axis=0) for block in blocks]
    # They spin about the axis of their largest moment of inertia.
    weighted = model.particle_mass.numpy()[blocks[0], None] * arms[0]
    axis = np.linalg.eigh(weighted.T @ arms[0])[1][:, 0]
    v = np.zeros_like(q)
    for turn, block, arm in zip((0.19, -0.1), blocks, arms, strict=False):
        v[block] = np.cross(turn / 0.01 * axis, arm)
    state.particle_qd.assign(v)
    solver, state, _ = stepped(model, 10, dt=0.01, state=state)
    assert solver.solves.unfinished == 0
    after = state.particle_q.numpy()
    for turn, block, arm in zip((0.19, -0.1, 0.0), blocks, arms, strict=True):
        now = after[block] - after[block].mean(axis=0)
        # Centrifugal forces stretch them by some 1e-5.
        np.testing.assert_allclose(np.linalg.norm(now, axis=1), np.linalg.norm(arm, axis=1), atol=2e-4 * 0.02)
        if turn == 0.0:
            continue
        # Backward Euler of a rigid body: x1 x (x1 - 2 x0 + x-1) = 0 about its centre.
        angles = [np.arctan(turn)]
        for _ in range(9):
            angles.append(np.arctan(np.sin(angles[-1]) / (2.0 - np.cos(angles[-1]))))
        angle = np.sum(angles)
        wanted = Rotation.from_rotvec(angle * axis).apply(arm)
        np.testing.assert_allclose(now, wanted, atol=2e-3 * 0.02)


@pytest.mark.parametrize(("young", "poisson", "dt"), [(1e9, 0.49999, DT), (1.0, 0.3, DT), (3e4, 0.4, 1e3)])
def test_free_fall(device, young, poisson, dt):
    made = builder()
    forest = wc.TetForest.box(cells=(2, 2, 1), cell_size=0.1, level=0)
    wn.add_forest(made, forest, wc.Isotropic(young, poisson, 1000.0))
    model = made.finalize(device=device)
    _, state, _ = stepped(model, 5, dt=dt)
    assert state.particle_qd.numpy().mean(axis=0)[2] == pytest.approx(-9.81 * 5 * dt, rel=1e-2)


def test_a_block_rests_on_the_ground(device):
    made = builder()
    made.add_ground_plane()
    block(made, z=0.02)
    model = made.finalize(device=device)
    weight = 9.81 * model.particle_mass.numpy().sum()
    solver, state, contacts = stepped(model, 60)
    observables = solver.observables({"contact_f"}, contacts=contacts)
    solver.step(state, state, None, contacts, DT, observables=observables)
    force = -observables.contact_f.numpy()[:, :3].sum(axis=0)
    np.testing.assert_allclose(force, [0.0, 0.0, weight], atol=2e-3 * weight)
    assert np.abs(state.particle_qd.numpy()).max() < 1e-2
    assert solver.solves.unfinished == 0


def test_friction_holds_only_below_its_angle(device):
    """The ground's coefficient and the particles' are 0.5, and the slope's tangent is 0.4 or 0.7."""
    slid = []
    for slope in (0.4, 0.7):
        made = builder(gravity=(9.81 * slope, 0.0, -9.81))
        made.add_ground_plane(cfg=newton.ModelBuilder.ShapeConfig(mu=0.5, kf=1e4))
        block(made, z=0.005)
        model = made.finalize(device=device)
        model.soft_contact_mu, model.soft_contact_kf = 0.5, 1e4
        _, state, _ = stepped(model, 40)
        slid.append(state.particle_qd.numpy()[:, 0].mean())
    assert abs(slid[0]) < 0.02
    assert slid[1] == pytest.approx(9.81 * (0.7 - 0.5) * 40 * DT, rel=0.2)


def test_a_light_ball_rests_on_a_block(device):
    """Between four nodes, where it stays: a ball on a node rolls down from it, sooner or later by rounding."""
    made = builder()
    made.add_ground_plane()
    block(made, z=0.006)
    ball = made.add_body(xform=wp.transform((0.125, 0.125, 0.17), wp.quat_identity()))
    made.add_shape_sphere(ball, radius=0.06, cfg=newton.ModelBuilder.ShapeConfig(density=50.0))
    model = made.finalize(device=device)
    solver, state, _ = stepped(model, 45)
    weight = 9.81 * model.body_mass.numpy()[0]
    assert solver.body_reactions.numpy()[0, 2] == pytest.approx(weight, rel=0.05)
    assert np.abs(state.body_qd.numpy()[0, :3]).max() < 0.01
    np.testing.assert_allclose(state.body_q.numpy()[0, :2], 0.125, atol=1e-3)
    assert 0.14 < state.body_q.numpy()[0, 2] < 0.17


def test_attachments_hold_a_body(device):
    """A block hangs on a body that does not move, by springs that are far too stiff for explicit steps of 1/60 s."""
    made = builder()
    added = block(made, radius=0.0)
    body = made.add_body(xform=wp.transform((0.1, 0.1, 0.3), wp.quat_identity()), is_kinematic=True)
    q = np.array([made.particle_q[i] for i in added.particles])
    for i in np.flatnonzero(q[:, 2] > 0.099):
        point = tuple(q[i] - [0.1, 0.1, 0.3])
        made.add_attachment_particle_body(int(added.particles[i]), body, body_point=point, stiffness=1e5, damping=10.0)
    model = made.finalize(device=device)
    solver, state, _ = stepped(model, 60)
    weight = 9.81 * model.particle_mass.numpy().sum()
    assert solver.body_reactions.numpy()[0, 2] == pytest.approx(-weight, rel=1e-2)
    assert np.abs(state.particle_q.numpy()[:, 2] - q[:, 2]).max() < 0.02


def test_a_world_does_not_depend_on_others(device):
    one = builder()
    block(one, z=0.03)
    made = builder()
    made.replicate(one, 3)
    made.add_ground_plane()
    model = made.finalize(device=device)
    _, wanted, _ = stepped(model, 8)
    state = model.state()
    q = state.particle_q.numpy()
    q[0] = np.nan
    state.particle_q.assign(q)
    solver = wn.SolverCorotated(model, integrator="implicit")
    pipeline = newton.CollisionPipeline(model, soft_contact_gap=0.05)
    contacts = pipeline.contacts()

    def step():
        pipeline.collide(state, contacts)
        solver.step(state, state, None, contacts, DT)
        solver.check()

    for _ in range(8):
        with pytest.raises(wc.InputError, match="state_in is not finite in world 0"):
            step()
    found, per_world = state.particle_q.numpy(), len(q) // 3
    exact = {} if device == "cpu" else {"atol": 1e-5}
    np.testing.assert_allclose(found[per_world:], wanted.particle_q.numpy()[per_world:], rtol=0.0, **exact)


def test_unsupported_models_are_refused(device):
    made = builder()
    block(made)
    model = made.finalize(device=device)
    with pytest.raises(wc.InputError, match="integrator is 'midpoint'; it must be 'explicit' or 'implicit'"):
        wn.SolverCorotated(model, integrator="midpoint")
    with pytest.raises(wc.InputError, match="the number of a Newton model's particles is fixed"):
        wn.SolverCorotated(model, cuts=[wc.Blade([(0, 0, 0), (0, 0, 1)])])
    with pytest.raises(wc.InputError, match="self_contact_margin is given, and integrator is 'implicit'"):
        wn.SolverCorotated(model, integrator="implicit", self_contact_margin=0.01)
    with pytest.raises(wc.InputError, match="integrator='implicit' steps only tetrahedra"):
        wn.SolverCorotated(model, integrator="implicit", particle_contact=True)
    solver = wn.SolverCorotated(model, integrator="implicit")
    assert solver.safe_dt == solver.recorded_dt == float("inf")
