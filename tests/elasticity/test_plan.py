"""The fast force path: every leaf is computed once, and the forces equal those leaf by leaf."""

import numpy as np
import pytest
import warp as wp
from plan_oracle import complete_subtrees

import warp_corot as wc
from warp_corot.discretization.plan import Sharing
from warp_corot.discretization.planner import ForcePlan
from warp_corot.kernels.elements.shapes import STIFFNESS_LAMBDA, STIFFNESS_MU
from warp_corot.kernels.tables import subtree

MATERIAL = wc.Isotropic(young=1e4, poisson=0.4, density=1000.0)


def mixed(level, rng, rounds=3):
    forest = wc.TetForest.box((2, 1, 1), 0.1, level)
    for _ in range(rounds):
        forest = forest.refine(rng.choice(len(forest.tets), 5, replace=False))
    return forest


def forces(body, model, u):
    padded = np.zeros((body.node_count, 4), np.float32)
    padded[:, :3] = u
    device_u = wp.array(padded, dtype=wp.vec4, device=body.device)
    f = wp.zeros_like(device_u)
    model.bind(body).add_forces(device_u, f)
    return f.numpy()[:, :3]


@pytest.mark.parametrize("level", [2, 5, 7])
@pytest.mark.parametrize("rotation_level", [None, 0, 2, 3, 4, 5, 6, 9])
def test_every_leaf_is_computed_once(level, rotation_level, device, rng):
    forest = mixed(level, rng)
    plan = ForcePlan.of_forest(forest, rotation_level, wp.get_device(device))
    done = [plan.flat.leaves.numpy()]
    for batch in plan.batches:
        first = batch.subtrees.first.numpy()
        assert len(first) == batch.count
        leaves = first[:, None] + np.arange(8)
        assert (forest.levels[leaves] % 3 == batch.shape).all()
        assert (forest.levels[leaves] == forest.levels[first][:, None]).all()
        done.append(leaves.ravel())
        root = forest.levels[first] - 3
        if batch.sharing is Sharing.ABOVE:
            assert (root > rotation_level).all()
        elif batch.sharing is Sharing.ROOT:
            assert (root == rotation_level).all()
        elif rotation_level is not None:
            assert (forest.levels[first] <= rotation_level).all()
    assert np.array_equal(np.sort(np.concatenate(done)), np.arange(len(forest.tets)))


@pytest.mark.parametrize("depth", [3, 6])
def test_complete_subtrees_are_those_of_the_tree(depth, rng):
    forest = mixed(6, rng)
    tree, leaves = forest.tree, forest.tree.leaves
    expected = []
    for root in range(len(tree.tets)):
        below = [root]
        for _ in range(depth):
            below = [c for p in below if tree.first_child[p] >= 0 for c in tree.first_child[p] + np.arange(2)]
        if len(below) == 2**depth and (tree.first_child[below] < 0).all():
            expected.append(np.flatnonzero(leaves == below[0])[0])
    assert np.array_equal(complete_subtrees(forest, depth), np.sort(expected))


