"""Elements that a surface cuts: their contents, and the treatment of nearly empty ones."""

import numpy as np
import pytest
from meshes import PAIRS, SHAPES, as_trimesh, assert_bound, held
from scipy.spatial import ConvexHull

import warp_corot as wc
from warp_corot.mesh.growing.fine_classification import inside_shares, label_shares
from warp_corot.mesh.growing.slivers import merged
from warp_corot.mesh.topology import face_pairs


def test_share_inside_is_the_volume_of_the_convex_hull():
    rng = np.random.default_rng(1)
    values = rng.standard_normal((200, 4))
    corner = np.vstack([np.zeros(3), np.eye(3)])
    for value, share in zip(values, inside_shares(values), strict=True):
        if (value >= 0).all():
            assert share == 0
            continue
        points = [corner[value < 0]]
        for i, j in PAIRS:
            if (value[i] < 0) != (value[j] < 0):
                points.append((corner[i] * value[j] - corner[j] * value[i])[None] / (value[j] - value[i]))
        assert share == pytest.approx(6 * ConvexHull(np.concatenate(points)).volume, rel=1e-9)


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("sliver", [0.0, 0.02, 0.3])
def test_filled_volumes_add_up_to_the_enclosed_volume(shape, sliver):
    forest = wc.TetForest.from_domain(SHAPES[shape][0](), 0.3, max_level=9, surface_error=3e-3, sliver=sliver)
    surface = forest.surface()
    assert held(forest) == pytest.approx(surface.volume, rel=1e-11)
    assert forest.fill.min() > sliver * (1 - 1e-12)
    named = np.zeros(len(forest.points), bool)
    named[forest.tets] = True
    assert named.all()
    assert as_trimesh(surface).is_watertight
    assert_bound(surface, forest)


def test_slivers_without_other_neighbours_go_to_the_fullest():
    box = wc.TetForest.box((1, 1, 1), 1.0, 3)
    pairs = face_pairs(box.tets)
    rng = np.random.default_rng(2)
    volumes = rng.random(len(box.tets))
    after, gone = merged(pairs, volumes, np.ones(len(volumes), bool))
    assert gone.sum() == len(volumes) - 1
    assert not gone[np.argmax(volumes)]
    assert after.sum() == pytest.approx(volumes.sum())
    small = rng.random(len(volumes)) < 0.4
    after, gone = merged(pairs, volumes, small)
    assert np.array_equal(gone, small)
    assert after.sum() == pytest.approx(volumes.sum())
    assert (after[~gone] >= volumes[~gone]).all()
    # The contents of a single one go to the fullest neighbour across a face.
    alone = np.arange(len(volumes)) == 17
    after, gone = merged(pairs, volumes, alone)
    shared = (box.tets[:, :, None] == box.tets[17]).any(axis=2).sum(axis=1)
    taker = max(np.flatnonzero(shared == 3), key=lambda t: volumes[t])
    assert np.flatnonzero(after > volumes).tolist() == [taker]


def of_labels(values, labels, count):
    """Shares of the labels 0 to count [n, count + 1]."""
    found = np.zeros((len(values), count + 1))
    np.add.at(found, (np.arange(len(values))[:, None], labels), label_shares(values, labels))
    return found


def test_label_shares_fill_what_is_inside():
    rng = np.random.default_rng(6)
    values, labels = rng.standard_normal((500, 4)), rng.integers(1, 4, (500, 4))
    shares = of_labels(values, labels, 3)
    assert np.allclose(shares.sum(axis=1), inside_shares(values), atol=1e-12)
    assert (shares >= 0).all()
    pure = np.ptp(labels, axis=1) == 0
    assert np.allclose(shares[pure, labels[pure, 0]], inside_shares(values[pure]))
    # Two labels, all inside: the corner at one node is an eighth, the wedge at two nodes a half.
    shares = of_labels(-np.ones((2, 4)), np.array([[1, 2, 2, 2], [1, 2, 1, 2]]), 2)
    assert np.allclose(shares, [[0, 1 / 8, 7 / 8], [0, 1 / 2, 1 / 2]])
