"""Springs at places between nodes in multigrid: every level has them, and they come and go."""

import numpy as np
import pytest
import warp as wp
from cases import mixed_forest
from multigrids import MASS, ROUNDING, as_matrix, dense, mesh_nodes, multigrid_of, operator_of, uniform
from tree_levels import TreeLevels

from warp_corot.solvers.implicit.operator import Springs

FORESTS = {"uniform": uniform, "mixed": lambda: mixed_forest(level=5)}
PLACES = 12


def springs_of(mesh, device, rng, worlds=1):
    """Places in elements taken at random, of which the first lies on an edge, with stiffnesses of friction and pushes;
    and their weights as a matrix [worlds, places, nodes]."""
    count = len(mesh.points)
    nodes, weights = [], rng.dirichlet(np.ones(4), (worlds, PLACES)).astype(np.float32)
    weights[:, 0] = (0.5, 0.5, 0.0, 0.0)
    shares = np.zeros((worlds, PLACES, count))
    for world in range(worlds):
        tets = mesh.tets[rng.integers(len(mesh.tets), size=PLACES)]
        np.put_along_axis(shares[world], tets, weights[world], axis=1)
        nodes.append(tets + world * count)
    roots = rng.standard_normal((worlds * PLACES, 3, 2)).astype(np.float32)
    stiffness = 100.0 * roots @ roots.swapaxes(1, 2)
    arrays = [wp.array(np.concatenate(nodes), dtype=wp.vec4i, device=device)]
    arrays += [wp.array(weights.reshape(-1, 4), dtype=wp.vec4, device=device)]
    arrays += [wp.array(stiffness, dtype=wp.mat33, device=device)]
    return Springs(*arrays), shares, stiffness.reshape(worlds, PLACES, 3, 3)


def with_springs(mesh, device, springs, *, worlds=1, **options):
    operator = operator_of(mesh, device, fixed=np.zeros(worlds * len(mesh.points), bool), worlds=worlds, mass=MASS)
    multigrid = multigrid_of(operator, **options)
    multigrid.follow_springs(springs)
    multigrid.update(operator)
    return operator, multigrid


@pytest.mark.parametrize("name", FORESTS)
def test_each_level_gets_the_springs(name, device, rng):
    """The sum of P^T W^T K W P, and nothing remains of springs that were there before."""
    mesh = FORESTS[name]()
    springs, shares, stiffness = springs_of(mesh, device, rng, worlds=2)
    _operator, multigrid = with_springs(mesh, device, springs, worlds=2)
    plain = [level.blocks.numpy().copy() for level in multigrid.levels]
    before = [[dense(level, world) for level in multigrid.levels] for world in range(2)]
    inverses = [level.inverses.numpy().copy() for level in multigrid.levels]
    given = springs.stiffness.numpy().copy()
    springs.stiffness.assign(given[::-1].copy())
    multigrid.take_springs()
    springs.stiffness.assign(given)
    multigrid.take_springs()
    levels = multigrid.discretization.levels()
    places = np.concatenate([np.arange(levels.mesh_nodes), levels.others.numpy()])
    tree, nodes = TreeLevels.of(mesh.tree, len(mesh.lattice)), mesh_nodes(multigrid)
    finest = int(np.searchsorted(levels.starts, multigrid.levels[0].count)) - 1
    assert len(multigrid.levels) > 1
    for number, level in enumerate(multigrid.levels):
        depth = int(np.searchsorted(levels.starts, level.count)) - 1
        P = tree.prolongation(places, depth, finest)[: len(mesh.points)][:, nodes[: level.count]]
        for world in range(2):
            W = shares[world] @ P
            expected = np.einsum("pi,pab,pj->iajb", W, stiffness[world], W).reshape(3 * level.count, -1)
            found = dense(level, world) - before[world][number]
            atol = 20 * ROUNDING * np.abs(dense(level, world)).max()
            np.testing.assert_allclose(found, expected, rtol=0, atol=atol)
            assert np.abs(expected).max() > 100 * atol
    springs.stiffness.zero_()
    multigrid.take_springs()
    for level, blocks, inverse in zip(multigrid.levels, plain, inverses, strict=True):
        np.testing.assert_array_equal(level.blocks.numpy(), blocks)
        np.testing.assert_array_equal(level.inverses.numpy(), inverse)


@pytest.mark.parametrize("options", [{}, {"sweeps": 1}], ids=str)
def test_the_cycle_is_a_good_inverse_with_stiff_springs(options, device, rng):
    """Symmetric and positive definite; the springs are a hundred times as stiff as elements."""
    if "sweeps" in options and device != "cpu":
        pytest.skip("sweeps are the CPU's")
    mesh = mixed_forest(level=5)
    springs, shares, stiffness = springs_of(mesh, device, rng)
    operator, multigrid = with_springs(mesh, device, springs, **options)
    count = len(mesh.points)
    A = as_matrix(operator.apply, count, device)
    stiffness *= 100.0 * np.abs(A).max() / np.abs(stiffness).max()
    springs.stiffness.assign(stiffness.reshape(-1, 3, 3))
    multigrid.take_springs()
    A += np.einsum("pi,pab,pj->iajb", shares[0], stiffness[0], shares[0]).reshape(3 * count, -1)
    B = as_matrix(multigrid.apply, count, device)
    assert np.abs(B - B.T).max() < 100 * ROUNDING * np.abs(B).max()
    root = np.linalg.cholesky(0.5 * (B + B.T))
    values = np.linalg.eigvalsh(root.T @ (0.5 * (A + A.T)) @ root)
    print(f"eigenvalues of B A {values[0]:.3f} to {values[-1]:.3f}")
    assert values[0] > 0.05
    assert values[-1] < 1.01
