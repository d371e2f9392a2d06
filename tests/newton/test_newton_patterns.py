"""The patterns of Newton's examples softbody_gift and softbody_franka with this solver in place of VBD."""

import numpy as np
import pytest
import warp as wp
from newton_scenes import add_grid, builder, contact_parameters, newton, stepped, wn


def gift(device, height=0.2, around=36, across=3):
    """Four soft blocks, two straps of cloth around them, and the ground, as in the example; straps are coarser."""
    example = pytest.importorskip("newton.examples.multiphysics.example_softbody_gift")
    made = newton.ModelBuilder()
    made.add_ground_plane()
    level = wp.quat_identity()
    for k in range(4):
        made.add_soft_mesh(
            pos=(0.0, 0.0, height + 1.01 * k), rot=level, scale=1.0, vel=(0.0, 0.0, 0.0),
            vertices=example.PYRAMID_PARTICLES, indices=example.PYRAMID_TET_INDICES.flatten().tolist(),
            density=100, k_mu=1.0e5, k_lambda=1.0e5, k_damp=1e0,
        )  # fmt: skip
    first = made.particle_count
    turned = wp.quat_from_axis_angle(wp.vec3(0.0, 0.0, 1.0), -np.pi / 2)
    for hx, hz, rot in ((1.01, 2.02, level), (1.015, 2.025, turned)):
        vertices, faces = example.cloth_loop_around_box(hx=hx, hz=hz, width=0.6, nu=around, nv=across)
        made.add_cloth_mesh(
            pos=(1.0, 1.0, height + 1.5 * 1.01 + 0.5), rot=rot, scale=1.0, vel=(0.0, 0.0, 0.0), vertices=vertices,
            indices=faces.flatten().tolist(), density=0.02, tri_ke=1e5, tri_ka=1e5, tri_kd=1e0, edge_ke=0.01,
            edge_kd=1e-4,
        )  # fmt: skip
    model = made.finalize(device=device)
    model.soft_contact_ke, model.soft_contact_kd, model.soft_contact_mu = 5e4, 0.5, 1.0
    return model, first


@pytest.mark.parametrize("frames", [5, pytest.param(15, marks=pytest.mark.slow)])
def test_a_gift_falls_and_stays_tied(frames, device):
    """Blocks stay stacked within their straps, and no more energy is there than the fall gave."""
    model, first = gift(device)
    solver = wn.SolverCorotated(model, self_contact_margin=0.04)
    pipeline = newton.CollisionPipeline(model)
    pipeline.init_soft_self_contact(margin=0.04, gap=0.02, topological_filter_threshold=1)
    mass = model.particle_mass.numpy().astype(float)
    start = model.particle_q.numpy().astype(float)
    falls = 0.0
    touching = {"pipeline": pipeline, "collides": {"soft_self_contact": True}}
    for state in stepped(solver, model, 10 * frames, 1.0 / 600.0, **touching):
        x, v = state.particle_q.numpy().astype(float), state.particle_qd.numpy().astype(float)
        lost = 9.81 * float(mass @ (start - x)[:, 2])
        kinetic = 0.5 * float(mass @ (v * v).sum(axis=1))
        assert kinetic < 1.05 * max(lost, 0.0) + 20.0
        falls = max(falls, lost)
    free = min(0.5 * 9.81 * (frames / 60.0) ** 2, 0.1)
    assert falls > 0.9 * 9.81 * free * mass.sum()
    assert np.linalg.norm(np.ptp(x, axis=0)) < 7.0
    assert x[:, 2].min() > -0.1
    heights = [x[18 * k : 18 * (k + 1), 2].mean() for k in range(4)]
    assert np.diff(heights) == pytest.approx(1.0, abs=0.1)
    # Each strap still goes around the lowest block and the highest.
    for strap in np.split(x[first:], 2):
        assert strap[:, 2].min() < x[:9, 2].mean() + 0.05
        assert strap[:, 2].max() > x[63:72, 2].mean() - 0.05


def gripper(device):
    """A soft cube on a table between two fingers of a lift, joined as those of a robot."""
    made = builder(radius=0.003)
    made.add_shape_box(-1, xform=wp.transform(wp.vec3(0.0, 0.0, 0.05), wp.quat_identity()), hx=0.3, hy=0.3, hz=0.05)
    light = newton.ModelBuilder.ShapeConfig(density=200.0)
    hand = made.add_link(xform=wp.transform(wp.vec3(0.0, 0.0, 0.3), wp.quat_identity()))
    made.add_shape_box(hand, hx=0.02, hy=0.02, hz=0.02, cfg=light)
    joints = [made.add_joint_prismatic(-1, hand, axis=(0.0, 0.0, 1.0), parent_xform=wp.transform((0.0, 0.0, 0.3)))]
    for side in (-1.0, 1.0):
        finger = made.add_link(xform=wp.transform(wp.vec3(0.06 * side, 0.0, 0.14), wp.quat_identity()))
        made.add_shape_box(finger, hx=0.01, hy=0.03, hz=0.03, cfg=light)
        at = wp.transform((0.06 * side, 0.0, -0.16))
        joints.append(made.add_joint_prismatic(hand, finger, axis=(-side, 0.0, 0.0), parent_xform=at))
    made.add_articulation(joints)
    add_grid(made, dims=(2, 2, 2), cell=0.04, pos=(-0.04, -0.04, 0.103), mu=3e4, lam=3e4, damp=200.0)
    model = made.finalize(device=device)
    contact_parameters(model, ke=5e4, kd=20.0, kf=1e4, mu=1.2)
    return model


@pytest.mark.slow
def test_a_gripper_lifts_a_soft_body(device):
    """Featherstone moves the joints without gravity and particles; reactions remain for the robot's controller."""
    model = gripper(device)
    robot = newton.solvers.SolverFeatherstone(model)
    soft = wn.SolverCorotated(model, rigid_solver=None)
    pipeline = newton.CollisionPipeline(model, soft_contact_gap=0.01)
    contacts, before, after = pipeline.contacts(), model.state(), model.state()
    observables = soft.observables({"contact_f"}, contacts=contacts)
    newton.eval_fk(model, model.joint_q, model.joint_qd, before)
    control, dt = model.control(), 1e-3
    weight = 9.81 * float(model.particle_mass.numpy().sum())
    gravity = model.gravity.numpy().copy()
    for k in range(1400):
        t = k * dt
        close, up = (0.06 if t < 0.3 else 0.0), (0.2 if 0.4 < t < 0.9 else 0.0)
        before.clear_forces()
        after.clear_forces()
        count, model.particle_count = model.particle_count, 0
        model.gravity.zero_()
        before.joint_qd.assign(np.array([up, close, close], np.float32))
        robot.step(before, after, control, None, dt)
        model.particle_count = count
        model.gravity.assign(gravity)
        before.particle_f.zero_()
        pipeline.collide(before, contacts)
        soft.step(before, after, control, contacts, dt, observables=observables)
        before, after = after, before
    soft.check()
    x = before.particle_q.numpy()
    assert x[:, 2].min() > 0.15
    assert np.abs(before.particle_qd.numpy()).max() < 0.1
    fingers = [model.shape_body.numpy().tolist().index(body) for body in (1, 2)]
    force = soft.shape_wrenches(contacts, observables).numpy()[fingers]
    assert force[:, 2].sum() == pytest.approx(-weight, rel=0.05)
    assert force[0, 0] < -weight / 4
    assert force[1, 0] > weight / 4
