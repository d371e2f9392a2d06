"""Meshes of scans, sets and surfaces: as conforming and well shaped as those of formulas; savings by adaptivity."""

import numpy as np
import pytest
import trimesh
from meshes import assert_balanced, assert_conforming, assert_well_shaped
from scipy.ndimage import gaussian_filter
from studies import study

import warp_corot as wc

SAVINGS = study("mesh_savings")


def scan():
    """Random blobs of two labels on an oblique lattice."""
    noise = gaussian_filter(np.random.default_rng(7).standard_normal((2, 24, 28, 20)), (0, 3, 3, 3))
    voxels = np.where(noise[0] > 0.01, np.where(noise[1] > 0, 2, 1), 0)
    affine = np.eye(4)
    affine[:3, :3] = 1e-3 * np.array([[1.8, 0.5, 0.0], [-0.6, 2.1, 0.0], [0.0, 0.1, 2.5]])
    return wc.Domain.from_labels(voxels, affine=affine, labels={"a": 1, "b": 2}, smoothing=1e-3)


def knobs():
    """A torus minus a capsule, with a ball on it."""
    ring = wc.Domain.torus(0.03, 0.01) - wc.Domain.capsule((-0.06, 0, 0), (0.06, 0, 0), 0.004)
    return ring | wc.Domain.sphere(0.006, (0.0, 0.04, 0.0))


def star():
    """A surface with sharp edges and thin tips."""
    solid = trimesh.creation.icosphere(subdivisions=1, radius=0.02)
    solid.vertices[::3] *= 2.0
    return wc.Domain.from_surface((solid.vertices, solid.faces))


@pytest.mark.parametrize("make", [scan, knobs, star])
@pytest.mark.parametrize("sliver", [0.02, 0.3])
def test_every_mesh_is_conforming_and_well_shaped(make, sliver):
    mesh = wc.TetForest.from_domain(make(), 0.02, max_level=11, surface_error=5e-4, sliver=sliver)
    assert len(set(mesh.levels)) >= 3
    assert_conforming(mesh)
    assert_well_shaped(mesh)
    assert_balanced(mesh.surface())


@pytest.fixture(scope="module", params=[15, pytest.param(18, marks=pytest.mark.slow)])
def deepest(request):
    return request.param


@pytest.fixture(scope="module")
def points(deepest):
    return SAVINGS.study(levels=tuple(range(9, deepest + 1, 3)), errors=(16e-3, 8e-3))


def test_adaptive_meshes_are_as_near_as_uniform_ones(points, deepest):
    """For the ball at the same level: the Hausdorff distance falls to a quarter if edges are halved."""
    error = {(p.kind, p.level): p.error for p in points if p.name == "ball"}
    for level in range(9, deepest + 1, 3):
        assert error["adaptive", level] == pytest.approx(error["uniform", level], rel=0.05)
    assert error["uniform", deepest - 6] / error["uniform", deepest] == pytest.approx(16.0, rel=0.3)


def test_adaptive_meshes_need_fewer_tetrahedra(points, deepest):
    """Tetrahedra of a surface scale with 1/h^2, of a volume with 1/h^3: in the end the ratio halves in three levels."""
    ratio = SAVINGS.ratios_by_level(points)
    assert 0.4 < ratio[15] < 0.5
    assert ratio[deepest] / ratio[deepest - 3] == pytest.approx({15: 0.64, 18: 0.55}[deepest], abs=0.06)
    if deepest == 18:  # uniform meshes need that level to come as near
        spiny = SAVINGS.ratios_by_error(points)
        assert spiny
        assert max(spiny.values()) < 0.1


def test_study_is_written(points, tmp_path):
    assert len(SAVINGS.table(points)) == len(points) + 3
    SAVINGS.draw(points, tmp_path / "lod.png")
    assert (tmp_path / "lod.png").read_bytes().startswith(b"\x89PNG")
