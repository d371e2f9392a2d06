"""Surfaces with fewer points."""

import numpy as np
import pytest

import warp_corot as wc
from warp_corot.mesh.surfaces.clustering import clustered


def edges_of(surface):
    """Edges with a direction, as numbers, and the same edges in the other direction."""
    ends, count = surface.triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).astype(np.int64), len(surface.points)
    return np.sort(ends @ [count, 1]), np.sort(ends @ [1, count])


@pytest.mark.parametrize("domain", [wc.Domain.sphere(0.05), wc.Domain.torus(0.05, 0.02)])
def test_a_coarser_surface_is_closed_and_near(domain):
    surface = wc.TetForest.from_domain(domain, target_elements=6000).surface()
    size = 0.006
    coarse = clustered(surface, np.full(len(surface.points), size))
    assert len(coarse.points) < 0.6 * len(surface.points)
    np.testing.assert_array_equal(*edges_of(coarse))
    assert coarse.euler_characteristic == surface.euler_characteristic
    assert coarse.volume == pytest.approx(surface.volume, rel=0.03)
    # Each point is one of the given, with its nodes and weights.
    whole = np.column_stack([surface.points, surface.nodes, surface.weights])
    own = np.column_stack([coarse.points, coarse.nodes, coarse.weights])
    assert len(np.unique(np.vstack([whole, own]), axis=0)) == len(np.unique(whole, axis=0))
    lengths = np.linalg.norm(coarse.points[coarse.triangles] - coarse.points[np.roll(coarse.triangles, 1, 1)], axis=2)
    assert np.percentile(lengths, 5) > 0.3 * size
    assert lengths.max() < 4.0 * size


def test_the_two_sides_of_a_sheet_stay_two():
    domain = wc.Domain.box((-0.05, -0.05, -0.002), (0.05, 0.05, 0.002))
    surface = wc.TetForest.from_domain(domain, cell_size=0.01, max_level=6).surface()
    coarse = clustered(surface, np.full(len(surface.points), 0.012))
    np.testing.assert_array_equal(*edges_of(coarse))
    middle = np.abs(coarse.points[:, :2]).max(axis=1) < 0.03
    assert (coarse.points[middle, 2] > 0.001).sum() > 10
    assert (coarse.points[middle, 2] < -0.001).sum() > 10
    assert coarse.volume == pytest.approx(surface.volume, rel=0.25)


def test_a_piece_that_is_smaller_than_a_cube_stays_as_it_is():
    near, far = wc.Domain.sphere(0.01), wc.Domain.sphere(0.003, (0.02, 0.0, 0.0))
    surface = wc.TetForest.from_domain(near | far, cell_size=0.004, max_level=6).surface()
    coarse = clustered(surface, np.full(len(surface.points), 0.01))
    small, left = (each.points[:, 0] > 0.015 for each in (surface, coarse))
    assert 0 < left.sum() == small.sum()
    assert (~left).sum() < 0.5 * (~small).sum()
    np.testing.assert_array_equal(*edges_of(coarse))
    assert coarse.euler_characteristic == 4
