"""Conjugate gradients with the tangent operator of a body, against dense float64 matrices."""

import numpy as np
import oracle
import pytest
import warp as wp
from cases import MATERIAL, MODELS, mixed_forest, oracle_mesh, random_displacement
from tangents import on_device

import warp_corot as wc
from warp_corot.solvers.implicit.conjugate_gradients import ConjugateGradients
from warp_corot.solvers.implicit.preconditioners import BlockDiagonal
from warp_corot.solvers.implicit.tangent import TangentOperator

MASS = 2.0e3  # a of A = a M + K [1/s^2]


def system(model, device, *, worlds=1, exact=False, poisson=0.3):
    """A mesh, its free nodes, and the operator of a body whose lowest nodes are fixed."""
    mesh = mixed_forest()
    body = wc.SoftBody(mesh, wc.Isotropic(**(MATERIAL | {"poisson": poisson})), worlds=worlds, device=device)
    fixed = mesh.points[:, 2] < 1e-9
    body.fix(fixed)
    field = MODELS[model]().bind(body)
    return mesh, ~fixed, TangentOperator(body, field, exact=exact)


def dense(model, mesh, free, u, poisson=0.3):
    """A in float64, its rows of free nodes."""
    reference = oracle_mesh(mesh)
    mu, lam = oracle.lame(MATERIAL["young"], poisson)
    K = np.asarray(oracle.tangent_matrix(model, reference, reference.points + u, mu, lam).todense())
    masses = np.repeat(reference.masses(MATERIAL["density"]), 3)
    rows = np.repeat(free, 3)
    return (K + MASS * np.diag(masses))[np.ix_(rows, rows)]


def solve(operator, u, b, *, tolerance=1e-6, most=1000, recorded=False):
    """x of A x = b [worlds * N, 3], and the report."""
    field = operator.field
    operator.set_scales(MASS, 0.0, 1.0)
    x, right, at = on_device(np.zeros_like(b), field), on_device(b, field), on_device(u, field)
    preconditioner = BlockDiagonal(operator)
    cg = ConjugateGradients(operator, len(b), most=most)
    cg.tolerance.fill_(tolerance)

    def launch():
        operator.take(at)
        preconditioner.update(operator)
        cg.launch(preconditioner, right, x)

    if recorded:
        with wp.ScopedCapture(device=field.device) as capture:
            launch()
        wp.capture_launch(capture.graph)
    else:
        launch()
    return x.numpy()[:, :3].astype(float), cg.report()


def right_side(free, rng, worlds=1):
    """Random forces on free nodes."""
    b = rng.standard_normal((worlds, len(free), 3)).astype(np.float32)
    b[:, ~free] = 0.0
    return b.reshape(-1, 3)


@pytest.mark.parametrize("model", ["linear", "corotated", "stvk", "neo_hookean"])
def test_solution_is_that_of_the_dense_matrix(model, device, rng):
    """At strains of a few per cent, with K's exact derivative; float32 products hold the solution to 1e-4."""
    mesh, free, operator = system(model, device, exact=True)
    u = random_displacement(mesh, rng, 0.02)
    b = right_side(free, rng)
    x, report = solve(operator, u, b)
    expected = np.linalg.solve(dense(model, mesh, free, u.astype(float)), b[free].astype(float).ravel())
    error = np.abs(x[free].ravel() - expected).max() / np.abs(expected).max()
    print(f"{model}: {report.iterations[0]} iterations, off by {error:.1e}")
    assert report.converged.all()
    assert report.residual.max() <= 1e-6
    assert error < 1e-4
    assert not x[~free].any()


def test_each_world_has_a_solve_of_its_own(device, rng):
    """The solution of a world is that of the world alone, and a world without a right side is done at once."""
    _, free, operator = system("linear", device, worlds=3)
    b = right_side(free, rng, worlds=3)
    b[: len(free)] = 0.0
    b[len(free) : 2 * len(free)] *= 1e-6
    x, report = solve(operator, np.zeros_like(b), b)
    assert report.converged.all()
    assert report.iterations[0] == 0
    assert not x[: len(free)].any()
    for world in (1, 2):
        nodes = slice(world * len(free), (world + 1) * len(free))
        _, _, alone = system("linear", device)
        expected, one = solve(alone, np.zeros_like(b[nodes]), b[nodes])
        assert abs(report.iterations[world] - one.iterations[0]) <= 1
        assert np.abs(x[nodes] - expected).max() < 1e-5 * np.abs(expected).max()


def test_a_recorded_solve_is_the_same(device, rng):
    mesh, free, operator = system("corotated", device)
    u, b = random_displacement(mesh, rng, 0.05), right_side(free, rng)
    x, report = solve(operator, u, b)
    again, recorded = solve(operator, u, b, recorded=True)
    assert report.converged.all()
    assert recorded.converged.all()
    assert np.abs(x - again).max() <= (0.0 if wp.get_device(device).is_cpu else 1e-5 * np.abs(x).max())


def test_negative_curvature_ends_in_a_direction_of_descent(device, rng):
    """A block of StVK squeezed to a quarter has no definite stiffness; the solve says so."""
    mesh, free, operator = system("stvk", device, exact=True)
    u = (mesh.points * [0.0, 0.0, -0.75]).astype(np.float32)
    b = right_side(free, rng)
    x, report = solve(operator, u, b)
    assert report.negative.all()
    assert not report.converged.any()
    assert (x * b).sum() > 0.0


def test_too_few_iterations_and_wrong_numbers_are_reported(device, rng):
    _, free, operator = system("linear", device)
    b = right_side(free, rng)
    x, report = solve(operator, np.zeros_like(b), b, most=3)
    assert report.iterations[0] == 3
    assert not report.converged.any()
    assert np.isfinite(x).all()
    b[free.nonzero()[0][0]] = np.nan
    x, report = solve(operator, np.zeros_like(b), b)
    assert report.broken.all()
    assert not x.any()
