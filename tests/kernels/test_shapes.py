"""The tables of the three shapes agree with one another and with the elements of a mesh."""

import re

import numpy as np
import pytest

import warp_corot as wc
from warp_corot.kernels.tables import shapes


@pytest.mark.parametrize("shape", range(3))
def test_tables_are_those_of_the_elements_of_a_mesh(shape):
    """Edge lengths, volume, circumscribed sphere and hat functions of each element of a uniform forest of one type."""
    h = 0.1
    forest = wc.TetForest.box((1, 1, 1), h, shape)
    x = forest.points[forest.tets] / h
    for edge, (a, b) in enumerate(shapes.EDGES):
        assert (shapes.FIRST_NODE[edge], shapes.SECOND_NODE[edge]) == (a, b)
        np.testing.assert_allclose(np.linalg.norm(x[:, a] - x[:, b], axis=1), shapes.EDGE_LENGTHS[shape][edge])
    np.testing.assert_allclose(forest.volumes / h**3, shapes.VOLUME[shape])
    sides = x[:, 1:] - x[:, :1]
    centres = np.linalg.solve(2.0 * sides, np.sum(sides**2, axis=2)[..., None])[..., 0]
    np.testing.assert_allclose(np.linalg.norm(centres, axis=1), shapes.CIRCUMRADIUS[shape])
    gradients, rest = np.array(shapes.GRADIENT[shape]), np.array(shapes.REST[shape])
    np.testing.assert_allclose(gradients @ rest, np.eye(3), atol=1e-12)


@pytest.mark.parametrize("shape", range(3))
def test_expressions_for_kernels_are_those_of_the_gradients(shape, rng):
    """Columns F h of nodal vectors, and forces -grad N P on nodes from the columns of a stress."""
    x, p = rng.standard_normal((4, 3)), rng.standard_normal((3, 3))
    gradients = np.array(shapes.GRADIENT[shape])

    def value(expression):
        named = {f"x{n}": x[n] for n in range(4)} | {f"p{c}": p[c] for c in range(3)}
        return eval(re.sub(r"(\d\.\d+)f", r"\1", expression), named)

    np.testing.assert_allclose([value(e) for e in shapes.column_sums(shape)], gradients @ x)
    np.testing.assert_allclose([value(e) for e in shapes.force_sums(shape)], -gradients.T @ p)
