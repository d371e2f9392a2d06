"""Soft contacts, attachments and rigid bodies: closed forms, exchange of momentum, and Newton's conventions."""

import numpy as np
import pytest
import warp as wp
from newton_scenes import (
    KE,
    add_grid,
    builder,
    contact_parameters,
    grid_model,
    model_without_particles,
    momentum,
    newton,
    run,
    semi_implicit,
    wc,
    wn,
)

KF, DT = 1e5, 4e-4


def on_ground(device, gravity=(0.0, 0.0, -9.81), mu=0.5, **options):
    made = builder(gravity=gravity)
    made.add_ground_plane()
    add_grid(made, dims=(2, 2, 2), pos=(0.0, 0.0, 0.0099), **options)
    model = made.finalize(device=device)
    contact_parameters(model, mu=mu)
    return model, newton.CollisionPipeline(model)


class TestGround:
    def test_carries_the_weight(self, device):
        """At rest the contact springs carry m g, as under Newton's own solver."""
        weights = []
        for make in (lambda m: wn.SolverCorotated(m, damping=20.0), semi_implicit):
            model, pipeline = on_ground(device, mu=0.3, damp=100.0)
            state = run(make(model), model, 6000, 5e-4, pipeline=pipeline)
            x, v = state.particle_q.numpy().astype(float), state.particle_qd.numpy()
            assert np.abs(v).max() < 5e-3
            depth = np.maximum(model.particle_radius.numpy() - x[:, 2], 0.0)
            weights.append(KE * depth.sum() / (9.81 * model.particle_mass.numpy().sum()))
        assert weights == pytest.approx([1.0, 1.0], abs=0.01)

    def slope(self, device, tangent, steps, **options):
        """A block under inclined gravity, with mu = 0.5: its velocities, and the positions of its lowest layer."""
        angle = np.arctan(tangent)
        g = 9.81 * np.array([np.sin(angle), 0.0, -np.cos(angle)])
        model, pipeline = on_ground(device, gravity=tuple(g), mu=0.5, **options)
        model.soft_contact_kf = KF
        model.shape_material_kf.fill_(KF)
        m, z = model.particle_mass.numpy(), model.particle_q.numpy()[:, 2]
        below = z < z.min() + 1e-3
        speeds, places = [], []

        def watch(state):
            speeds.append(float(m @ state.particle_qd.numpy()[:, 0]) / m.sum())
            places.append(float(state.particle_q.numpy()[below, 0].mean()))

        run(wn.SolverCorotated(model), model, steps, DT, pipeline=pipeline, each=watch)
        return speeds, places, float(m.sum()) * g, int(below.sum())

    def test_slides_where_friction_is_too_little(self, device):
        """The acceleration is g (sin - mu cos)."""
        speeds, _, weight, _ = self.slope(device, 0.8, 1500)
        mass = np.linalg.norm(weight) / 9.81
        assert (speeds[-1] - speeds[499]) / (1000 * DT) == pytest.approx((weight[0] + 0.5 * weight[2]) / mass, rel=0.05)

    def test_sticks_where_friction_is_enough(self, device):
        """Except for the law's slope, F / kf of each node, for nodes of any mass; once it has stopped swaying."""
        _, places, weight, nodes = self.slope(device, 0.3, 2500, damp=500.0)
        creep = (places[-1] - places[1749]) / (750 * DT)
        assert creep == pytest.approx(weight[0] / (nodes * KF), rel=0.2)

    def test_nothing_falls_through(self, device):
        model, pipeline = on_ground(device, vel=(0.0, 0.0, -3.0), damp=50.0)
        lowest = []
        run(
            wn.SolverCorotated(model),
            model,
            1200,
            2e-4,
            pipeline=pipeline,
            each=lambda s: lowest.append(float(s.particle_q.numpy()[:, 2].min())),
        )
        assert min(lowest) > -0.1
        assert lowest[-1] > 0.0


