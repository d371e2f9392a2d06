"""Soft bodies and cloth that touch one another: weight, momentum, energy, and what is refused."""

import numpy as np
import pytest
import warp as wp
from newton_scenes import add_grid, builder, checked_step, contact_parameters, impulse, newton, stepped, wc, wn

MARGIN = 0.01


def hold_below(made, height):
    made.particle_mass[:] = [
        0.0 if x[2] < height else m for m, x in zip(made.particle_mass, made.particle_q, strict=True)
    ]


def cube_on_slab(device, apart=0.009, gravity=-9.81, speed=0.0, kd=20.0, damp=100.0):
    """A small cube above the middle of a slab that is held at its bottom, with nodes of one over faces of the other."""
    made = builder(gravity=(0.0, 0.0, gravity), radius=0.005)
    add_grid(made, dims=(3, 3, 1), mu=1e5, lam=1e5, damp=damp)
    hold_below(made, 0.01)
    first = made.particle_count
    add_grid(made, dims=(1, 1, 1), cell=0.08, pos=(0.113, 0.122, 0.1 + apart), vel=(0.0, 0.0, speed), damp=damp)
    model = made.finalize(device=device)
    contact_parameters(model, kd=kd, mu=0.0 if kd == 0.0 else 0.5)
    return model, first


def run_pairs(model, steps, dt=5e-4, margin=MARGIN, each=None, state=None, **options):
    pipeline = newton.CollisionPipeline(model)
    pipeline.init_soft_self_contact(margin=MARGIN, gap=MARGIN)
    contacts = pipeline.contacts()
    solver = wn.SolverCorotated(model, self_contact_margin=margin, **options)
    where = {"pipeline": pipeline, "contacts": contacts, "state": state, "collides": {"soft_self_contact": True}}
    for last in stepped(solver, model, steps, dt, **where):
        if each is not None:
            each(last)
    return last, pipeline, contacts, solver


def height_of(state, first):
    return float(state.particle_q.numpy()[first:, 2].min())


def test_a_soft_body_carries_another(device):
    """At rest, the forces between them are the cube's weight, up on it and down on the slab."""
    model, first = cube_on_slab(device)
    state, _, contacts, solver = run_pairs(model, 1000, damping=20.0)
    assert 0.095 < height_of(state, first) < 0.109
    q, qd = state.particle_q.numpy(), state.particle_qd.numpy()
    assert np.abs(qd).max() < 5e-3
    alone = wn.SolverCorotated(model, damping=20.0)
    forces = impulse(solver, model, q, qd, contacts=contacts, dt=5e-4) - impulse(alone, model, q, qd, dt=5e-4)
    weight = 9.81 * float(model.particle_mass.numpy()[first:].sum())
    assert forces[first:, 2].sum() == pytest.approx(weight, rel=0.01)
    assert forces[:first, 2].sum() == pytest.approx(-weight, rel=0.02)


def test_without_a_margin_they_pass_through(device):
    model, first = cube_on_slab(device)
    *_, state = stepped(wn.SolverCorotated(model), model, 400, 5e-4)
    assert height_of(state, first) < 0.05


def test_momentum_is_exchanged_and_no_energy_is_added(device):
    """A bounce of two free bodies without damping and friction."""
    model, first = cube_on_slab(device, apart=0.012, gravity=0.0, speed=-1.0, kd=0.0, damp=0.0)
    mass = np.where(model.particle_mass.numpy() > 0, model.particle_mass.numpy(), 1.0).astype(np.float32)
    model.particle_mass.assign(mass)
    model.particle_inv_mass.assign(1.0 / mass)
    start = model.state().particle_qd.numpy().astype(float)
    state, *_ = run_pairs(model, 500, dt=2e-4)
    end = state.particle_qd.numpy().astype(float)
    assert mass[first:] @ end[first:, 2] > -0.5 * mass[first:].sum()
    np.testing.assert_allclose(mass @ end, mass @ start, atol=1e-4 * mass[first:].sum())
    energies = [0.5 * float((mass[:, None] * v**2).sum()) for v in (start, end)]
    assert energies[1] < energies[0]


def test_what_has_sunk_in_is_pushed_out(device):
    model, first = cube_on_slab(device, apart=-0.004, gravity=0.0)
    state, *_ = run_pairs(model, 200)
    assert height_of(state, first) > 0.1


