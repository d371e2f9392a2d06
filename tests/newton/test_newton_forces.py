"""Forces of the Newton solver: against the float64 oracle, and in Newton's conventions against its own solver."""

import numpy as np
import oracle
import pytest
import warp as wp
from newton_scenes import (
    LAM,
    MU,
    adaptive_forest,
    add_grid,
    builder,
    grid_model,
    impulse,
    newton,
    semi_implicit,
    wc,
    wn,
)

from warp_corot.kernels.newton.elements import scatter_posed


def bend(x, amount=0.6):
    """Bend, stretch and rotate a body, some of it a lot."""
    x = np.asarray(x, float)
    a = amount * x[:, 0] / 0.1
    return np.stack([np.sin(a) * (0.3 - x[:, 1]), np.cos(a) * (x[:, 1] - 0.3), 1.2 * x[:, 2] + 0.3 * x[:, 0]], axis=1)


def oracle_forces(model, rest, x, mu, lam):
    mesh = oracle.Mesh(np.asarray(rest, float), model.tet_indices.numpy().reshape(-1, 4))
    return oracle.evaluate("corotated", mesh, np.asarray(x, np.float32).astype(float), mu, lam)[1]


def assert_near(found, wanted, tolerance):
    assert np.abs(found - wanted).max() < tolerance * np.abs(wanted).max()


@pytest.mark.parametrize("crushed", [False, True])
def test_tetrahedra_against_the_oracle(device, rng, crushed):
    model = grid_model(device, damp=0.0)
    rest = model.particle_q.numpy().astype(float)
    x = bend(rest) + 0.01 * rng.standard_normal(rest.shape)
    if crushed:
        x = rest + 0.08 * rng.standard_normal(rest.shape)
    mesh = oracle.Mesh(rest, model.tet_indices.numpy().reshape(-1, 4))
    inverted = (np.linalg.det(mesh.deformation_gradients(x)) < 0).sum()
    assert (inverted > 5) == crushed
    found = impulse(wn.SolverCorotated(model), model, x)
    assert_near(found, oracle_forces(model, rest, x, MU, LAM), 3e-3 if crushed else 1e-4)


def columns(model):
    """mu, lambda, k_lambda and k_damp, as documented."""
    k_mu, k_lambda, k_damp = model.tet_materials.numpy().reshape(-1, 3).T
    return [wp.array(a, dtype=wp.float32, device=model.device) for a in (k_mu, k_lambda, k_lambda, k_damp)]


@pytest.mark.parametrize("damped", [False, True])
def test_all_forces_at_once_as_one_after_another(device, rng, damped):
    """CUDA's kernel also runs on the CPU, where eight elements run together and non-elastic forces separately: for any
    F, even where Newton's iteration fails."""
    model = grid_model(device, damp=50.0 * damped)
    x = model.particle_q.numpy() + 0.06 * rng.standard_normal((model.particle_count, 3))
    v = rng.standard_normal(x.shape)
    active = rng.uniform(-0.3, 0.3, model.tet_count) * (rng.random(model.tet_count) < 0.5)
    control = model.control()
    control.tet_activations.assign(active.astype(np.float32))
    solver = wn.SolverCorotated(model, stable_dt=1.0)
    wanted = impulse(solver, model, x, v, control)
    tets, found = solver.tetrahedra, wp.zeros(model.particle_count, dtype=wp.vec4, device=device)
    qd = wp.array(v, dtype=wp.vec3, device=device)
    padded = wp.array(np.pad(x, ((0, 0), (0, 1))), dtype=wp.vec4, device=device)
    ids = wp.array(np.arange(model.tet_count), dtype=wp.int32, device=device)
    inputs = [tets.posed(np.arange(model.tet_count)), *columns(model), ids, control.tet_activations, padded, qd]
    wp.launch(scatter_posed(damped), model.tet_count, inputs, [found], device=device)
    assert_near(found.numpy()[:, :3], wanted, 1e-4)