def with_box(device, velocity=(0.0, 0.0, 0.0), kinematic=False):
    """A soft body 5 mm into a free box below it, off its centre; no gravity."""
    made = builder(gravity=(0.0, 0.0, 0.0))
    body = made.add_body(xform=wp.transform(wp.vec3(0.0, 0.0, 0.5), wp.quat_rpy(0.0, 0.0, 0.4)), label="box")
    made.add_shape_box(body, hx=0.5, hy=0.5, hz=0.2)
    add_grid(made, dims=(2, 2, 2), pos=(0.1, 0.05, 0.705), vel=velocity)
    made.body_flags[body] = int(newton.BodyFlags.KINEMATIC if kinematic else newton.BodyFlags.DYNAMIC)
    model = made.finalize(device=device)
    contact_parameters(model, ke=5e3, kd=10.0, kf=50.0, mu=0.4)
    return model, newton.CollisionPipeline(model)


class TestBodies:
    @pytest.mark.parametrize("substeps", [1, 4])
    def test_momentum_is_exchanged(self, device, substeps):
        """Linear momentum to rounding; angular momentum to the first order of the body's integrator."""
        model, pipeline = with_box(device, velocity=(0.7, -0.4, -1.0))
        rigid = newton.solvers.SolverSemiImplicit(model_without_particles(model), angular_damping=0.0)
        solver = wn.SolverCorotated(model, rigid_solver=rigid, substeps=substeps)
        first = model.state()
        p, h = momentum(model, first)
        state = run(solver, model, 200, 5e-4, pipeline=pipeline)
        moved = np.linalg.norm(state.body_qd.numpy()[0, :3]) * float(model.body_mass.numpy()[0])
        assert moved > 1.0
        q, k = momentum(model, state)
        assert np.abs(q - p).max() < 1e-3 * moved
        assert np.abs(k - h).max() < 1e-2 * np.abs(h).max()

    def test_reactions_are_what_the_particles_get(self, device):
        model, pipeline = with_box(device, velocity=(0.5, 0.0, -0.5))
        solver = wn.SolverCorotated(model)
        before, after = model.state(), model.state()
        contacts = pipeline.contacts()
        pipeline.collide(before, contacts)
        without = model.state()
        solver.step(before, without, None, None, 1e-4)
        solver.step(before, after, None, contacts, 1e-4)
        m = model.particle_mass.numpy()[:, None].astype(float)
        got = m * (after.particle_qd.numpy().astype(float) - without.particle_qd.numpy()) / 1e-4
        wrench = solver.body_reactions.numpy()[0].astype(float)
        assert np.abs(got).sum() > 10.0
        np.testing.assert_allclose(wrench[:3], -got.sum(axis=0), atol=0.02 * np.abs(got).sum())
        # The box's centre of mass is at its origin. Contacts act on its surface, a particle's radius below at most.
        arms = before.particle_q.numpy() - before.body_q.numpy()[0, :3]
        torque = -np.cross(arms, got).sum(axis=0)
        np.testing.assert_allclose(wrench[3:], torque, atol=0.02 * np.abs(got).sum())

    def test_forces_of_the_state_stay_and_act(self, device):
        model, _ = with_box(device)
        solver = wn.SolverCorotated(model)
        before, after = model.state(), model.state()
        before.body_f.assign(np.array([[30.0, 0.0, 0.0, 0.0, 0.0, 0.0]], np.float32))
        forces = np.zeros((model.particle_count, 3), np.float32)
        forces[:, 1] = 2.0
        before.particle_f.assign(forces)
        solver.step(before, after, None, None, 1e-4)
        np.testing.assert_array_equal(before.particle_f.numpy(), forces)
        assert before.body_f.numpy()[0, 0] == 30.0
        speed = after.body_qd.numpy()[0, 0]
        assert speed == pytest.approx(30.0 * 1e-4 / float(model.body_mass.numpy()[0]), rel=1e-4)
        p = model.particle_mass.numpy() @ after.particle_qd.numpy()[:, 1]
        assert p == pytest.approx(2.0 * model.particle_count * 1e-4, rel=1e-3)

    def test_rigid_solver_none_leaves_bodies_alone(self, device):
        """With rigid_solver=None, reactions are left in state_in.body_f, and bodies do not move."""
        model, pipeline = with_box(device, velocity=(0.0, 0.0, -1.0))
        solver = wn.SolverCorotated(model, rigid_solver=None)
        before, after = model.state(), model.state()
        contacts = pipeline.contacts()
        pipeline.collide(before, contacts)
        after.body_q.zero_()
        solver.step(before, after, None, contacts, 1e-4)
        assert before.body_f.numpy()[0, 2] < -10.0
        np.testing.assert_array_equal(before.body_f.numpy(), solver.body_reactions.numpy())
        assert not after.body_q.numpy().any()

    def test_a_plate_moved_by_another_solver_throws_nothing(self, device):
        """It moves in each substep. If it jumped by the 0.05 mm of a step, particles of 0.7 g on springs of 2e6 N/m
        would leave at metres a second."""
        made = builder(gravity=(0.0, 0.0, 0.0), radius=0.005)
        add_grid(made, dims=(2, 2, 2), cell=0.018, mu=1e6, lam=1e6, damp=1.0)
        plate = made.add_body(xform=wp.transform(wp.vec3(-0.0101, 0.018, 0.018), wp.quat_identity()))
        made.add_shape_box(plate, hx=0.005, hy=0.05, hz=0.05)
        model = made.finalize(device=device)
        contact_parameters(model, ke=2e6, kd=0.2)
        solver, pipeline = wn.SolverCorotated(model, rigid_solver=None), newton.CollisionPipeline(model)
        contacts, now, after = pipeline.contacts(), model.state(), model.state()
        speed, dt, fastest = 0.03, 1.0 / 600.0, 0.0
        for step in range(30):
            pose = np.array([[-0.0101 + speed * dt * step, 0.018, 0.018, 0.0, 0.0, 0.0, 1.0]])
            now.body_q.assign(pose.astype(np.float32))
            now.body_qd.assign(np.array([[speed, 0.0, 0.0, 0.0, 0.0, 0.0]], np.float32))
            now.clear_forces()
            pipeline.collide(now, contacts)
            solver.step(now, after, None, contacts, dt)
            now, after = after, now
            fastest = max(fastest, float(np.abs(now.particle_qd.numpy()).max()))
        solver.check()
        assert speed < fastest < 5 * speed

    def test_kinematic_bodies_push(self, device):
        model, pipeline = with_box(device, kinematic=True)
        state = run(wn.SolverCorotated(model), model, 50, 5e-4, pipeline=pipeline)
        np.testing.assert_array_equal(state.body_q.numpy(), model.body_q.numpy())
        assert model.particle_mass.numpy() @ state.particle_qd.numpy()[:, 2] > 0.1