@pytest.mark.parametrize("rotation_level", [None, 3, 5, 6, 9])
@pytest.mark.parametrize("uniform", [True, False])
@pytest.mark.parametrize("level", [8, 9, 10])
def test_subtrees_give_the_forces_of_their_leaves(level, rotation_level, uniform, device, rng):
    """On thousands of elements of each type, so that a wrongly compiled kernel shows in any lane.

    Rotations agree to 1e-6 (their last iteration's error), so forces do to some 1e-6 of the largest.
    """
    forest = mixed(level, rng)
    young = 1e4 if uniform else 1e4 * (1 + rng.random(len(forest.tets)))
    body = wc.SoftBody(forest, wc.Isotropic(young, 0.4, 1000.0), device=device)
    edge = 0.1 * 0.5 ** (forest.levels.max() // 3)
    u = 0.1 * edge * rng.standard_normal(forest.points.shape) + [0.3, -0.2, 0.1]
    fast = forces(body, wc.Corotated(rotation_level=rotation_level), u)
    slow = forces(body, wc.Corotated(rotation_level=rotation_level, subtrees=False), u)
    assert np.abs(fast - slow).max() < 1e-5 * np.abs(slow).max()


@pytest.mark.parametrize("rotation_level", [None, 3])
def test_leaves_that_the_fast_iteration_fails_on_are_flagged_and_repaired(rotation_level, device, rng):
    """Inverted, flat, tiny and hugely stretched leaves; the number of flags shows that the second kernel had work."""
    forest = wc.TetForest.box((2, 2, 1), 0.1, 6)
    body = wc.SoftBody(forest, MATERIAL, device=device)
    u = 1e-3 * rng.standard_normal(forest.points.shape)
    left = forest.points[:, 0] < 0.05
    u[left] += 0.05 * rng.standard_normal((left.sum(), 3))  # turned over
    flat = forest.points[:, 0] > 0.15
    u[flat, 2] = -forest.points[flat, 2]  # pressed to a plane
    small = (forest.points[:, 1] > 0.15) & ~left & ~flat
    u[small] -= forest.points[small]  # shrunk to a hundredth
    model = wc.Corotated(rotation_level=rotation_level)
    fast = forces(body, model, u)
    slow = forces(body, wc.Corotated(rotation_level=rotation_level, subtrees=False), u)
    # Where singular values nearly meet, an inverted element's rotation is ill-conditioned: so most, not all.
    error = np.abs(fast - slow).max(axis=1) / np.abs(slow).max()
    assert np.percentile(error, 95) < 1e-5
    field = model.bind(body)
    field.add_forces(body.state.displacements, body.state.forces)
    assert sum(np.count_nonzero(batch.flagged.numpy()) for batch in field.plan.batches) == 0  # at rest: none
    body.displacements = u
    field.add_forces(body.state.displacements, body.state.forces)
    flagged = sum(np.count_nonzero(batch.flagged.numpy()) for batch in field.plan.batches)
    if wp.get_device(device).is_cuda and rotation_level is None:  # so few leaves are in clusters, which have no flags
        return
    assert 0 < flagged < sum(batch.count for batch in field.plan.batches)


@pytest.mark.parametrize("model", [wc.Corotated(), wc.Corotated(rotation_level=3)], ids=["own", "shared"])
@pytest.mark.parametrize("level", [3, 6, 7, 8])
def test_subtrees_at_rest_have_no_force(model, level, device):
    body = wc.SoftBody(wc.TetForest.box((1, 1, 2), 0.064, level), MATERIAL, device=device)
    edge = 0.064 * 0.5 ** (level // 3)
    f = forces(body, model, np.zeros((body.node_count, 3)))
    # Types 0 and 1 have whole numbers for columns: exactly none. Type 2 has roots of a half, correct to rounding.
    assert np.abs(f).max() <= (0.0 if level % 3 < 2 else 1e-6 * 1e4 * edge**2)


@pytest.mark.parametrize("count", [1, 7, 8, 9, 17])
def test_general_elements_fill_any_number_of_lanes(count, device, rng):
    forest = wc.TetForest.box((1, 1, 1), 0.1, 3)
    mesh = wc.TetMesh(forest.points + 0.003 * rng.standard_normal(forest.points.shape), forest.tets[:count])
    body = wc.SoftBody(mesh, MATERIAL, device=device)
    u = 0.005 * rng.standard_normal(mesh.points.shape)
    u[mesh.tets[0, 0]] += mesh.points[mesh.tets[0, 1:]].mean(0) * 3 - mesh.points[mesh.tets[0, 0]]  # one turned over
    fast = forces(body, wc.Corotated(), u)
    slow = forces(body, wc.Corotated(subtrees=False), u)
    assert np.abs(fast - slow).max() < 1e-5 * np.abs(slow).max()


@pytest.mark.parametrize("shape", range(3))
def test_subtree_tables(shape):
    """Ten nodes, or 35 (37 for type 2) for six levels; the stiffness of a subtree is the sum over its leaves."""
    assert len(subtree.POSITIONS[shape]) == 10
    assert len(subtree.group_nodes(shape)) == (37 if shape == 2 else 35)
    assert sum(map(len, subtree.group_sources(shape))) == 80
    frames = np.array(subtree.FRAMES[shape])
    np.testing.assert_allclose(np.einsum("lca,lda->lcd", frames, frames), np.tile(np.eye(3), (8, 1, 1)), atol=1e-12)
    for part, table in zip(subtree.stiffness(shape), (STIFFNESS_LAMBDA[shape], STIFFNESS_MU[shape]), strict=True):
        total = np.zeros((30, 30))
        for leaf, frame in zip(subtree.LEAVES[shape], frames, strict=True):
            turn = np.kron(np.eye(4), frame.T)
            at = (3 * np.array(leaf)[:, None] + np.arange(3)).ravel()
            total[np.ix_(at, at)] += 0.5 * turn @ np.array(table) @ turn.T
        np.testing.assert_allclose(part, total, atol=1e-12)
        np.testing.assert_allclose(part, np.transpose(part), atol=1e-12)
