"""Contact of soft bodies with far lighter rigid ones: they gain no energy and are carried."""

import numpy as np
import pytest
import warp as wp
from newton_scenes import add_grid, builder, contact_parameters, momentum, newton, run, semi_implicit, wn


def light_box(device, density):
    """A box of 1 dm, 2 cm above a soft block on the ground; 1 kg/m^3 are a gram."""
    made = builder(radius=0.005)
    body = made.add_body(xform=wp.transform(wp.vec3(0.1, 0.1, 0.28), wp.quat_identity()))
    made.add_shape_box(body, hx=0.05, hy=0.05, hz=0.05, cfg=newton.ModelBuilder.ShapeConfig(density=density))
    add_grid(made, dims=(4, 4, 4), cell=0.05, pos=(0.0, 0.0, 0.005), mu=1e5, lam=1e5, damp=10.0)
    made.add_ground_plane()
    return made.finalize(device=device)


class TestLightBodies:
    @pytest.mark.parametrize(
        ("density", "ke", "kd"),
        [
            *(pytest.param(5.0, *springs, marks=pytest.mark.slow) for springs in ((1e5, 1e3), (None, None))),
            (200.0, None, None),
        ],
    )
    def test_come_to_rest(self, device, density, ke, kd):
        """At half the safe step a box far lighter than the body below does not rise above its initial height.

        Only rocking remains: it stands on the highest particle, in the middle.
        """
        model = light_box(device, density)
        if ke is not None:
            contact_parameters(model, ke=ke, kd=kd, kf=1e3)
        solver = wn.SolverCorotated(model, damping=15.0)
        dt = 0.5 * solver.contact_dt
        heights, speeds = [], []

        def watch(state):
            heights.append(float(state.body_q.numpy()[0, 2]))
            speeds.append(float(np.abs(state.body_qd.numpy()[0, :3]).max()))

        state = run(solver, model, 2 * round(0.6 / dt), dt, pipeline=newton.CollisionPipeline(model), each=watch)
        assert max(heights) < 0.285
        assert max(speeds) < 1.0
        assert max(speeds[-round(0.1 / dt) :]) < 0.05
        assert 0.25 < heights[-1] < 0.26
        assert np.abs(state.body_q.numpy()[0, 3:5]).max() < 0.01

    def test_all_dampers_of_a_body_together_turn_no_velocity_round(self, device):
        """At any strength: 25 kinematic particles under a box without springs at most stop it, also its rotation."""
        made = builder(gravity=(0.0, 0.0, 0.0))
        body = made.add_body(xform=wp.transform(wp.vec3(0.0, 0.0, 0.05), wp.quat_identity()))
        made.add_shape_box(body, hx=0.05, hy=0.05, hz=0.05, cfg=newton.ModelBuilder.ShapeConfig(density=5.0))
        for x in np.linspace(-0.04, 0.04, 5):
            for y in np.linspace(-0.04, 0.04, 5):
                made.add_particle(wp.vec3(x, y, -0.0099), wp.vec3(), 0.0)
        add_grid(made, pos=(3.0, 0.0, 0.0))
        model = made.finalize(device=device)
        contact_parameters(model, ke=0.0, kd=1e6, kf=0.0, mu=0.0)
        pipeline = newton.CollisionPipeline(model)
        solver = wn.SolverCorotated(model)
        before, after = model.state(), model.state()
        before.body_qd.assign(np.array([[0.0, 0.0, -1.0, 0.0, 0.0, 0.0]], np.float32))
        contacts = pipeline.contacts()
        pipeline.collide(before, contacts)
        solver.step(before, after, None, contacts, 1e-4)
        assert contacts.soft_contact_count.numpy()[0] == 25
        twist = after.body_qd.numpy()[0]
        assert -0.9 < twist[2] < 1e-5
        energy = 0.5 * float(model.body_mass.numpy()[0]) * float(twist[:3] @ twist[:3])
        energy += 0.5 * float(twist[3:] @ model.body_inertia.numpy()[0] @ twist[3:])
        assert energy < 0.5 * float(model.body_mass.numpy()[0])

    def test_do_not_shorten_the_safe_step(self, device):
        """Nor do stiff contacts."""
        steps = []
        for density, ke in ((1.0, 1e7), (300.0, 1.0)):
            model = light_box(device, density)
            contact_parameters(model, ke=ke)
            solver = wn.SolverCorotated(model)
            steps += [solver.stable_dt, solver.contact_dt]
        assert steps == pytest.approx(4 * [steps[0]], rel=1e-6)


