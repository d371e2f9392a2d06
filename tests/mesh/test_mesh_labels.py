"""Bodies of several labels: regions of the mesh, and the surfaces between them."""

import numpy as np
import pytest
import trimesh
from bodies import ball
from meshes import as_trimesh, assert_balanced, assert_bound, held

import warp_corot as wc
from warp_corot.domain.fidelity import fidelity, held_volumes
from warp_corot.mesh.surfaces.marching import separated


def layered():
    """A ball with three labels: below a slanted plane, and above it left and right."""

    def labels(x):
        upper = np.where(x[:, 0] > 0.05, 3, 2)
        return np.where(x[:, 1] + 0.3 * x[:, 0] < 0.02, 1, upper).astype(np.int32)

    body = ball()
    body.labels, body.label_names = labels, ("fat", "left", "right")
    return body


@pytest.fixture(scope="module")
def labelled():
    return wc.TetForest.from_domain(layered(), 0.25, max_level=9)


def test_labels_become_regions(labelled):
    body, mesh = layered(), labelled
    middle = mesh.points[mesh.tets].mean(axis=1)
    away = np.ptp(body.labels(mesh.points)[mesh.tets], axis=1) == 0
    assert np.array_equal(mesh.labels[away], body.labels(middle)[away])
    assert (mesh.levels[~away] == 9).all()
    assert sum(mesh.elements_of(name) for name in body.label_names).tolist() == [1] * len(mesh.tets)
    for name in body.label_names:
        nodes = np.unique(mesh.tets[mesh.elements_of(name)])
        assert np.array_equal(np.flatnonzero(mesh.nodes_of(name)), nodes)
    assert any("label left" in line for line in mesh.summary())
    with pytest.raises(wc.InputError, match="fat, left, right"):
        mesh.elements_of("bone")
    with pytest.raises(wc.InputError, match="no label"):
        wc.TetForest.box().nodes_of("fat")


def test_surfaces_between_labels_are_closed_and_fit(labelled):
    surface = labelled.separating_surface()
    exact = layered()
    x = np.random.default_rng(0).uniform(-0.4, 0.4, (400_000, 3))
    inside = exact.function(x) < 0
    volumes = []
    for label in (1, 2, 3):
        one = surface.of_label(label)
        assert as_trimesh(one).is_watertight
        assert as_trimesh(one).is_winding_consistent
        volumes.append(one.volume)
        assert one.volume == pytest.approx(0.512 * (inside & (exact.labels(x) == label)).mean(), rel=0.05)
    outer = surface.triangles[surface.sides[:, 1] == 0]
    outer = trimesh.Trimesh(surface.points, outer, process=False)
    assert sum(volumes) == pytest.approx(outer.volume, rel=1e-9)
    assert outer.volume == pytest.approx(held(labelled), rel=2e-3)
    assert {tuple(s) for s in surface.sides} == {(1, 0), (2, 0), (3, 0), (2, 1), (3, 1), (3, 2)}
    assert_bound(surface, labelled)


@pytest.mark.parametrize("seed", range(3))
def test_random_labels_have_closed_surfaces_that_fill_the_box(seed):
    """Random labels give elements with two, three and four labels in all arrangements, without gaps or overlaps."""
    rng = np.random.default_rng(seed)
    box = wc.TetForest.box((2, 2, 2), 1.0, 4)
    values = np.full(len(box.points), -1.0)
    labels = rng.integers(1, 6, len(box.points))
    labels[((box.points == 0) | (box.points == 2)).any(axis=1)] = 1
    surface = separated(box.points, box.tets, values, labels)
    total = 0.0
    for label in range(2, 6):
        one = surface.of_label(label)
        assert_balanced(one)
        assert one.volume > 0
        total += one.volume
    assert total == pytest.approx(-surface.of_label(1).volume, rel=1e-9)


def five_labels() -> wc.Domain:
    """A scan of 905 ml, with labels from 860 ml to 783 mm^3 in it."""
    x = np.stack(np.meshgrid(*[1.5 * (np.arange(120) - 59.5)] * 3, indexing="ij"), axis=-1)
    voxels = np.zeros(x.shape[:3], np.uint8)
    for label, (middle, half) in enumerate(
        [
            ((0, 0, 0), (80, 60, 45)),
            ((30, 10, 5), (20, 20, 20)),
            ((-35, -10, 0), (12, 18, 10)),
            ((-5, 20, 10), (30, 3.5, 3.5)),
            ((10, -25, -12), (5.8, 5.8, 5.8)),
        ],
        start=1,
    ):
        voxels[(((x - middle) / half) ** 2).sum(axis=-1) < 1.0] = label
    return wc.Domain.from_labels(voxels, (1.5, 1.5, 1.5), unit="mm", device="cpu")


def test_each_label_has_its_share_of_elements_and_its_volume():
    scan = five_labels()
    mesh = wc.TetForest.from_domain(scan, target_elements=5_000, device="cpu")
    found = fidelity(mesh, scan, samples=500)
    assert [label.name for label in found.labels] == ["1", "2", "3", "4", "5"]
    for label in found.labels:
        assert label.elements >= 40  # 64, less what borders of few elements take
        assert abs(label.error) < 0.05
        assert label.volume == pytest.approx(held_volumes(mesh)[mesh.elements_of(label.name)].sum())
    assert sum("label" in line for line in found.report()) == 5
    assert found.doubts() == []
