"""The explicit stiffness matrices: their zeros, and the equality of all three products."""

import numpy as np
import oracle
import pytest
from cases import CUBE, oracle_mesh, place, random_displacement, simulation

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


@pytest.mark.parametrize("level", range(7))
@pytest.mark.parametrize("rotation_level", [None, 2])
def test_three_products_agree(level, rotation_level, device, rng):
    mesh = wc.TetForest.box((1, 1, 1), CUBE, level)
    u = random_displacement(mesh, rng, 0.1)
    turn = oracle.polar(rng.standard_normal((3, 3)))
    u = ((mesh.points + u) @ turn.T - mesh.points).astype(np.float32)
    forces = {}
    for stiffness in ("factored", "sparse", "dense"):
        sim, body = simulation(mesh, wc.Corotated(stiffness=stiffness, rotation_level=rotation_level), device)
        place(body, u)
        forces[stiffness] = sim.forces().numpy()
    scale = np.abs(forces["factored"]).max()
    assert scale > 0
    assert np.abs(forces["sparse"] - forces["factored"]).max() < 1e-5 * scale
    assert np.abs(forces["dense"] - forces["factored"]).max() < 1e-5 * scale


def test_unknown_product():
    with pytest.raises(wc.InputError, match="stiffness"):
        wc.Corotated(stiffness="banded")