def test_attachments_hang(device):
    """A soft body hangs on four springs under a fixed body: its weight stretches them."""
    made = builder()
    body = made.add_body(xform=wp.transform(wp.vec3(0.0, 0.0, 2.0), wp.quat_identity()), mass=1.0)
    add_grid(made, dims=(1, 1, 1), pos=(-0.05, -0.05, 1.0))
    top = [i for i, x in enumerate(made.particle_q) if x[2] > 1.05]
    for i in top:
        x = made.particle_q[i]
        made.add_attachment_particle_body(
            i, body, body_point=wp.vec3(x[0], x[1], x[2] - 2.0), stiffness=4e3, damping=50.0
        )
    made.body_flags[body] = int(newton.BodyFlags.KINEMATIC)
    model = made.finalize(device=device)
    solver = wn.SolverCorotated(model, damping=5.0)
    state = run(solver, model, 4000, 5e-4)
    weight = 9.81 * model.particle_mass.numpy().sum()
    stretched = model.particle_q.numpy()[top, 2] - state.particle_q.numpy()[top, 2]
    assert 4e3 * stretched.sum() == pytest.approx(weight, rel=0.01)
    assert solver.body_reactions.numpy()[0, 2] == pytest.approx(-weight, rel=0.01)

    model.attachment_particle_body_enabled.fill_(False)
    falling = run(solver, model, 2, 5e-4)
    np.testing.assert_allclose(falling.particle_qd.numpy()[:, 2], -9.81 * 1e-3, rtol=5e-3)


