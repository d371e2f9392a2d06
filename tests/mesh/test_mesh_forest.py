"""Forests with void parts: their trees, refinement, forces and pieces."""

import itertools

import numpy as np
import pytest
import warp as wp
from bodies import ball, ring, united
from meshes import as_trimesh, assert_conforming, held

import warp_corot as wc
from warp_corot.mesh.growing.fine_classification import inside_shares


@pytest.fixture(scope="module")
def forest():
    return wc.TetForest.from_domain(ring(), 0.3, max_level=12, surface_error=2e-3)


def test_void_is_not_part_of_the_mesh(forest):
    tree = forest.tree
    assert (tree.first_child == -2).any()
    assert np.array_equal(np.sort(tree.leaves), np.flatnonzero(tree.first_child == -1))
    assert len(forest.lattice) > len(forest.points)
    touched = tree.tets[tree.first_child == -2]
    share = inside_shares(forest.phi[touched])
    assert share.max() < 0.02
    assert len(tree.tets) == 6 * np.prod(forest.cells) + 2 * (tree.first_child >= 0).sum()


@pytest.mark.parametrize("level", [0, 3, 6, 8, 9, 12])
def test_ancestors_stand_on_nodes(forest, level):
    """It is the highest one, not above the level, whose corners are nodes: no other up to the level qualifies."""
    tree, found = forest.tree, forest.ancestors(level)
    assert (tree.tets[found] < len(forest.points)).all()
    assert (tree.level[found] >= np.minimum(forest.levels, level)).all()
    corners = forest.points[tree.tets[found]]
    centroid = forest.points[forest.tets].mean(1) - corners[:, 0]
    weights = np.linalg.solve(np.swapaxes(corners[:, 1:] - corners[:, :1], 1, 2), centroid[..., None])[..., 0]
    assert (weights > -1e-12).all()
    assert (weights.sum(1) < 1 + 1e-12).all()
    climbing = tree.parent[found]
    while (climbing := climbing[(climbing >= 0) & (tree.level[climbing] >= level)]).size:
        assert (tree.tets[climbing].max(axis=1) >= len(forest.points)).all()
        climbing = tree.parent[climbing]


def test_refining_keeps_nodes_volume_and_surface(forest):
    rng = np.random.default_rng(3)
    chosen = rng.random(len(forest.tets)) < 0.1
    refined = forest.refine(chosen)
    assert np.array_equal(refined.points[: len(forest.points)], forest.points)
    assert len(refined.tets) > len(forest.tets)
    assert_conforming(refined)
    assert held(refined) == pytest.approx(held(forest), rel=1e-12)
    surface = refined.surface()
    assert as_trimesh(surface).is_watertight
    assert surface.volume == pytest.approx(forest.surface().volume, rel=1e-9)
    assert np.array_equal(np.unique(refined.tets), np.arange(len(refined.points)))
    again = refined.refine(np.arange(5))
    assert_conforming(again)
    assert held(again) == pytest.approx(held(forest), rel=1e-12)


@pytest.mark.parametrize("rotation_level", [None, 6, 9])
def test_forces_by_subtrees_are_those_of_the_leaves(forest, rotation_level, device, rng):
    body = wc.SoftBody(forest, wc.Isotropic(1e4, 0.4, 1000.0), device=device)
    u = np.zeros((body.node_count, 4), np.float32)
    u[:, :3] = 5e-4 * rng.standard_normal(forest.points.shape)
    found = []
    for subtrees in (True, False):
        given, f = wp.array(u, dtype=wp.vec4, device=device), wp.zeros(len(u), dtype=wp.vec4, device=device)
        wc.Corotated(rotation_level=rotation_level, subtrees=subtrees).bind(body).add_forces(given, f)
        found.append(f.numpy()[:, :3])
    assert np.abs(found[0] - found[1]).max() < 1e-5 * np.abs(found[1]).max()


def test_the_largest_piece_alone():
    pair = united(ball(0.2, (-0.3, 0, 0)), ball(0.1, (0.3, 0.1, 0)))
    both = wc.TetForest.from_domain(pair, 0.25, max_level=9)
    piece = both.pieces()
    assert np.array_equal(piece, np.where(both.points[both.tets].mean(axis=1)[:, 0] > 0.05, 1, 0))
    one = both.largest_piece()
    assert len(one.tets) == (piece == 0).sum()
    assert held(one) == pytest.approx((both.fill * both.volumes)[piece == 0].sum(), rel=1e-12)
    surface = one.surface()
    assert surface.euler_characteristic == 2
    assert surface.volume == pytest.approx(held(one), rel=1e-11)
    assert_conforming(one)
    assert one.largest_piece() is one
    assert wc.TetForest.box().largest_piece().pieces().tolist() == [0] * 6


@pytest.mark.parametrize("far", [1e2, 1e8, 1e20, 1e300])
def test_far_points_are_bound_to_elements_on_their_side(forest, far):
    middle = forest.points.mean(axis=0)
    for axis, sign in itertools.product(range(3), (-1.0, 1.0)):
        (element,), _ = forest.embed([middle + sign * far * np.eye(3)[axis]])
        outermost = (sign * forest.points[:, axis]).max()
        assert (sign * forest.points[forest.tets[element], axis]).max() == pytest.approx(outermost, abs=1e-3)
