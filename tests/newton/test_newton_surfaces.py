"""Contact of edges and triangles of soft bodies with rigid shapes: where no node touches, forces and energy."""

import numpy as np
import pytest
import warp as wp
from newton_scenes import add_grid, builder, contact_parameters, momentum, newton, stepped, wc, wn

FULL = {"enable_rigid_soft_full_surface_contact": True}


def ball_mesh():
    """The sphere as a triangle mesh."""
    trimesh = pytest.importorskip("trimesh")
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.02)
    return newton.Mesh(np.asarray(ball.vertices, np.float32), np.asarray(ball.faces, np.int32).ravel())


#: Triangle meshes.
MESHES = {"box": lambda: newton.Mesh.create_box(0.02, 0.02, 0.02), "ball": ball_mesh}


def ball_on_block(
    device, shape="sphere", at=(0.067, 0.133), height=0.121, speed=0.0, gravity=-9.81, kd=20.0, held=True, **options
):
    """A small body above a triangle of a soft block that is held at its bottom."""
    made = builder(gravity=(0.0, 0.0, gravity), radius=0.001)
    add_grid(made, dims=(2, 2, 1), mu=1e5, lam=1e5, **options)
    if held:
        made.particle_mass[:] = [
            m if x[2] > 0.01 else 0.0 for m, x in zip(made.particle_mass, made.particle_q, strict=True)
        ]
    body = made.add_body(xform=wp.transform(wp.vec3(*at, height), wp.quat_identity()))
    made.body_qd[body] = (0.0, 0.0, speed, 0.0, 0.0, 0.0)
    config = newton.ModelBuilder.ShapeConfig(density=1000.0)
    if shape == "sphere":
        made.add_shape_sphere(body, radius=0.02, cfg=config)
    else:
        made.add_shape_mesh(body, mesh=MESHES[shape](), cfg=config)
    model = made.finalize(device=device)
    contact_parameters(model, ke=2e3, kd=kd, mu=0.0 if kd == 0.0 else 0.5)
    return model


def drop(model, steps, dt=5e-4, each=None, damping=0.0, **options):
    pipeline = newton.CollisionPipeline(model, **options)
    contacts = pipeline.contacts()
    solver = wn.SolverCorotated(model, damping=damping)
    observables = solver.observables({"contact_f"}, contacts=contacts)
    for state in stepped(solver, model, steps, dt, pipeline=pipeline, contacts=contacts, observables=observables):
        if each is not None:
            each(state)
    return state, contacts, observables


def weight_of(model):
    return 9.81 * float(model.body_mass.numpy()[0])


BALL = pytest.param("ball", marks=pytest.mark.slow)


@pytest.mark.parametrize("shape", ["sphere", pytest.param("box", marks=pytest.mark.slow), BALL])
def test_a_body_between_the_nodes_is_carried(device, shape):
    """It falls through without contacts of edges and triangles; with them, those reported carry its weight."""
    model = ball_on_block(device, shape, damp=100.0)
    state, contacts, observables = drop(model, 600, damping=20.0, **FULL)
    assert state.body_q.numpy()[0, 2] == pytest.approx(0.12, abs=0.002)
    first, count = contacts.rigid_contact_max, int(contacts.soft_contact_count.numpy()[0])
    wrenches = observables.contact_f.numpy()[first : first + count].astype(float)
    assert wrenches[:, 2].sum() == pytest.approx(weight_of(model), rel=0.01)
    assert (contacts.soft_contact_indices.numpy()[:count][wrenches[:, 2] > 0.0, 1] >= 0).all()
    sunk, _, _ = drop(model, 400)
    assert sunk.body_q.numpy()[0, 2] < 0.05


def test_momentum_is_exchanged(device):
    """What the ball gets, the block loses, also as a torque; to rounding and the first order of Newton's integrator."""
    model = ball_on_block(device, speed=-1.0, gravity=0.0, held=False)
    first = momentum(model, model.state())
    state, _, _ = drop(model, 60, dt=2e-4, **FULL)
    turned = momentum(model, state)
    ball = float(model.body_mass.numpy()[0])
    assert float(state.body_qd.numpy()[0, 2]) > -0.5
    np.testing.assert_allclose(turned[0], first[0], atol=1e-3 * ball)
    np.testing.assert_allclose(turned[1], first[1], atol=1e-2 * 0.1 * ball)


