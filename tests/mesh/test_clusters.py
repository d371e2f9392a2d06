"""Surfaces that are thinned by levels, and made finer."""

import numpy as np
import pytest

import warp_corot as wc
from warp_corot.mesh.surfaces.bound import SurfaceMesh, distances_from
from warp_corot.mesh.surfaces.clustering import Clusters, longest_edge, split

BALL = 0.02


@pytest.fixture(scope="module")
def whole():
    return wc.TetForest.from_domain(wc.Domain.sphere(BALL), target_elements=2000).surface()


def surface(points, triangles):
    return SurfaceMesh(points, np.zeros((len(points), 4), np.int32), np.zeros((len(points), 4)), triangles)


def is_closed(triangles):
    """Whether each edge has as many triangles on one side as on the other."""
    ends = triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    return sorted(map(tuple, ends)) == sorted(map(tuple, ends[:, ::-1]))


def test_surfaces_are_thinned_where_levels_are_low(whole):
    clusters = Clusters(whole.points, whole.triangles, 0.02)
    low, high = np.full(len(whole.points), 4), np.full(len(whole.points), 7)
    top = whole.points[:, 2] > 0.0
    coarse, fine, mixed = (clusters.thinned(levels) for levels in (low, high, np.where(top, high, low)))
    assert len(coarse[0]) < len(mixed[0]) < len(fine[0]) < len(whole.points)
    for kept, triangles in (coarse, fine, mixed):
        assert is_closed(triangles)
        found = surface(whole.points[kept], triangles)
        assert found.euler_characteristic == 2
        assert found.volume == pytest.approx(whole.volume, rel=0.12)
    # Away from where levels change, the points are those of one level.
    for kept, far in ((coarse[0], whole.points[:, 2] < -0.009), (fine[0], whole.points[:, 2] > 0.009)):
        assert set(kept[far[kept]]) == set(mixed[0][far[mixed[0]]])


def test_small_pieces_stay(whole):
    """A ball and one that is smaller than the cubes."""
    points = np.concatenate([whole.points, 0.1 * whole.points + [0.05, 0.0, 0.0]])
    triangles = np.concatenate([whole.triangles, whole.triangles + len(whole.points)])
    kept, found = Clusters(points, triangles, 0.02).thinned(np.full(len(points), 3))
    assert is_closed(found)
    assert np.count_nonzero(kept >= len(whole.points)) == len(whole.points)


def test_split_triangles_have_the_same_shape(whole):
    points, triangles = split(whole.points, whole.triangles)
    finer = surface(points, triangles)
    assert len(triangles) == 4 * len(whole.triangles)
    assert is_closed(triangles)
    assert finer.volume == pytest.approx(whole.volume, rel=1e-12)
    assert finer.area == pytest.approx(whole.area, rel=1e-12)
    np.testing.assert_array_equal(points[: len(whole.points)], whole.points)
    sizes = np.ones(len(points))
    longest = longest_edge(whole.points, whole.triangles, sizes)
    assert longest_edge(points, triangles, sizes) == pytest.approx(0.5 * longest, rel=1e-12)


def test_levels_are_lowered_only_where_the_surface_keeps_its_shape(whole):
    """A ball of 20 mm: with points as far apart as that it would be more than 2 mm off."""
    clusters, count = Clusters(whole.points, whole.triangles, 0.02), len(whole.points)
    free = clusters.thinned(np.zeros(count, int))
    assert distances_from(whole.points[free[0]], free[1], whole.points, 1.0).max() > 2e-3
    levels, allowed = np.full(count, 9), np.full(count, 1e-3)
    for level in range(8, -1, -1):
        levels = clusters.lowered(levels, level, allowed)
    kept, triangles = clusters.thinned(levels)
    assert is_closed(triangles)
    assert distances_from(whole.points[kept], triangles, whole.points, 1.0).max() <= 1e-3
    assert len(kept) < 0.5 * len(clusters.thinned(np.full(count, 9))[0])
