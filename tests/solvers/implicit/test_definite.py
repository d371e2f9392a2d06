"""Matrices of single linearisations, which must be positive semidefinite, and the exact ones where these are."""

import numpy as np
import pytest
import warp as wp

import warp_corot as wc
from warp_corot.discretization.sizes import padded
from warp_corot.solvers.implicit.tangent import TangentOperator


@pytest.mark.parametrize("kind", ["forest", "tetrahedra"])
@pytest.mark.parametrize("poisson", [0.44, 0.49])
def test_a_stretched_body_has_the_exact_matrix(poisson, kind, device):
    """With the stiffness of tension: where nothing is compressed enough to make the exact one indefinite."""
    mesh = wc.TetForest.box((2, 1, 1), cell_size=0.02, level=3)
    mesh = mesh if kind == "forest" else wc.TetMesh(mesh.points, mesh.tets)
    body = wc.SoftBody(mesh, wc.Isotropic(6e4, poisson, 1000.0), device=device)
    field = wc.Corotated().bind(body)
    rng = np.random.default_rng(3)
    stretch = np.diag([0.3, 0.2, 0.25] if poisson < 0.45 else [0.5, -0.18, -0.177])
    turn = np.array([[0.8, -0.6, 0.0], [0.6, 0.8, 0.0], [0.0, 0.0, 1.0]])
    moved = mesh.points @ (turn @ (np.eye(3) + stretch)).T - mesh.points
    moved += rng.normal(scale=3e-6, size=moved.shape)
    u, p = (wp.array(padded(x), dtype=wp.vec4, device=device) for x in (moved, rng.normal(size=moved.shape)))
    products, blocks = [], []
    for exact in (True, False):
        operator = TangentOperator(body, field, exact=exact)
        operator.set_scales(0.0, 0.0, 1.0)
        operator.take(u)
        y = wp.zeros_like(u)
        operator.apply(p, y)
        products.append(y.numpy())
        blocks.append(operator.diagonal_blocks().numpy())
    assert operator.tension.taut.numpy().all()
    np.testing.assert_allclose(products[1], products[0], atol=2e-6 * np.abs(products[0]).max())
    np.testing.assert_allclose(blocks[1], blocks[0], atol=2e-6 * np.abs(blocks[0]).max())


def matrix_of(operator):
    """The whole matrix, [3 N, 3 N]."""
    unit = np.eye(3 * operator.node_count)
    columns = []
    for column in unit:
        x = wp.array(padded(column.reshape(-1, 3)), dtype=wp.vec4, device=operator.device)
        y = wp.zeros_like(x)
        operator.apply(x, y)
        columns.append(y.numpy()[:, :3].ravel())
    return np.array(columns)


@pytest.mark.parametrize("poisson", [0.4, 0.49])
@pytest.mark.parametrize("model", [wc.NeoHookean(), wc.StVenantKirchhoff(), wc.Ogden()], ids=lambda m: type(m).__name__)
def test_matrices_of_crushed_bodies_are_semidefinite(model, poisson, device, rng):
    mesh = wc.TetForest.box((1, 1, 1), cell_size=0.02, level=3)
    body = wc.SoftBody(mesh, wc.Isotropic(6e4, poisson, 1000.0), device=device)
    field = model.bind(body)
    for amount in (1e-4, 6e-3):
        u = wp.array(padded(rng.normal(scale=amount, size=mesh.points.shape)), dtype=wp.vec4, device=device)
        matrices = []
        for exact in (True, False):
            operator = TangentOperator(body, field, exact=exact)
            operator.set_scales(0.0, 0.0, 1.0)
            operator.take(u)
            matrices.append(matrix_of(operator))
        exact, definite = matrices
        largest = np.abs(exact).max()
        np.testing.assert_allclose(definite, definite.T, atol=1e-6 * largest)
        assert np.linalg.eigvalsh(definite).min() > -1e-6 * np.abs(definite).max()
        is_definite = np.linalg.eigvalsh(exact).min() > -1e-6 * largest
        # In a gentle state elements are compressed, so some have negative parts although the whole has none.
        if amount == 1e-4:
            np.testing.assert_allclose(definite, exact, atol=0.05 * largest)
    assert not is_definite or not isinstance(model, wc.NeoHookean)
