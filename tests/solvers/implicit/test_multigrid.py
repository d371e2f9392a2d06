"""Geometric multigrid: its matrices against dense ones, the cycle's laws, and iterations over levels."""

import functools

import numpy as np
import pytest
import warp as wp
from cases import MATERIAL, MODELS, mixed_forest, random_displacement
from multigrids import MASS, ROUNDING, as_matrix, dense, lowest_tenth, mesh_nodes, multigrid_of, operator_of, uniform
from tangents import on_device
from tree_levels import TreeLevels

import warp_corot as wc
from warp_corot.solvers.implicit.conjugate_gradients import ConjugateGradients
from warp_corot.solvers.implicit.multigrid import Multigrid
from warp_corot.solvers.implicit.preconditioners import BlockDiagonal, preconditioner_of
from warp_corot.solvers.implicit.tangent import TangentOperator


@functools.cache
def ball(max_level=7):
    """A carved forest, whose coarse levels have nodes that no leaf names, with elements filled to 2 %."""
    domain = wc.Domain.sphere(0.1, (0.01, 0.003, -0.006), device="cpu")
    domain = domain | wc.Domain.sphere(0.06, (0.11, 0.02, 0.01), device="cpu")
    return wc.TetForest.from_domain(domain, 0.12, max_level=max_level, surface_error=0.0005)


FORESTS = {"uniform": uniform, "mixed": lambda: mixed_forest(level=5), "ball": ball}


def solve(operator, preconditioner, tolerance=1e-5):
    """Iterations to the answer to the body's weight."""
    body = operator.body
    b = np.zeros((len(body.masses), 3), np.float32)
    b[:, 1] = -9.8 * body.masses * (operator.inverse_mass.numpy()[: len(b)] > 0.0)
    right = on_device(b, operator.field)
    cg = ConjugateGradients(operator, len(right), most=2000)
    cg.tolerance.fill_(tolerance)
    cg.launch(preconditioner, right, wp.zeros_like(right))
    report = cg.report()
    assert report.converged.all()
    return int(report.iterations.max())


def iterations(operator, **options):
    return solve(operator, multigrid_of(operator, **options))


@pytest.mark.parametrize("model", ["linear", "corotated"])
@pytest.mark.parametrize("name", FORESTS)
def test_finest_matrix_is_the_operators(name, model, device, rng):
    """In two worlds with different displacements; rows and columns of held nodes are zero."""
    mesh = FORESTS[name]()
    fixed = rng.random((2, len(mesh.points))) < 0.1
    operator = operator_of(mesh, device, model=model, fixed=fixed.ravel(), worlds=2, mass=MASS)
    u = np.concatenate([random_displacement(mesh, rng, 0.2) for _ in range(2)])
    multigrid = multigrid_of(operator, model, u)
    level, count = multigrid.levels[0], len(mesh.points)
    x = rng.standard_normal((2, count, 3)).astype(np.float32)
    x[fixed] = 0.0
    y = wp.zeros(2 * count, dtype=wp.vec4, device=device)
    operator.apply(on_device(x.reshape(-1, 3), operator.field), y)
    expected = y.numpy()[:, :3].reshape(2, count, 3)
    nodes = mesh_nodes(multigrid)
    named = nodes < count
    for world in range(2):
        ranked = np.zeros((level.count, 3))
        ranked[named] = x[world][nodes[named]]
        found = (dense(level, world) @ ranked.ravel()).reshape(-1, 3)
        assert not found[~named].any()
        error = np.abs(found[named] - expected[world][nodes[named]]).max()
        assert error < 50 * ROUNDING * np.abs(expected).max()
        assert not dense(level, world).reshape(level.count, 3, -1)[named][fixed[world][nodes[named]]].any()