@pytest.mark.parametrize("shape", ["sphere", pytest.param("box", marks=pytest.mark.slow), BALL])
@pytest.mark.parametrize(
    "at", [(0.06, 0.13), *(pytest.param(at, marks=pytest.mark.slow) for at in ((0.05, 0.1), (0.07, 0.14)))]
)
def test_a_bounce_adds_no_energy(device, at, shape):
    """Without damping and friction, over a triangle, an edge, and off the middle."""
    model = ball_on_block(device, shape, at=at, speed=-1.0, gravity=0.0, kd=0.0)
    energies = []

    def watch(state):
        qd = state.body_qd.numpy()[0].astype(float)
        inertia = float(model.body_inertia.numpy()[0][0, 0])
        energies.append(0.5 * weight_of(model) / 9.81 * qd[:3] @ qd[:3] + 0.5 * inertia * qd[3:] @ qd[3:])

    state, _, _ = drop(model, 500, dt=2e-4, each=watch, **FULL)
    assert state.body_qd.numpy()[0, 2] > 0.1
    start = 0.5 * weight_of(model) / 9.81
    assert min(energies) < 0.5 * start
    assert energies[-1] < 1.001 * start


def test_the_ground_carries_a_block(device):
    """On flat ground contacts of edges and triangles repeat those of nodes, and count once: it rests as on nodes."""
    heights = []
    for options in ({}, FULL):
        made = builder()
        made.add_ground_plane()
        add_grid(made, dims=(2, 2, 2), pos=(0.0, 0.0, 0.0099), damp=100.0)
        model = made.finalize(device=device)
        contact_parameters(model, mu=0.3)
        state, contacts, observables = drop(model, 1500, damping=20.0, **options)
        rows = observables.contact_f.numpy()[contacts.rigid_contact_max :].astype(float)
        weight = 9.81 * float(model.particle_mass.numpy().sum())
        assert rows[:, 2].sum() == pytest.approx(-weight, rel=0.01)
        heights.append(state.particle_q.numpy()[:, 2])
    np.testing.assert_allclose(heights[1], heights[0], atol=1e-5)


def test_wrenches_of_a_shape_are_what_its_body_feels(device):
    """On a slope, with friction."""
    made = builder(gravity=(2.0, 0.0, -9.6))
    body = made.add_body(label="plate", is_kinematic=True)
    made.add_shape_box(body, hx=0.5, hy=0.5, hz=0.1, label="top")
    made.add_shape_box(body, hx=0.5, hy=0.5, hz=0.1, xform=wp.transform((0.0, 0.0, -0.3), wp.quat_identity()))
    add_grid(made, dims=(2, 2, 2), pos=(0.0, 0.0, 0.1099), damp=200.0)
    model = made.finalize(device=device)
    contact_parameters(model, mu=0.8, kf=1e5)
    state, contacts, observables = drop(model, 1000, damping=20.0, **FULL)
    mass = float(model.particle_mass.numpy().sum())
    solver = wn.SolverCorotated(model)
    found = solver.shape_wrenches(contacts, observables).numpy()
    wanted = observables.contact_f.numpy()[contacts.rigid_contact_max :].astype(float).sum(axis=0)
    np.testing.assert_allclose(found[0], wanted, atol=1e-3 * mass)
    np.testing.assert_allclose(found[0, :3], [2.0 * mass, 0.0, -9.6 * mass], atol=0.1 * mass)
    # The block's weight and the slope's pull, about the plate's centre of mass.
    x = state.particle_q.numpy() - state.body_q.numpy()[0, :3] - model.body_com.numpy()[0]
    centre = model.particle_mass.numpy() @ x / mass
    np.testing.assert_allclose(found[0, 3:], np.cross(centre, found[0, :3]), atol=0.1 * mass)
    assert not found[1].any()
    with pytest.raises(wc.InputError, match="no contact_f"):
        solver.shape_wrenches(contacts, None)


@pytest.mark.slow
def test_a_plate_of_triangles_carries_a_block(device):
    """The nodes of a flat face carry it, as without full-surface contacts; records across the plate do not push it
    sideways."""
    heights = []
    for options in ({}, FULL):
        made = builder()
        made.add_shape_mesh(-1, mesh=newton.Mesh.create_box(0.5, 0.5, 0.02), xform=wp.transform((0.1, 0.1, -0.02)))
        add_grid(made, dims=(2, 2, 1), pos=(0.0, 0.0, 0.0099), damp=100.0)
        model = made.finalize(device=device)
        contact_parameters(model, mu=0.0)
        state, contacts, observables = drop(model, 1000, damping=20.0, **options)
        rows = observables.contact_f.numpy()[contacts.rigid_contact_max :].astype(float)
        weight = 9.81 * float(model.particle_mass.numpy().sum())
        assert rows[:, 2].sum() == pytest.approx(-weight, rel=0.01)
        assert np.abs(rows[:, :2]).max() < 1e-6 * weight
        heights.append(state.particle_q.numpy()[:, 2])
    np.testing.assert_allclose(heights[1], heights[0], atol=1e-4)