def thrown(device, shape="box", mass=0.05, aside=0.0, cell=0.05, height=0.002, speed=2.5, ground=False):
    """A light body of 1 dm flies down at a soft block of 2 dm; no gravity."""
    made = builder(gravity=(0.0, 0.0, 0.0), radius=0.005)
    add = {
        "box": (made.add_shape_box, {"hx": 0.05, "hy": 0.05, "hz": 0.05}, 1e-3),
        "sphere": (made.add_shape_sphere, {"radius": 0.05}, np.pi / 6 * 1e-3),
        "capsule": (made.add_shape_capsule, {"radius": 0.05, "half_height": 0.02}, np.pi * (1 / 6 + 0.1) * 1e-3),
    }
    add_shape, size, volume = add[shape]
    body = made.add_body(xform=wp.transform(wp.vec3(0.1 + aside, 0.1 + 0.7 * aside, 0.26 + height)))
    lying = wp.quat_rpy(0.0, np.pi / 2, 0.0) if shape == "capsule" else wp.quat_identity()
    config = newton.ModelBuilder.ShapeConfig(density=mass / volume)
    add_shape(body, **size, xform=wp.transform(wp.vec3(), lying), cfg=config)
    made.body_qd[body] = wp.spatial_vector(0.0, 0.0, -speed, 0.0, 0.0, 0.0)
    n = round(0.2 / cell)
    add_grid(made, dims=(n, n, n), cell=cell, pos=(0.0, 0.0, 0.005), mu=1e5, lam=1e5)
    return made.finalize(device=device)


def velocities(state):
    """Velocities of particles and of the body, float64."""
    return state.particle_qd.numpy().astype(float), state.body_qd.numpy()[0].astype(float)


def kinetic_energy(model, state, v, twist):
    """Kinetic energy of all and of the body [J]."""
    turn = np.array(wp.quat_to_matrix(wp.quat(*state.body_q.numpy()[0, 3:]))).reshape(3, 3)
    of_body = 0.5 * float(model.body_mass.numpy()[0]) * twist[:3] @ twist[:3]
    of_body += 0.5 * twist[3:] @ turn @ model.body_inertia.numpy()[0] @ turn.T @ twist[3:]
    return np.array([0.5 * model.particle_mass.numpy() @ (v * v).sum(axis=1) + of_body, of_body])


def throw(model, duration, dt=None, contacts=True):
    """Kinetic energies of all and of the body during a throw, relative to the initial total, and the last state.

    They use the mean of the velocities before and after a position: for an oscillator under symplectic Euler this
    never exceeds its energy; with either velocity alone it does.
    """
    solver = wn.SolverCorotated(model)
    dt = 0.7 * solver.contact_dt if dt is None else dt
    first = model.state()
    before, energies = velocities(first), []
    at_first = kinetic_energy(model, first, *before)[0]

    def watch(state):
        nonlocal before
        now = velocities(state)
        energies.append(kinetic_energy(model, state, *(0.5 * (a + b) for a, b in zip(before, now, strict=True))))
        before = now

    pipeline = newton.CollisionPipeline(model) if contacts else None
    state = run(solver, model, 2 * round(0.5 * duration / dt), dt, pipeline=pipeline, each=watch)
    return np.array(energies) / at_first, state


class TestEnergy:
    @pytest.mark.parametrize("ke", [pytest.param(1e4, marks=pytest.mark.slow), 1e6])
    @pytest.mark.parametrize(
        ("shape", "mass", "aside", "cell"),
        [
            ("box", 0.01, 0.0, 0.05),  # its edges are at particles
            pytest.param("box", 0.05, 0.013, 0.05, marks=pytest.mark.slow),
            pytest.param("box", 0.1, 0.0, 0.05, marks=pytest.mark.slow),
            ("box", 0.1, 0.0, 0.025),  # many contacts
            ("sphere", 0.01, 0.013, 0.05),
            ("capsule", 0.05, 0.0, 0.05),
        ],
    )
    def test_throws_gain_no_energy(self, device, shape, mass, aside, cell, ke):
        """Without dampers and friction: the kinetic energy never exceeds the initial one, and the body comes back."""
        model = thrown(device, shape, mass, aside, cell, height=0.0037)
        contact_parameters(model, ke=ke, kd=0.0, kf=0.0, mu=0.0)
        first = model.state()
        before = momentum(model, first)[0][2]
        ratios, state = throw(model, 0.03)
        assert ratios[:, 0].max() < 1.01
        assert ratios[:, 0].min() < 0.9
        assert 0.02 < ratios[-1, 1] < 1.0
        assert state.body_qd.numpy()[0, 2] > 0.3
        assert momentum(model, state)[0][2] == pytest.approx(before, rel=2e-3)

    @pytest.mark.parametrize(("ke", "kd", "mu"), [(1e4, 10.0, 0.0), (1e5, 1e5, 0.5)])
    def test_dampers_and_friction_take_more(self, device, ke, kd, mu):
        left = []
        for damping, friction in ((0.0, 0.0), (kd, mu)):
            model = thrown(device, mass=0.05, aside=0.013)
            contact_parameters(model, ke=ke, kd=damping, kf=1e3, mu=friction)
            ratios, _ = throw(model, 0.03)
            assert ratios[:, 0].max() < 1.01
            left.append(ratios[-1, 1])
        assert left[1] < 0.9 * left[0]

    def test_attached_bodies_swing_for_ever(self, device):
        """Ten grams on 25 springs, together nine times too stiff for them: energy oscillates and is conserved."""
        model = attached(device, mass=0.01, stiffness=1e4)
        ratios, _ = throw(model, 0.2, dt=1e-3, contacts=False)
        assert ratios[:, 0].max() < 1.01
        assert ratios[-100:, 0].max() > 0.3