@pytest.mark.parametrize("name", FORESTS)
def test_coarse_matrices_are_the_products(name, device, rng):
    """P^T A P with the prolongation that walking down the tree gives, without the nodes that are held."""
    mesh = FORESTS[name]()
    operator = operator_of(mesh, device, fixed=rng.random(len(mesh.points)) < 0.1, mass=MASS)
    multigrid = multigrid_of(operator, u=random_displacement(mesh, rng, 0.2))
    levels = multigrid.discretization.levels()
    places = np.concatenate([np.arange(levels.mesh_nodes), levels.others.numpy()])
    tree, nodes = TreeLevels.of(mesh.tree, len(mesh.lattice)), mesh_nodes(multigrid)
    free = np.ones(levels.node_count)
    free[: levels.mesh_nodes] = operator.inverse_mass.numpy() > 0.0
    free = free[nodes]
    assert len(multigrid.levels) > 1
    for fine, coarse in zip(multigrid.levels, multigrid.levels[1:], strict=False):
        depth = [int(np.searchsorted(levels.starts, level.count)) - 1 for level in (fine, coarse)]
        numbered = tree.prolongation(places, depth[1], depth[0])
        P = numbered[np.ix_(nodes[: fine.count], nodes[: coarse.count])]
        P = np.kron(free[: fine.count, None] * P * free[: coarse.count], np.eye(3))
        expected = P.T @ dense(fine) @ P
        np.testing.assert_allclose(dense(coarse), expected, rtol=0, atol=20 * ROUNDING * np.abs(expected).max())


@pytest.mark.parametrize("options", [{}, {"sweeps": 1}, {"sweeps": 2}], ids=str)
@pytest.mark.parametrize("name", FORESTS)
def test_each_cycle_is_symmetric_positive_definite_and_a_good_inverse(name, options, device, rng):
    if "sweeps" in options and device != "cpu":
        pytest.skip("sweeps are the CPU's")
    mesh = {"uniform": lambda: uniform(6), "mixed": lambda: mixed_forest(level=5), "ball": lambda: ball(5)}[name]()
    operator = operator_of(mesh, device)
    multigrid = multigrid_of(operator, u=random_displacement(mesh, rng, 0.2), **options)
    count = len(mesh.points)
    free = np.repeat(operator.inverse_mass.numpy() > 0.0, 3)
    B = as_matrix(multigrid.apply, count, device)
    assert np.abs(B - B.T).max() < 50 * ROUNDING * np.abs(B).max()
    np.testing.assert_array_equal(B[~free][:, ~free], np.eye((~free).sum()))
    assert not B[~free][:, free].any()
    B = B[np.ix_(free, free)]
    A = as_matrix(operator.apply, count, device)[np.ix_(free, free)]
    root = np.linalg.cholesky(0.5 * (B + B.T))
    values = np.linalg.eigvalsh(root.T @ (0.5 * (A + A.T)) @ root)
    print(f"{name}: eigenvalues of B A {values[0]:.3f} to {values[-1]:.3f}")
    assert values[0] > 0.05
    assert values[-1] < 1.001


def test_smoothing_bound_holds(device, rng):
    """Eigenvalues of D^-1 A are at most 4 on every level, also where E jumps and nodes are held."""
    mesh = ball(5)
    young = np.where(rng.random(len(mesh.tets)) < 0.5, 1e3, 1e7)
    operator = operator_of(mesh, device, young=young, poisson=0.49)
    for level in multigrid_of(operator).levels:
        assert largest_eigenvalue(level) < 4.0


def largest_eigenvalue(level):
    """Of D^-1 A."""
    inverses = level.inverses.numpy().astype(float)
    used = inverses.any(axis=(1, 2))
    root = np.linalg.cholesky(0.5 * (inverses + inverses.swapaxes(1, 2))[used])
    rows = np.repeat(used, 3)
    A = dense(level)[np.ix_(rows, rows)].reshape(len(root), 3, len(root), 3)
    scaled = np.einsum("iba,ibjc,jcd->iajd", root, A, root).reshape(3 * len(root), -1)
    return np.linalg.eigvalsh(0.5 * (scaled + scaled.T))[-1]


@pytest.mark.parametrize(("poisson", "most"), [(0.3, 8), (0.45, 10), (0.49, 18)])
def test_iterations_hardly_grow_with_the_level(poisson, most, device):
    """A clamped beam at levels 6 to 9: to 1e-5; block diagonal preconditioning takes twice as many at each halving."""
    counts = []
    for level in (6, 7, 9):
        mesh = wc.TetForest.box((1, 1, 3), 0.064, level)
        operator = operator_of(mesh, device, fixed=mesh.points[:, 2] < 1e-9, poisson=poisson)
        counts.append(iterations(operator))
    diagonal = BlockDiagonal(operator)
    diagonal.update(operator)
    plain = solve(operator, diagonal)
    print(f"Poisson's ratio {poisson}: {counts} iterations, {plain} with block diagonal at the finer level")
    assert counts[-1] <= counts[0] + 3
    assert max(counts) <= most
    assert plain > 6 * counts[-1]