def test_cloth_lies_on_a_soft_body(device):
    made = builder(radius=0.005)
    add_grid(made, dims=(2, 2, 1), mu=1e5, lam=1e5, damp=100.0)
    hold_below(made, 0.01)
    first = made.particle_count
    made.add_cloth_grid(
        pos=wp.vec3(0.023, 0.034, 0.109), rot=wp.quat_identity(), vel=wp.vec3(0.0, 0.0, 0.0), dim_x=3, dim_y=3,
        cell_x=0.04, cell_y=0.04, mass=0.02, tri_ke=1e3, tri_ka=1e3, tri_kd=0.1, edge_ke=0.01, edge_kd=1e-3,
    )  # fmt: skip
    model = made.finalize(device=device)
    contact_parameters(model, ke=1e3, kd=1.0)
    state, *_ = run_pairs(model, 300, dt=1e-3, damping=5.0)
    cloth = state.particle_q.numpy()[first:, 2]
    assert 0.1 < cloth.min() < cloth.max() < 0.112
    assert np.abs(state.particle_qd.numpy()[first:]).max() < 0.05


def test_forests_and_meshes_have_edges(device):
    """Each edge of the surface once, with the vertices opposite to it, and a small body on it is carried."""
    made = builder()
    forest = wc.TetForest.box((1, 1, 1), 0.1, 3)
    wn.add_forest(made, forest, wc.Isotropic(1e5, 0.3, 1000.0), fixed=forest.points[:, 2] < 0.01, k_damp=100.0)
    first = made.particle_count
    cube = wc.TetForest.box((1, 1, 1), 0.04, 0)
    cube = wc.TetMesh(cube.points, cube.tets)
    wn.add_mesh(made, cube, wc.Isotropic(1e5, 0.3, 1000.0), pos=(0.033, 0.028, 0.109), k_damp=100.0)
    model = made.finalize(device=device)
    edges, faces = model.edge_indices.numpy(), model.tri_indices.numpy()
    assert len(edges) == 3 * len(faces) // 2
    assert len(np.unique(np.sort(edges[:, 2:], axis=1), axis=0)) == len(edges)
    corners = {frozenset(face) for face in faces.tolist()}
    assert all({frozenset((a, c, d)), frozenset((b, c, d))} <= corners for a, b, c, d in edges.tolist())
    contact_parameters(model, ke=2e3)
    state, *_ = run_pairs(model, 300, damping=10.0)
    assert 0.095 < height_of(state, first) < 0.11


def test_what_is_refused(device):
    model, _ = cube_on_slab(device)
    for margin in (0.0, -1.0, float("nan"), "wide"):
        with pytest.raises(wc.InputError, match="self_contact_margin is"):
            wn.SolverCorotated(model, self_contact_margin=margin)
    solver = wn.SolverCorotated(model, self_contact_margin=MARGIN)
    contacts = newton.CollisionPipeline(model).contacts()
    with pytest.raises(wc.InputError, match="init_soft_self_contact"):
        solver.step(model.state(), model.state(), None, contacts, 1e-4)
    bare = builder()
    wn.add_forest(bare, wc.TetForest.box((1, 1, 1), 0.1, 1), wc.Isotropic(1e4, 0.3, 1000.0), surface=False)
    with pytest.raises(wc.InputError, match="surface=True"):
        wn.SolverCorotated(bare.finalize(device=device), self_contact_margin=MARGIN)


def test_more_pairs_than_room_are_refused(device):
    model, _ = cube_on_slab(device, apart=0.002)
    pipeline = newton.CollisionPipeline(model)
    pipeline.init_soft_self_contact(margin=0.1, vertex_buffer_pre_alloc=1, edge_buffer_pre_alloc=1)
    contacts, state, after = pipeline.contacts(), model.state(), model.state()
    pipeline.collide(state, contacts, soft_self_contact=True)
    solver = wn.SolverCorotated(model, self_contact_margin=0.1)
    with pytest.raises(wc.InputError, match="more pairs of soft bodies"):
        checked_step(solver, state, after, contacts)
    np.testing.assert_array_equal(after.particle_q.numpy(), model.particle_q.numpy())
