"""Surfaces of meshes made from domains: their distance to the body's, closedness, and topology."""

import numpy as np
import pytest
from bodies import Body, ball, box_distance, turned_box, united, without
from meshes import HALF, SHAPES, TURN, as_trimesh, assert_balanced, farthest, off_surface, on_ball, on_box

import warp_corot as wc
from warp_corot.mesh.growing.fine_classification import inside_shares
from warp_corot.mesh.surfaces.marching import marched

LEVELS = (9, 12, 15)


@pytest.mark.parametrize("shape", SHAPES)
def test_surface_converges(shape):
    """Volume, area and Hausdorff distance of smooth bodies converge with the square of the edge length; a box loses its
    edges, cut by a fraction of the edge length: area and distance converge with the first power."""
    make, volume, area, sample, _ = SHAPES[shape]
    errors = []
    for level in LEVELS:
        body = make()
        surface = wc.TetForest.from_domain(body, 0.5, max_level=level).surface()
        hausdorff = max(off_surface(body, surface), farthest(surface, sample()))
        errors.append([abs(surface.volume / volume - 1), abs(surface.area / area - 1), hausdorff])
    orders = np.log2(np.array(errors[0]) / errors[-1]) / (len(LEVELS) - 1)
    expected = [2, 1, 1] if shape == "box" else [2, 2, 2]
    assert (orders > 0.8 * np.array(expected)).all(), orders
    assert errors[-1][0] < 0.02


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("error", [None, 4e-3])
def test_surface_is_closed_and_has_the_right_topology(shape, error, device):
    make, _, _, _, euler = SHAPES[shape]
    surface = wc.TetForest.from_domain(make(), 0.3, max_level=10, surface_error=error, device=device).surface()
    solid = as_trimesh(surface)
    assert solid.is_watertight
    assert solid.is_winding_consistent
    assert solid.euler_number == surface.euler_characteristic == euler
    assert solid.volume == pytest.approx(surface.volume, rel=1e-9)
    assert surface.volume > 0
    assert solid.area == pytest.approx(surface.area, rel=1e-9)


def test_surface_of_bodies_with_cavities_and_pieces():
    shell = without(ball(0.4), ball(0.25))
    pair = united(ball(0.2, (-0.3, 0, 0)), ball(0.1, (0.3, 0.1, 0)))
    for body, volume in ((shell, 4 / 3 * np.pi * (0.4**3 - 0.25**3)), (pair, 4 / 3 * np.pi * (0.2**3 + 0.1**3))):
        forest = wc.TetForest.from_domain(body, 0.25, max_level=9)
        surface = forest.surface()
        assert as_trimesh(surface).is_watertight
        assert surface.euler_characteristic == 4
        assert surface.volume == pytest.approx(volume, rel=0.05)
    assert any("2 separate pieces" in line for line in forest.summary())


@pytest.mark.parametrize("shape", ["ball", "ring"])
@pytest.mark.parametrize("error", [1e-2, 3e-3, 1e-3])
def test_surface_error_is_kept_by_smooth_bodies(shape, error, device):
    make, _, _, sample, _ = SHAPES[shape]
    body = make()
    surface = wc.TetForest.from_domain(body, 0.5, max_level=30, surface_error=error, device=device).surface()
    assert max(off_surface(body, surface), farthest(surface, sample())) < error


@pytest.mark.parametrize("error", [2e-2, 5e-3])
def test_surface_error_at_creases(error):
    """Sharp edges and corners, which samples miss, are kept, too."""
    body = turned_box(HALF, TURN)
    surface = wc.TetForest.from_domain(body, 0.3, max_level=30, surface_error=error).surface()
    assert off_surface(body, surface) < error
    assert farthest(surface, on_box()) < error


def test_a_function_that_is_no_distance():
    """x^2/a + y^2/b + z^2/c - 1 changes by 1/0.1 to 2/0.2 per metre: the error is still in metres."""
    axes = np.array([0.4, 0.3, 0.2])
    body = Body(lambda x: ((x / axes) ** 2).sum(axis=1) - 1, [-axes, axes], lipschitz=2 / 0.2 * np.sqrt(3) * 1.5)
    surface = wc.TetForest.from_domain(body, 0.25, max_level=24, surface_error=2e-3).surface()
    assert as_trimesh(surface).is_watertight
    assert surface.volume == pytest.approx(4 / 3 * np.pi * axes.prod(), rel=0.02)
    assert farthest(surface, on_ball(radius=1.0) * axes) < 2e-3