@pytest.mark.slow
@pytest.mark.parametrize(("poisson", "most"), [(0.3, 8), (0.45, 11), (0.49, 24)])
def test_iterations_at_more_levels(poisson, most, device):
    for level in (6, 9, 12, 15):
        mesh = wc.TetForest.box((1, 1, 3), 0.064, level)
        operator = operator_of(mesh, device, fixed=mesh.points[:, 2] < 1e-9, poisson=poisson)
        count = iterations(operator)
        print(f"level {level}, Poisson's ratio {poisson}: {count} iterations")
        assert count <= most


@pytest.mark.parametrize("case", ["filled to 2 %", "stiffness jumps", "held inside"])
def test_iterations_on_an_adaptive_organ(case, device, rng):
    mesh = ball(9)
    assert mesh.fill.min() < 0.03
    young = np.where(mesh.points[mesh.tets].mean(axis=1)[:, 0] > 0.03, 5e7, 5e3)
    fixed = rng.random(len(mesh.points)) < 0.02
    options = {"filled to 2 %": {}, "stiffness jumps": {"young": young}, "held inside": {"fixed": fixed}}[case]
    count = iterations(operator_of(mesh, device, poisson=0.45, **options))
    print(f"{case}: {count} iterations")
    assert count <= {"filled to 2 %": 10, "stiffness jumps": 15, "held inside": 10}[case]


def test_mass_of_a_step_makes_it_easier(device):
    operator = operator_of(ball(), device, poisson=0.45, mass=60.0**2)
    assert iterations(operator) <= 7


def test_a_large_grid_of_cubes_has_no_inverse(device):
    """Its coarsest level has more nodes than are inverted, and is smoothed."""
    mesh = wc.TetForest.box((8, 3, 3), 0.064, 3)
    operator = operator_of(mesh, device, fixed=mesh.points[:, 0] < 1e-9)
    assert multigrid_of(operator).levels[-1].count > 64
    assert iterations(operator) <= 25


def test_a_body_held_nowhere_with_mass(device):
    operator = operator_of(uniform(6), device, fixed=[], mass=100.0)
    assert iterations(operator) <= 12


@pytest.mark.parametrize(("poisson", "most"), [(0.45, 9), (0.49, 14), (0.4999, 85)])
def test_elements_that_share_their_dilatation(poisson, most, device):
    mesh = wc.TetForest.box((1, 1, 3), 0.064, 6)
    operator = shared_operator(mesh, mesh.points[:, 2] < 1e-9, poisson, device)
    preconditioner = preconditioner_of(None, operator)
    preconditioner.update(operator)
    count = solve(operator, preconditioner)
    print(f"Poisson's ratio {poisson}: {count} iterations")
    assert count <= most


def test_rows_of_a_shared_dilatation_are_those_of_the_state(device):
    """With lambda 5000 times mu, rows of the rest state take more than 2000 iterations in a strained one."""
    mesh = wc.TetForest.box((1, 1, 2), 0.064, 6)
    operator = shared_operator(mesh, mesh.points[:, 2] < 1e-9, 0.4999, device, wc.Corotated)
    counts = []
    preconditioner = preconditioner_of(None, operator)
    for strain in (np.zeros((3, 3)), np.diag([0.25, -0.15, 0.0]) + 0.1 * np.eye(3)[[1, 2, 0]]):
        operator.take(on_device((mesh.points @ strain).astype(np.float32), operator.field))
        preconditioner.update(operator)
        counts.append(solve(operator, preconditioner))
    print(f"{counts[0]} iterations at rest, {counts[1]} in a strained state")
    assert counts[1] < 2 * counts[0]