@pytest.mark.parametrize("copies", [1, 3])
def test_forests_against_the_oracle(device, rng, copies):
    """Leaves in subtrees, single leaves, mirrored ones; copies of a forest, rotated, among other things."""
    forest = adaptive_forest()
    made = builder()
    turn = wp.quat_from_axis_angle(wp.normalize(wp.vec3(1.0, 2.0, 3.0)), 0.7)
    add_grid(made, pos=(0.0, 2.0, 0.0))
    material = wc.Isotropic(young=1e4, poisson=0.35, density=1000.0)
    for k in range(copies):
        wn.add_forest(made, forest, material, pos=(3.0 * k, 0.0, 1.0), rot=turn)
        made.add_particle(wp.vec3(0.0, 5.0, float(k)), wp.vec3(), 1.0)
    model = made.finalize(device=device)
    solver = wn.SolverCorotated(model)
    assert len(solver.tetrahedra.groups) == 1
    assert solver.tetrahedra.groups[0].copies == copies
    assert len(solver.tetrahedra.groups[0].tets) == copies * len(forest.tets)
    assert solver.tetrahedra.single_count == model.tet_count - copies * len(forest.tets) > 0
    rest = model.particle_q.numpy().astype(float)
    x = rest + 0.01 * rng.standard_normal(rest.shape)
    in_grid = (model.tet_indices.numpy().reshape(-1, 4) < 36).all(axis=1)
    mu, lam = np.where(in_grid, MU, material.mu), np.where(in_grid, LAM, material.lam)
    assert_near(impulse(solver, model, x), oracle_forces(model, rest, x, mu, lam), 1e-3)


def test_a_tetrahedron_on_a_forest(device, rng):
    """Its particles are displaced from the forest's rest positions for one and from the origin for the other, so the
    forest is not stepped by its subtrees."""
    material = wc.Isotropic(young=1e4, poisson=0.35, density=1000.0)
    made = builder()
    wn.add_forest(made, adaptive_forest(3), material, pos=(1.0, 2.0, 3.0))
    corners = np.array(made.particle_q)[list(made.tri_indices[0])]
    normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
    top = corners.mean(axis=0) + 0.1 * normal / np.linalg.norm(normal)
    made.add_particle(wp.vec3(*top.tolist()), wp.vec3(), 1.0)
    made.add_tetrahedron(*made.tri_indices[0], made.particle_count - 1, MU, LAM, 0.0)
    model = made.finalize(device=device)
    assert model.tet_count == len(adaptive_forest(3).tets) + 1
    with pytest.warns(UserWarning, match="has particles in other tetrahedra"):
        solver = wn.SolverCorotated(model)
    rest = model.particle_q.numpy().astype(float)
    x = rest + 0.01 * rng.standard_normal(rest.shape)
    mu, lam, _ = model.tet_materials.numpy().reshape(-1, 3).astype(float).T
    assert_near(impulse(solver, model, x), oracle_forces(model, rest, x, mu, lam), 1e-3)


def test_rotations_of_ancestors(device, rng):
    """With rotation_level: the same as the forest in this package."""
    forest = wc.TetForest.box((1, 1, 1), 0.3, 6)
    material = wc.Isotropic(young=1e4, poisson=0.35, density=1000.0)
    made = builder()
    wn.add_forest(made, forest, material, pos=(0.5, 0.0, 1.0))
    model = made.finalize(device=device)
    x = bend(forest.points, 0.1) + 0.005 * rng.standard_normal(forest.points.shape)
    body = wc.SoftBody(forest, material, device=device)
    body.positions = x
    wanted = wc.Simulation(body, model=wc.Corotated(rotation_level=3)).forces().numpy()
    own = impulse(wn.SolverCorotated(model), model, x)
    assert_near(impulse(wn.SolverCorotated(model, rotation_level=3), model, x), wanted, 1e-3)
    assert np.abs(own - wanted).max() > 0.01 * np.abs(wanted).max()


