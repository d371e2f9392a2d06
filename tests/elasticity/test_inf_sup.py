"""Inf-sup constants of shared dilatation: whether some pressures do no work in any motion, and how well the others are
controlled. The constant is the least of sup_u (p, div u) / (|grad u| |p|) over pressures p with a value for each group,
for a clamped beam, in float64, from points and tetrahedra alone."""

import numpy as np
import oracle
import pytest
from scipy.linalg import eigh
from scipy.sparse import coo_matrix, identity
from scipy.sparse.linalg import splu
from shared_dilatation import of_forest, of_nodes

import warp_corot as wc


def constants(mesh, groups):
    """All singular values of the divergence, in ascending order [groups]."""
    reference = oracle.Mesh(mesh.points, mesh.tets)
    g, volumes, tets = reference.gradients, reference.volumes, reference.tets
    count, nodes = len(volumes), len(reference.points)
    rows, columns = np.repeat(tets, 4, axis=1), np.tile(tets, (1, 4))
    entries = np.einsum("t,tai,tbi->tab", volumes, g, g).ravel()
    laplace = coo_matrix((entries, (rows.ravel(), columns.ravel())), (nodes, nodes)).tocsc()
    free = np.flatnonzero(reference.points[:, 2] > 1e-9)
    factors, found = splu(laplace[free][:, free]), 0.0
    for axis in range(3):
        entries = (volumes[:, None] * g[:, :, axis]).ravel()
        places = (np.repeat(np.arange(count), 4), tets.ravel())
        divergence = (groups @ coo_matrix((entries, places), (count, nodes)).tocsr())[:, free].toarray()
        found = found + divergence @ factors.solve(np.ascontiguousarray(divergence.T))
    scale = 1.0 / np.sqrt(groups @ volumes)
    return np.sqrt(np.maximum(eigh(found * scale[:, None] * scale, eigvals_only=True), 0.0))


@pytest.mark.parametrize(
    ("level", "least"), [(0, 1.05), (3, 0.44), (6, 0.25), pytest.param(9, 0.115, marks=pytest.mark.slow)]
)
def test_groups_of_a_forest_have_no_spurious_pressure(level, least):
    """The constant falls with the size of elements, by about a half each time that they are halved."""
    forest = wc.TetForest.box((1, 1, 3), 0.064, level)
    found = constants(forest, of_forest(forest))
    print(f"level {level}: {found[0]:.3f}, {found[1]:.3f}")
    assert found[0] > least


def test_single_elements_and_nodes_have_spurious_pressures():
    forest = wc.TetForest.box((1, 1, 3), 0.064, 3)
    plain = constants(forest, identity(len(forest.tets), format="csr"))
    assert (plain < 1e-6).sum() == 57
    assert len(plain) == 144
    assert (constants(forest, of_nodes(forest)) < 1e-6).sum() == 3