@pytest.mark.parametrize("name", FORESTS)
def test_shared_dilatation_is_in_all_matrices(name, device):
    """The finest is the operator's, and 4 bounds the eigenvalues of D^-1 A on every level."""
    mesh = {"uniform": lambda: uniform(5), "mixed": lambda: mixed_forest(level=5), "ball": lambda: ball(5)}[name]()
    operator = shared_operator(mesh, lowest_tenth(mesh), 0.4999, device)
    multigrid = Multigrid(operator.body, is_turned=False, members=operator.field.find_members)
    multigrid.update(operator)
    free = np.repeat(operator.inverse_mass.numpy() > 0.0, 3)
    numbers = multigrid.levels[0].count
    order = (3 * multigrid.discretization.levels().nodes.numpy()[:, None] + np.arange(3)).ravel()
    found = np.zeros((3 * numbers, 3 * numbers))
    found[np.ix_(order, order)] = dense(multigrid.levels[0])
    used = np.flatnonzero(free)
    expected = as_matrix(operator.apply, len(mesh.points), device)[np.ix_(used, used)]
    assert np.abs(found[np.ix_(used, used)] - expected).max() < 50 * ROUNDING * np.abs(expected).max()
    for level in multigrid.levels:
        assert largest_eigenvalue(level) < 4.0


def shared_operator(mesh, fixed, poisson, device, law=wc.Linear):
    body = wc.SoftBody(mesh, wc.Isotropic(5e3, poisson, 1e3), device=device)
    body.fix(fixed)
    operator = TangentOperator(body, law(dilatation="shared").bind(body))
    operator.set_scales(0.0, 0.0, 1.0)
    operator.take(wp.zeros(len(mesh.points), dtype=wp.vec4, device=device))
    return operator


class Ground:
    """Stiff springs from nodes to the ground along y; one of them pushes."""

    def __init__(self, nodes, stiffness, device):
        blocks = np.zeros((len(nodes), 3, 3), np.float32)
        blocks[nodes, 1, 1] = stiffness
        blocks[np.flatnonzero(nodes)[0], 1, 1] = -1e-3 * stiffness
        self.blocks = wp.array(blocks, dtype=wp.mat33, device=device)

    def add_stiffness(self, body, p, y):
        values = y.numpy()
        values[:, :3] += np.einsum("nij,nj->ni", self.blocks.numpy(), p.numpy()[:, :3])
        y.assign(values)

    def add_diagonal(self, body, blocks):
        blocks.assign(blocks.numpy() + self.blocks.numpy())


def test_other_forces_count_with_their_diagonal(device, rng):
    """On the finest level, without the negative entries."""
    mesh = mixed_forest(level=4)
    operator = operator_of(mesh, device)
    nodes = mesh.points[:, 2] < 1e-9
    plain = dense(multigrid_of(operator).levels[0])
    stiffness = 1e3 * plain.diagonal().max()
    operator.stiff_forces = (Ground(nodes, stiffness, device),)
    multigrid = multigrid_of(operator)
    added = dense(multigrid.levels[0]) - plain
    expected = np.zeros((len(nodes), 3))
    expected[nodes, 1] = stiffness
    expected[np.flatnonzero(nodes)[0]] = 0.0
    expected[operator.inverse_mass.numpy() == 0.0] = 0.0
    expected = np.diag(expected[mesh_nodes(multigrid)].ravel())
    np.testing.assert_allclose(added, expected, rtol=0, atol=1e-4 * stiffness)


def test_viscosity_counts_as_stiffness(device):
    operator = operator_of(uniform(), device)
    plain = dense(multigrid_of(operator).levels[0])
    operator.set_scales(0.0, 20.0, 1.0)
    viscous = dense(multigrid_of(operator, stiffening=0.05).levels[0])
    np.testing.assert_allclose(viscous, 2.0 * plain, rtol=0, atol=1e-5 * np.abs(plain).max())


def test_worlds_do_not_touch(device, rng):
    """A cycle in three worlds is, in each, that of the world alone."""
    mesh = mixed_forest(level=4)
    fixed = rng.random((3, len(mesh.points))) < 0.1
    r = rng.standard_normal((3, len(mesh.points), 3)).astype(np.float32)

    def cycle(fixed, r, worlds):
        operator = operator_of(mesh, device, fixed=fixed.ravel(), worlds=worlds)
        z = wp.zeros(worlds * len(mesh.points), dtype=wp.vec4, device=device)
        multigrid_of(operator).apply(on_device(r.reshape(-1, 3), operator.field), z)
        return z.numpy().reshape(worlds, -1, 4)

    together = cycle(fixed, r, 3)
    for world in range(3):
        np.testing.assert_array_equal(together[world], cycle(fixed[world], r[world], 1)[0])