def test_materials_of_each_tetrahedron(device, rng):
    """General meshes and forests with cut elements; both meanings of k_mu and k_lambda; changed materials."""
    forest = adaptive_forest(3)
    young = 1e4 * (1 + rng.random(len(forest.tets)))
    made = builder()
    wn.add_forest(made, forest, wc.Isotropic(young=young, poisson=0.3, density=1000.0))
    mesh = wc.TetMesh(np.add(forest.points, [2.0, 0.0, 0.0]), wn.scene.outward_tets(forest))
    wn.add_mesh(made, mesh, wc.Isotropic(young=young, poisson=0.3, density=1000.0))
    model = made.finalize(device=device)
    rest = model.particle_q.numpy().astype(float)
    x = rest + 0.01 * rng.standard_normal(rest.shape)
    given = model.tet_materials.numpy().reshape(-1, 3).astype(float)
    np.testing.assert_allclose(given[: len(young), 0], young / 2.6, rtol=1e-6)
    solver = wn.SolverCorotated(model)
    assert_near(impulse(solver, model, x), oracle_forces(model, rest, x, given[:, 0], given[:, 1]), 1e-3)

    other = wn.SolverCorotated(model, lame="semi-implicit")
    wanted = oracle_forces(model, rest, x, 0.75 * given[:, 0], given[:, 1] - 0.625 * given[:, 0])
    assert_near(impulse(other, model, x), wanted, 1e-3)

    changed = given * [2.0, 0.5, 1.0]
    model.tet_materials.assign(changed.astype(np.float32))
    solver.notify_model_changed(newton.ModelFlags.MODEL_PROPERTIES)
    assert_near(impulse(solver, model, x), oracle_forces(model, rest, x, changed[:, 0], changed[:, 1]), 1e-3)


def test_a_body_turned_after_it_was_built_is_at_rest(device):
    """``add_builder`` rotates particles, not the elements' rest matrices."""
    part = builder()
    add_grid(part)
    wn.add_forest(part, adaptive_forest(3), wc.Isotropic(1e4, 0.3, 1000.0), pos=(0.0, 0.0, 2.0))
    made = builder()
    turn = wp.quat_from_axis_angle(wp.normalize(wp.vec3(1.0, -2.0, 0.5)), 2.0)
    made.add_builder(part, xform=wp.transform(wp.vec3(0.3, 0.2, 0.1), turn))
    model = made.finalize(device=device)
    solver = wn.SolverCorotated(model)
    assert len(solver.tetrahedra.groups) == 1
    stretched = np.abs(impulse(solver, model, 1.01 * model.particle_q.numpy())).max()
    assert np.abs(impulse(solver, model)).max() < 1e-3 * stretched


def test_small_strains_as_in_semi_implicit(device, rng):
    """With lame="semi-implicit" forces differ only by second-order terms in the strain, with the other by more."""
    model = grid_model(device)
    rest = model.particle_q.numpy().astype(float)
    direction = 0.1 * rng.standard_normal(rest.shape)
    theirs = semi_implicit(model)
    differences = []
    for size in (0.04, 0.02, 0.01):
        x = rest + size * direction
        reference = impulse(theirs, model, x)
        ours = impulse(wn.SolverCorotated(model, lame="semi-implicit"), model, x)
        differences.append(np.abs(ours - reference).max() / np.abs(reference).max())
    assert differences[2] < 0.02
    assert differences[0] / differences[1] > 1.7
    assert differences[1] / differences[2] > 1.7
    documented = impulse(wn.SolverCorotated(model), model, x)
    assert np.abs(documented - reference).max() > 0.1 * np.abs(reference).max()


def test_activation_is_newtons(device, rng):
    """k_lambda a cof F, at any deformation, from the control and from the model."""
    model = grid_model(device)
    x = bend(model.particle_q.numpy()) + 0.01 * rng.standard_normal((model.particle_count, 3))
    control = model.control()
    control.tet_activations.assign(rng.uniform(-0.3, 0.3, model.tet_count).astype(np.float32))
    ours, theirs = wn.SolverCorotated(model), semi_implicit(model)
    wanted = impulse(theirs, model, x, control=control) - impulse(theirs, model, x)
    passive = impulse(ours, model, x)
    assert_near(impulse(ours, model, x, control=control) - passive, wanted, 1e-3)
    model.tet_activations.assign(control.tet_activations)
    assert_near(impulse(ours, model, x) - passive, wanted, 1e-3)