@pytest.mark.parametrize("seed", range(12))
def test_a_small_ball_in_one_root_cube_is_found(seed):
    rng = np.random.default_rng(seed)
    radius = 10 ** rng.uniform(-2.5, -0.7)
    centre = rng.uniform(radius, 1 - radius, 3)
    body = ball(radius, centre)
    body.bounds = np.array([[0.0] * 3, [1.0] * 3])
    surface = wc.TetForest.from_domain(body, 1.0, max_level=30, surface_error=0.05 * radius).surface()
    assert surface.euler_characteristic == 2
    assert surface.volume == pytest.approx(4 / 3 * np.pi * radius**3, rel=0.2)


@pytest.mark.parametrize(("scale", "shift"), [(1.0, 0.0), (0.3, 0.1), (0.007, -0.23)])
def test_a_body_on_the_lattice_is_exact(scale, shift):
    """A box whose faces are faces of cubes, even where float32 cannot represent their coordinates: no cut elements, no
    flat triangles, nothing outside."""
    half = scale * np.array([0.5, 0.25, 0.25])
    body = turned_box(half, np.eye(3))
    body.function = lambda x: box_distance(x - shift, half)
    body.bounds = body.bounds + shift
    forest = wc.TetForest.from_domain(body, 0.25 * scale, max_level=9, surface_error=1e-3 * scale)
    assert (forest.fill == 1).all()
    assert len(forest.points) == len(forest.lattice)
    surface = forest.surface()
    solid = as_trimesh(surface)
    assert solid.is_watertight
    assert surface.volume == pytest.approx(8 * half.prod(), rel=1e-12)
    assert surface.area == pytest.approx(2.5 * scale**2, rel=1e-12)
    assert solid.area_faces.min() > 1e-3 * scale**2


def test_a_body_that_sticks_out_of_its_bounds_ends_there(device):
    """And it is closed there. Beyond z = 0.3 a cap is missing, with volume pi h^2 (3 r - h) / 3, h = 0.1."""
    body = ball(0.4)
    body.bounds[1, 2] = 0.3
    surface = wc.TetForest.from_domain(body, 0.1, max_level=6, device=device).surface()
    assert as_trimesh(surface).is_watertight
    assert surface.points[:, 2].max() == pytest.approx(0.3)
    assert surface.volume == pytest.approx(np.pi * (4 / 3 * 0.4**3 - 0.1**2 * (3 * 0.4 - 0.1) / 3), rel=0.02)


@pytest.mark.parametrize("seed", range(4))
def test_marching_any_values(seed):
    """Random values give a closed surface. With many zeros there are no flat or duplicate triangles, and every edge
    is passed equally often in both directions."""
    rng = np.random.default_rng(seed)
    box = wc.TetForest.box((3, 3, 3), 1.0, 4)
    rim = ((box.points == 0) | (box.points == 3)).any(axis=1)
    values = rng.standard_normal(len(box.points))
    values[rim] = np.abs(values[rim])
    surface = marched(box.points, box.tets, values)
    assert as_trimesh(surface).is_watertight
    assert as_trimesh(surface).is_winding_consistent
    assert surface.volume == pytest.approx((inside_shares(values[box.tets]) * box.volumes).sum(), rel=1e-12)
    whole = np.round(values)
    assert (whole == 0).sum() > 20
    surface = marched(box.points, box.tets, whole)
    assert surface.volume == pytest.approx((inside_shares(whole[box.tets]) * box.volumes).sum(), rel=1e-12)
    assert as_trimesh(surface).area_faces.min() > 1e-9
    assert len(np.unique(np.sort(surface.triangles, axis=1), axis=0)) == len(surface.triangles)
    assert len(np.unique(surface.points, axis=0)) == len(surface.points)
    assert_balanced(surface)
