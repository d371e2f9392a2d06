"""Groups of neighbouring elements of general meshes."""

import numpy as np
import pytest
from cases import jittered
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

import warp_corot as wc
from warp_corot.discretization.groups import MOST, SMALL, neighbour_groups
from warp_corot.mesh.topology import face_pairs


def general(level):
    forest = wc.TetForest.box((1, 1, 3), 0.064, level)
    return np.asarray(forest.points), np.asarray(forest.tets)


@pytest.mark.parametrize("level", [3, 6, 8])
def test_groups_have_about_eight_elements(level):
    group = neighbour_groups(*general(level))
    sizes = np.bincount(group)
    assert sizes.min() >= SMALL
    assert sizes.max() <= MOST
    assert sizes.mean() >= 7


@pytest.mark.parametrize("level", [3, 6])
def test_groups_are_connected(level):
    """The elements of one group are connected by faces."""
    points, tets = general(level)
    group = neighbour_groups(points, tets)
    pairs = face_pairs(tets)
    inside = pairs[group[pairs[:, 0]] == group[pairs[:, 1]]]
    edges = coo_matrix((np.ones(len(inside)), inside.T), (len(tets), len(tets)))
    pieces, piece = connected_components(edges, directed=False)
    assert pieces == group.max() + 1
    assert len(np.unique(np.stack([piece, group]), axis=1).T) == pieces


def test_faces_are_those_of_two_elements():
    tets = np.array([[0, 1, 2, 3], [3, 2, 1, 4], [5, 6, 7, 8]])
    assert face_pairs(tets).tolist() in ([[0, 1]], [[1, 0]])


def test_the_order_of_elements_does_not_change_the_number_of_groups(rng):
    """The order of the nodes does not change it either. If several neighbours are equally near, which of them join may
    change."""
    mesh = jittered()
    order = rng.permutation(len(mesh.tets))
    turned = np.asarray(mesh.tets)[order][:, [1, 2, 0, 3]]
    here, there = (neighbour_groups(mesh.points, tets) for tets in (mesh.tets, turned))
    assert len(np.bincount(there)) == pytest.approx(len(np.bincount(here)), rel=0.1)


def test_single_elements_are_groups():
    """Also elements that share no face with others; a mesh may have none that do."""
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]])
    both = np.concatenate([points, points + 5.0])
    assert neighbour_groups(points, np.array([[0, 1, 2, 3]])).tolist() == [0]
    assert sorted(neighbour_groups(both, np.array([[0, 1, 2, 3], [4, 5, 6, 7]]))) == [0, 1]