def attached(device, mass, stiffness, gravity=0.0):
    """A box on springs to all particles of the top of a soft block."""
    made = builder(gravity=(0.0, 0.0, gravity), radius=0.005)
    body = made.add_body(xform=wp.transform(wp.vec3(0.1, 0.1, 0.26)))
    config = newton.ModelBuilder.ShapeConfig(density=mass / 1e-3, has_particle_collision=False)
    made.add_shape_box(body, hx=0.05, hy=0.05, hz=0.05, cfg=config)
    add_grid(made, dims=(4, 4, 4), cell=0.05, pos=(0.0, 0.0, 0.005), mu=1e5, lam=1e5)
    for i, x in enumerate(made.particle_q):
        if x[2] > 0.2:
            point = wp.vec3(x[0] - 0.1, x[1] - 0.1, x[2] - 0.26)
            made.add_attachment_particle_body(i, body, body_point=point, stiffness=stiffness, damping=0.0)
    made.body_qd[body] = wp.spatial_vector(0.0, 0.0, -1.0, 0.0, 0.0, 0.0)
    return made.finalize(device=device)


class TestGivingWay:
    def test_springs_act_where_the_body_gives_way_to_them(self, device):
        """Contacts push by k times what is left of their depth after both ends have moved by 1.5 dt^2 times the force
        over their masses, each a share of the particle's and the body's.
        """
        model = thrown(device, mass=0.05, aside=0.017, cell=0.025, height=-0.0031, speed=0.0)
        contact_parameters(model, ke=1e5, kd=0.0, kf=0.0, mu=0.0)
        pipeline, dt = newton.CollisionPipeline(model), 1e-3
        solver = wn.SolverCorotated(model, substeps=1)
        before, after = model.state(), model.state()
        pose = before.body_q.numpy()
        pose[0, 3:] = wp.quat_rpy(0.02, -0.01, 0.3)
        before.body_q.assign(pose)
        contacts = pipeline.contacts()
        pipeline.collide(before, contacts)
        solver.step(before, after, None, contacts, dt)
        got = model.particle_mass.numpy()[:, None].astype(float) * after.particle_qd.numpy() / dt
        turn = np.array(wp.quat_to_matrix(wp.quat(*pose[0, 3:]))).reshape(3, 3).astype(float)
        inverse = turn @ model.body_inv_inertia.numpy()[0] @ turn.T
        count = int(contacts.soft_contact_count.numpy()[0])
        particles = contacts.soft_contact_particle.numpy()[:count]
        normals = contacts.soft_contact_normal.numpy()[:count].astype(float)
        arms = contacts.soft_contact_body_pos.numpy()[:count].astype(float) @ turn.T
        x = before.particle_q.numpy()[particles].astype(float)
        gaps = np.einsum("ij,ij->i", normals, x - pose[0, :3] - arms) - 0.005
        levers = np.cross(arms, normals)
        w = float(model.body_inv_mass.numpy()[0]) + np.einsum("ij,jk,ik->i", levers, inverse, levers)
        w = count * w + np.bincount(particles)[particles] * model.particle_inv_mass.numpy()[particles]
        pushes = np.maximum(-gaps, 0.0) / (1e-5 + 1.5 * dt * dt * w)
        assert (gaps < 0.0).sum() > 5
        assert pushes.max() < 0.5 * 1e5 * -gaps.min()
        wanted = np.zeros_like(got)
        np.add.at(wanted, particles, pushes[:, None] * normals)
        np.testing.assert_allclose(got, wanted, atol=0.01 * np.abs(wanted).max())

    @pytest.mark.slow
    def test_bounces_as_high_as_in_newtons_solver(self, device):
        """A light box for which both solvers' steps are short enough: the height of its bounce."""
        heights = []
        for make in (lambda m: wn.SolverCorotated(m, lame="semi-implicit"), semi_implicit):
            model = thrown(device, mass=0.05, aside=0.013)
            contact_parameters(model, ke=1e4, kd=0.0, kf=0.0, mu=0.0)
            state = run(make(model), model, 1200, 5e-5, pipeline=newton.CollisionPipeline(model))
            heights.append(float(state.body_qd.numpy()[0, 2]))
        assert heights[0] == pytest.approx(heights[1], rel=0.05)