def test_updates_and_cycles_can_be_recorded(device, rng):
    mesh = mixed_forest(level=4)
    operator = operator_of(mesh, device)
    multigrid = multigrid_of(operator)
    u, r = (on_device(random_displacement(mesh, rng, 0.2), operator.field) for _ in range(2))
    expected, z = wp.zeros_like(r), wp.zeros_like(r)
    with wp.ScopedCapture(device=device) as capture:
        operator.take(u)
        multigrid.update(operator)
        multigrid.apply(r, z)
    for _ in range(2):
        u.assign(np.pad(random_displacement(mesh, rng, 0.2), ((0, 0), (0, 1))))
        wp.capture_launch(capture.graph)
        operator.take(u)
        multigrid.update(operator)
        multigrid.apply(r, expected)
        np.testing.assert_array_equal(z.numpy(), expected.numpy())


def test_a_mesh_that_changes_is_followed(device, rng):
    from remesh_cases import apply_marks, random_marks

    mesh = ball()
    body = wc.SoftBody(mesh, wc.Isotropic(5e3, 0.3, 1e3), device=device)
    wc.Simulation(body, model=wc.NeoHookean(), remesh=wc.OnlineRemesh(capacity=20000, min_level=0, max_level=12))
    multigrid = Multigrid(body)
    assert not multigrid.follow()
    for _ in range(2):
        apply_marks(body.changing.passes, random_marks(body.changing.forest, rng, 0.05, 0.3))
        body.changing.renew()
        assert multigrid.follow()
        body.fix(lowest_tenth(body.mesh))
        operator = TangentOperator(body, wc.Corotated().bind(body))
        multigrid.update(operator)
        changed = np.concatenate([level.blocks.numpy().ravel() for level in multigrid.levels])
        alone = operator_of(body.mesh, device, young=5e3, fixed=lowest_tenth(body.mesh))
        expected = np.concatenate([level.blocks.numpy().ravel() for level in multigrid_of(alone).levels])
        np.testing.assert_allclose(changed, expected, rtol=0, atol=20 * ROUNDING * np.abs(expected).max())


def test_general_meshes_and_wrong_options_are_refused(device):
    forest = uniform(1)
    body = wc.SoftBody(wc.TetMesh(forest.points, forest.tets), wc.Isotropic(5e3, 0.3, 1e3), device=device)
    with pytest.raises(wc.InputError, match="only a TetForest has levels; this mesh is a TetMesh"):
        Multigrid(body)
    body = wc.SoftBody(forest, wc.Isotropic(5e3, 0.3, 1e3), device=device)
    with pytest.raises(wc.InputError, match="degree is 0; it must be 1 or more"):
        Multigrid(body, degree=0)


@pytest.mark.parametrize("model", ["corotated", "neo_hookean"])
def test_static_answers_take_it_for_forests(model, device):
    """The answer is that with the block diagonal, for far fewer linear iterations."""
    reports, found = [], []
    for name in ("diagonal", None):
        mesh = wc.TetForest.box((1, 1, 3), 0.064, 6)
        body = wc.SoftBody(mesh, wc.Isotropic(**(MATERIAL | {"poisson": 0.45})), device=device)
        body.fix(mesh.points[:, 2] < 1e-9)
        reports.append(wc.solve_static(body, model=MODELS[model](), preconditioner=name))
        found.append(body.displacements.numpy())
    assert all(report.converged for report in reports)
    assert np.abs(found[0] - found[1]).max() < 1e-5 * np.abs(found[0]).max()
    print([report.linear_iterations for report in reports])
    assert reports[1].linear_iterations < reports[0].linear_iterations / 8


def test_static_answers_of_general_meshes_take_the_diagonal(device):
    forest = uniform(2)
    body = wc.SoftBody(wc.TetMesh(forest.points, forest.tets), wc.Isotropic(5e3, 0.3, 1e3), device=device)
    body.fix(lowest_tenth(forest))
    assert wc.solve_static(body).converged
    with pytest.raises(wc.InputError, match="only a TetForest has levels; this mesh is a TetMesh"):
        wc.solve_static(body, preconditioner="multigrid")
