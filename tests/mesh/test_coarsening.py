"""Coarser meshes from a forest: conforming, no finer than requested, with the predicted number of elements."""

import numpy as np
import pytest

import warp_corot as wc
from warp_corot.mesh.growing.fine_classification import BELOW, Coarsening, Resolved
from warp_corot.mesh.growing.growth import Growing
from warp_corot.mesh.growing.refinement_criteria import Wishes
from warp_corot.mesh.tree import LIVE


@pytest.fixture(scope="module")
def resolved(request):
    import warp as wp

    domain = wc.Domain.torus(0.35, 0.12, device="cpu") | wc.Domain.sphere(0.2, (0.3, 0.0, 0.1), device="cpu")
    growing = Growing(domain, 0.25, Wishes(0.002, 0, 7), wp.get_device("cpu"))
    growing.run()
    return Resolved(growing.grown(), 0.25, domain)


def bisected(resolved: Resolved, needs: np.ndarray, least: float) -> np.ndarray:
    """Reference bisection, round by round: elements that need it, and those with a node on an edge."""
    tree, ends = resolved.grown.tree, resolved.grown.ends
    between = {(int(a), int(b)): node for node, (a, b) in enumerate(ends) if a >= 0}
    holds = resolved.held > 0.0
    leaves = set(np.flatnonzero(tree.parent < 0).tolist())
    done, nodes = np.zeros(len(needs), bool), set()
    while True:
        split = []
        for leaf in leaves:
            if tree.first_child[leaf] < 0 or not holds[leaf]:
                continue
            corners = sorted(tree.tets[leaf].tolist())
            middles = {between.get((a, b)) for n, a in enumerate(corners) for b in corners[n + 1 :]}
            if needs[leaf] > least or middles & nodes:
                split.append(leaf)
        if not split:
            return done
        for leaf in split:
            below = tree.first_child[leaf]
            leaves.remove(leaf)
            leaves |= {int(below), int(below) + 1}
            done[leaf] = True
            (new,) = set(tree.tets[below].tolist()) - set(tree.tets[leaf].tolist())
            nodes.add(new)


@pytest.mark.parametrize("seed", [0, 1])
def test_one_sweep_finds_what_rounds_find(resolved, seed):
    rng = np.random.default_rng(seed)
    # A few need much, so that conformity spreads.
    needs = np.where(rng.random(len(resolved.held)) < 0.01, rng.random(len(resolved.held)), 0.0)
    needs = resolved.largest(np.where(resolved.held > 0.0, needs, 0.0)).astype(np.float32)
    coarsening = Coarsening(resolved, needs, 0.02)
    for least in (0.0, 0.3, 0.9):
        count, child = coarsening.mesh(least)
        assert np.array_equal(child >= 0, bisected(resolved, needs, least))
        leaf = child == LIVE
        assert count == np.count_nonzero(leaf & (resolved.held >= 0.02 * resolved.volume))
        parent = resolved.grown.tree.parent
        there = child != BELOW
        assert (child[parent[there & (parent >= 0)]] >= 0).all()


def test_no_threshold_gives_more_elements_of_those_allowed(resolved):
    rng = np.random.default_rng(3)
    # Leaves, which have no children, need it, too.
    needs = np.zeros(len(resolved.held))
    chosen = rng.choice(resolved.leaves, len(resolved.leaves) // 30, replace=False)
    needs[chosen] = rng.random(len(chosen))
    needs = resolved.largest(np.where(resolved.held > 0.0, needs, 0.0)).astype(np.float32)
    coarsening = Coarsening(resolved, needs, 0.02)
    counts = np.array([coarsening.mesh(least)[0] for least in np.append(np.unique(needs), 0.0)])
    assert len(np.unique(counts)) > 40
    for target in np.quantile(counts, np.linspace(0.1, 0.9, 9)).astype(int) + 1:
        found = coarsening.mesh(coarsening.threshold_of(target, 0.0))[0]
        assert found == counts[counts <= target].max()
    assert coarsening.threshold_of(10**9, 0.25) == 0.25