class TestDamping:
    K = 5e4

    def viscous(self, device, x, v):
        """Forces with k_damp minus those without."""
        damped, free = (grid_model(device, damp=k) for k in (self.K, 0.0))
        solver = wn.SolverCorotated(damped, stable_dt=1.0)
        return impulse(solver, damped, x, v) - impulse(wn.SolverCorotated(free, stable_dt=1.0), free, x, v)

    def test_is_newtons_for_small_strains_that_do_not_turn(self, device, rng):
        """One tetrahedron whose first node rests: Newton's volume damping uses the other nodes' absolute velocities,
        and so slows down translation, too."""
        made, free = builder(), builder()
        for to, k in ((made, self.K), (free, 0.0)):
            for corner in ([0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.0, 0.1, 0.0], [0.0, 0.0, 0.1]):
                to.add_particle(wp.vec3(*corner), wp.vec3(), 1.0)
            to.add_tetrahedron(0, 1, 2, 3, MU, LAM, k)
        damped, free = made.finalize(device=device), free.finalize(device=device)
        x = damped.particle_q.numpy().astype(float)
        rate = rng.standard_normal((3, 3))
        v = x @ (rate + rate.T)
        found, wanted = (
            impulse(solver(damped), damped, x, v) - impulse(solver(free), free, x, v)
            for solver in (lambda m: wn.SolverCorotated(m, stable_dt=1.0), semi_implicit)
        )
        assert_near(found, wanted, 1e-3)
        # V (k D + k tr D I) grad N, with V = 0.1^3 / 6 and grad N_i = e_i / 0.1.
        stress = self.K * (rate + rate.T + 2 * np.trace(rate) * np.eye(3))
        assert_near(found[1:], -(0.1**2 / 6) * stress, 1e-3)

    def test_leaves_rigid_motion_alone(self, device, rng):
        model = grid_model(device)
        x = bend(model.particle_q.numpy())
        spin = np.add(np.cross([3.0, -2.0, 1.0], x), [1.0, 2.0, 3.0])
        moving = self.viscous(device, x, spin + 0.1 * rng.standard_normal(x.shape))
        assert np.abs(self.viscous(device, x, spin)).max() < 2e-3 * np.abs(moving).max()

    def test_keeps_momenta_and_takes_energy(self, device, rng):
        x = bend(grid_model(device).particle_q.numpy()) + 0.005 * rng.standard_normal((36, 3))
        for _ in range(5):
            v = rng.standard_normal(x.shape)
            f = self.viscous(device, x, v)
            assert np.abs(f.sum(axis=0)).max() < 1e-3 * np.abs(f).max()
            assert np.abs(np.cross(x, f).sum(axis=0)).max() < 1e-3 * np.abs(f).max()
            assert np.sum(f * v) < -0.01 * np.abs(f * v).sum()


def test_free_bodies_keep_their_momenta(device, rng):
    """Elasticity, damping and activation together, over many steps."""
    made = builder(gravity=(0.0, 0.0, 0.0))
    add_grid(made, damp=5.0)
    wn.add_forest(made, adaptive_forest(3), wc.Isotropic(1e4, 0.3, 1000.0), pos=(0.0, 0.0, 2.0), k_damp=5.0)
    model = made.finalize(device=device)
    solver = wn.SolverCorotated(model)
    states = model.state(), model.state()
    x = model.particle_q.numpy() + 0.005 * rng.standard_normal((model.particle_count, 3))
    v = np.cross([2.0, 1.0, -1.0], x) + 0.3 * rng.standard_normal(x.shape)
    states[0].particle_q.assign(x.astype(np.float32))
    states[0].particle_qd.assign(v.astype(np.float32))
    model.tet_activations.fill_(0.1)
    m = model.particle_mass.numpy()[:, None].astype(float)
    p, h = (m * v).sum(axis=0), (m * np.cross(x, v)).sum(axis=0)
    size = np.abs(m * v).sum()
    now, after = states
    for _ in range(200):
        solver.step(now, after, None, None, 2e-4)
        now, after = after, now
    x, v = now.particle_q.numpy().astype(float), now.particle_qd.numpy().astype(float)
    assert np.abs((m * v).sum(axis=0) - p).max() < 1e-4 * size
    assert np.abs((m * np.cross(x, v)).sum(axis=0) - h).max() < 1e-3 * size
