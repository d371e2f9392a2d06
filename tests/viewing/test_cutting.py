"""Cuts: closed surfaces of the right volume and section, which move with the body."""

import numpy as np
import pytest

import warp_corot as wc
from warp_corot.viewing.shown import MARCHED, Plane, cut, surfaces_of


def box():
    return wc.TetForest.box(cells=(1, 1, 2), cell_size=0.1, level=5)


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("flipped", [False, True])
def test_what_is_left_is_closed_and_as_large_as_it_should_be(axis, flipped):
    mesh = box()
    surface = next(iter(surfaces_of(mesh).values()))
    half = cut(surface, mesh, Plane(axis, 0.37, flipped))
    assert half.volume == pytest.approx((1 - 0.37 if flipped else 0.37) * 0.002, rel=1e-6)
    assert half.weights.sum(axis=1) == pytest.approx(1.0)
    size = [0.1, 0.1, 0.2]
    a, b, c = np.moveaxis(half.points[half.triangles], 1, 0)
    on_plane = np.ptp(np.stack([a, b, c])[..., axis], axis=0) < 1e-12
    there = np.abs(a[:, axis] - (1 - 0.37 if False else 0.37) * size[axis]) < 1e-9
    area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)[on_plane & there].sum()
    assert area == pytest.approx(0.002 / size[axis], rel=1e-6)


def test_a_cut_moves_as_its_body_does():
    mesh = box()
    half = cut(next(iter(surfaces_of(mesh).values())), mesh, Plane(2, 0.4))
    stretch = np.array([[0.1, 0.2, 0.0], [0.0, -0.1, 0.3], [0.05, 0.0, 0.2]])
    np.testing.assert_allclose(half.moved(mesh.points @ stretch), half.points + half.points @ stretch, atol=1e-12)


def test_the_section_of_an_organ_ends_at_its_surface():
    trimesh = pytest.importorskip("trimesh")
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.05)
    mesh = wc.TetForest.from_domain(wc.Domain.from_surface((ball.vertices, ball.faces)), target_elements=3000)
    half = cut(surfaces_of(mesh)[MARCHED], mesh, Plane(0, 0.5))
    assert half.volume == pytest.approx(0.5 * mesh.surface().volume, rel=0.01)
    assert np.linalg.norm(half.points, axis=1).max() < 0.0515
    np.testing.assert_allclose(half.moved(0.3 * mesh.points), 1.3 * half.points, atol=2e-3)


def test_a_plane_beyond_the_body_leaves_it_whole():
    mesh = box()
    surface = next(iter(surfaces_of(mesh).values()))
    assert cut(surface, mesh, Plane(0, 1.5)).volume == pytest.approx(surface.volume)
    assert len(cut(surface, mesh, Plane(0, -0.5)).triangles) == 0
