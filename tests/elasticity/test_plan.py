"""The plan of forces over subtrees: every leaf is computed once; test_miscompile has the forces."""

import numpy as np
import pytest
import warp as wp
from plan_oracle import complete_subtrees

import warp_corot as wc
from warp_corot.discretization.plan import Sharing
from warp_corot.discretization.planner import ForcePlan
from warp_corot.kernels.elements.shapes import STIFFNESS_LAMBDA, STIFFNESS_MU
from warp_corot.kernels.tables import subtree


def mixed(level, rng, rounds=3):
    forest = wc.TetForest.box((2, 1, 1), 0.1, level)
    for _ in range(rounds):
        forest = forest.refine(rng.choice(len(forest.tets), 5, replace=False))
    return forest


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