def test_springs_and_triangles_act(device):
    """Elements other than tetrahedra behave as in SemiImplicit: they add the same pull."""
    speeds = []
    for make in (wn.SolverCorotated, semi_implicit):
        made = builder(gravity=(0.0, 0.0, 0.0))
        add_grid(made, dims=(1, 1, 1), tri_ke=100.0, tri_ka=100.0, tri_kd=1.0)
        made.add_spring(0, 7, ke=500.0, kd=1.0, control=0.0)
        made.spring_rest_length[-1] = 0.05
        made.add_particle(wp.vec3(0.0, 0.0, 1.0), wp.vec3(1.0, 0.0, 0.0), 0.0)
        model = made.finalize(device=device)
        before, after = model.state(), model.state()
        make(model).step(before, after, model.control(), None, 1e-4)
        assert not before.particle_f.numpy().any() or make is semi_implicit
        speeds.append(after.particle_qd.numpy())
    assert np.abs(speeds[1]).max() > 1e-3
    np.testing.assert_allclose(speeds[0], speeds[1], atol=1e-5)


def test_particle_contact_is_asked_for(device):
    model = grid_model(device, particle_radius=0.06)
    alone, touching = (
        run(wn.SolverCorotated(model, particle_contact=on), model, 2, 1e-4).particle_qd.numpy() for on in (False, True)
    )
    np.testing.assert_allclose(alone[:, 2], -2 * 9.81e-4, rtol=1e-3)
    assert np.abs(touching - alone).max() > 1e-3


def test_a_forest_on_a_box_on_the_ground_comes_to_rest(device):
    made = builder()
    made.add_ground_plane()
    body = made.add_body(xform=wp.transform(wp.vec3(0.0, 0.0, 0.201), wp.quat_identity()))
    made.add_shape_box(body, hx=0.4, hy=0.4, hz=0.2, cfg=newton.ModelBuilder.ShapeConfig(density=100.0))
    forest = wc.TetForest.box((1, 1, 1), 0.3, 3)
    wn.add_forest(made, forest, wc.Isotropic(1e5, 0.3, 500.0), pos=(-0.15, -0.15, 0.43), k_damp=100.0)
    model = made.finalize(device=device)
    contact_parameters(model, ke=5e4, kd=500.0, kf=100.0)
    pipeline = newton.CollisionPipeline(model)
    state = run(wn.SolverCorotated(model), model, 3000, 5e-4, pipeline=pipeline)
    x = state.particle_q.numpy()
    assert np.abs(state.particle_qd.numpy()).max() < 0.02
    assert x[:, 2].min() > 0.38
    assert 0.15 < state.body_q.numpy()[0, 2] < 0.201


def test_attachments_pull_both_ways(device):
    """A free body on springs to a free soft body: momentum is exchanged, as in a contact."""
    made = builder(gravity=(0.0, 0.0, 0.0))
    body = made.add_body(xform=wp.transform(wp.vec3(0.05, 0.05, 0.3), wp.quat_identity()))
    made.add_shape_sphere(body, radius=0.03)
    made.body_qd[body] = (0.3, 0.0, 1.0, 0.0, 0.0, 0.0)
    add_grid(made, dims=(1, 1, 1))
    for i in [i for i, x in enumerate(made.particle_q) if x[2] > 0.05]:
        x = made.particle_q[i]
        made.add_attachment_particle_body(
            i, body, body_point=wp.vec3(x[0] - 0.05, x[1] - 0.05, x[2] - 0.3), stiffness=2e3, damping=2.0
        )
    model = made.finalize(device=device)
    first = momentum(model, model.state())
    ball = float(model.body_mass.numpy()[0])
    rigid = newton.solvers.SolverSemiImplicit(model_without_particles(model), angular_damping=0.0)
    state = run(wn.SolverCorotated(model, rigid_solver=rigid), model, 300, 5e-4)
    last = momentum(model, state)
    assert ball * abs(float(state.body_qd.numpy()[0, 2]) - 1.0) > 0.2 * ball
    np.testing.assert_allclose(last[0], first[0], atol=1e-3 * ball)
    np.testing.assert_allclose(last[1], first[1], atol=1e-2 * 0.3 * ball)
