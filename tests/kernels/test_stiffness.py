"""The explicit stiffness matrices and their zeros."""

import numpy as np
import oracle
import pytest
from cases import oracle_mesh

import warp_corot as wc
from warp_corot.kernels.elements.shapes import STIFFNESS_LAMBDA, STIFFNESS_MU

ZEROS_OF_THE_TABLE = (70, 44, 72)
ZEROS_OF_THE_AXES = (70, 44, 56)


def zeros(K):
    return int((np.abs(K) < 1e-12 * np.abs(K).max()).sum())


def local(kind):
    """The tetrahedron of a type whose frame is the identity and h = 1: the table, solved for the vertices."""
    e = np.eye(3)
    x0 = np.zeros(3)
    if kind == 0:
        return np.array([x0, e[0], e[0] + e[1], e[0] + e[1] + e[2]])
    if kind == 1:
        return np.array([x0, e[0], e[0] + e[1], (e[0] + e[1] + e[2]) / 2])
    return np.array([e[0] / np.sqrt(2), e[1] / np.sqrt(2), x0, e[2] / 2])


@pytest.mark.parametrize("kind", range(3))
def test_tables_are_the_stiffness_in_the_local_frame(kind):
    """Up to one factor for each type (h and V are the kernel's), the tables are those of the oracle, zeros exact."""
    mesh = oracle.Mesh(local(kind), [[0, 1, 2, 3]])
    expected = oracle.stiffness(mesh, 0.0, 1.0)[0], oracle.stiffness(mesh, 1.0, 0.0)[0]
    tables = np.asarray(STIFFNESS_LAMBDA[kind], float), np.asarray(STIFFNESS_MU[kind], float)
    factor = expected[1][0, 0] / tables[1][0, 0]
    for table, matrix in zip(tables, expected, strict=True):
        assert table.shape == (12, 12)
        assert np.allclose(factor * table, matrix, rtol=0, atol=1e-6 * np.abs(matrix).max())
    assert int((np.abs(tables).max(0) < 1e-12).sum()) == ZEROS_OF_THE_TABLE[kind]
    assert zeros(oracle.stiffness(mesh, 1.0, 1.7)[0]) == ZEROS_OF_THE_TABLE[kind]


@pytest.mark.parametrize("level", range(9))
def test_zeros_in_the_axes(level):
    """In world axes every leaf of a type has the same number of zeros, and type 2 has fewer than in its own frame."""
    forest = wc.TetForest.box((1, 1, 1), 1.0, level)
    matrices = oracle.stiffness(oracle_mesh(forest), 1.0, 1.7)
    assert {zeros(K) for K in matrices} == {ZEROS_OF_THE_AXES[level % 3]}
