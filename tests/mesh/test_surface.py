"""Surfaces and points bound to a mesh: their binding and their motion."""

import numpy as np
import pytest
import trimesh
import warp as wp
from bodies import ball, ring
from cases import mixed_forest

import warp_corot as wc
from warp_corot.mesh import SurfaceMesh

STRETCH = np.array([[0.2, 0.1, -0.3], [0.05, -0.1, 0.2], [0.3, 0.0, 0.15]])


@pytest.fixture(scope="module")
def forest():
    return wc.TetForest.from_domain(ring(), 0.3, max_level=9)


def barycentric(forest, elements, points):
    """Weights by Cramer's rule: volumes of the four tetrahedra between a point and the faces."""
    x = forest.points[forest.tets[elements]]
    whole = np.linalg.det(x[:, 1:] - x[:, :1])
    found = []
    for n in range(4):
        moved = x.copy()
        moved[:, n] = points
        found.append(np.linalg.det(moved[:, 1:] - moved[:, :1]) / whole)
    return np.stack(found, axis=1)


def test_points_sit_on_edges_between_inside_and_outside(forest):
    surface = forest.surface()
    on_edge = (surface.weights[:, 2:] == 0).all(axis=1)
    assert on_edge.mean() > 0.8
    inner, outer = surface.ends[on_edge].T
    t = surface.weights[on_edge, 1]
    assert (forest.phi[inner] < 0).all()
    assert (forest.phi[outer] >= 0).all()
    assert np.allclose((1 - t) * forest.phi[inner] + t * forest.phi[outer], 0, atol=1e-9)
    x = (1 - t)[:, None] * forest.points[inner] + t[:, None] * forest.points[outer]
    assert np.allclose(x, surface.points[on_edge], atol=1e-15)


@pytest.mark.parametrize("make", ["marched", "boundary", "points", "user's"])
def test_an_affine_motion_is_followed_exactly(make, forest, device, rng):
    """Weights sum to one and reproduce the point, inside an element or outside: so affine motions are exact."""
    if make == "marched":
        bound = forest.surface()
    elif make == "boundary":
        forest = mixed_forest()
        bound = forest.surface()
    elif make == "points":
        bound = forest.bind(rng.uniform(-0.5, 0.5, (500, 3)))
    else:
        sphere = trimesh.creation.icosphere(3, 0.3)
        bound = forest.bind(sphere.vertices, sphere.faces)
    u = forest.points @ STRETCH.T + [0.1, -0.2, 0.3]
    expected = bound.points + bound.points @ STRETCH.T + [0.1, -0.2, 0.3]
    assert np.allclose(bound.moved(u), expected, atol=1e-12)
    assert bound.nodes.max() < len(forest.points)
    on_device = bound.on_device(device)
    on_device.update(wp.array(u, dtype=wp.vec3, device=device))
    assert np.abs(on_device.positions.numpy() - expected).max() < 1e-5
    if isinstance(bound, SurfaceMesh):
        solid = trimesh.Trimesh(expected, bound.triangles, process=False)
        face = solid.face_normals * solid.area_faces[:, None]
        normals = np.zeros_like(expected)
        np.add.at(normals, bound.triangles, face[:, None])
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        large = np.bincount(bound.triangles.ravel(), np.repeat(solid.area_faces, 3)) > 1e-6
        assert np.abs(on_device.normals.numpy() - normals)[large].max() < 2e-2


def test_normals_of_a_ball_point_outwards(device):
    surface = wc.TetForest.from_domain(ball(), 0.25, max_level=9).surface()
    outward = surface.points / np.linalg.norm(surface.points, axis=1, keepdims=True)
    assert (surface.normals * outward).sum(axis=1).min() > 0.85
    assert np.allclose(np.linalg.norm(surface.normals, axis=1), 1)
    assert np.abs(surface.on_device(device).normals.numpy() - surface.normals).max() < 1e-6


def test_at_rest_nothing_moves(forest, device):
    surface = forest.surface()
    on_device = surface.on_device(device)
    on_device.update(wp.zeros(len(forest.points), dtype=wp.vec3, device=device))
    assert np.array_equal(on_device.positions.numpy(), surface.points.astype(np.float32))


def test_points_inside_are_in_their_element(rng):
    for forest in (mixed_forest(cells=(2, 1, 1)), wc.TetForest.box((1, 2, 1), 0.5, 7, origin=(0.3, -2.0, 7.0))):
        low, high = forest.points.min(0), forest.points.max(0)
        points = rng.uniform(low, high, (2000, 3))
        elements, weights = forest.embed(points)
        assert elements.dtype == np.int32
        assert weights.min() > -1e-9
        assert np.allclose(weights, barycentric(forest, elements, points), atol=1e-9)
        assert np.allclose(np.einsum("vn,vnc->vc", weights, forest.points[forest.tets[elements]]), points, atol=1e-12)


def test_nodes_and_corners_are_in_elements_of_theirs(forest):
    elements, weights = forest.embed(forest.points)
    at = np.argmax(weights, axis=1)
    assert np.allclose(weights.max(axis=1), 1)
    assert np.array_equal(forest.tets[elements, at], np.arange(len(forest.points)))


def test_points_outside_take_the_nearest_element(forest, rng):
    """Against the distance to every element, by trimesh's formula for triangles."""
    points = rng.uniform(-0.6, 0.6, (60, 3))
    elements, _ = forest.embed(points)
    x = forest.points[forest.tets]
    faces = x[:, [[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]]]
    outside = 0
    for point, element in zip(points, elements, strict=True):
        inside = (barycentric(forest, np.arange(len(x)), point) >= -1e-12).all(axis=1)
        if inside.any():
            assert inside[element]
            continue
        outside += 1
        flat = faces.reshape(-1, 3, 3)
        closest = trimesh.triangles.closest_point(flat, np.tile(point, (len(flat), 1)))
        distance = np.linalg.norm(closest - point, axis=1).reshape(-1, 4).min(axis=1)
        assert distance[element] < distance.min() + 1e-6
    assert outside > 20


def test_boundary_of_a_box_is_its_surface():
    surface = wc.TetForest.box((2, 1, 1), 0.5, 4).surface()
    assert surface.volume == pytest.approx(0.25)
    assert surface.area == pytest.approx(2.5)
    assert surface.euler_characteristic == 2
    assert surface.sides is None


@pytest.mark.parametrize(
    ("points", "named"),
    [(np.zeros(3), r"shape \(3,\)"), (np.zeros((4, 2)), r"shape \(4, 2\)"), ([[0, 0, 0], [0, np.nan, 0]], "point 1")],
)
def test_bad_points(points, named):
    with pytest.raises(wc.InputError, match=named):
        wc.TetForest.box().embed(points)


def test_bad_triangles_and_labels(forest):
    with pytest.raises(wc.InputError, match="out of range"):
        forest.bind(np.zeros((3, 3)), [[0, 1, 3]])
    with pytest.raises(wc.InputError, match="triangles"):
        forest.bind(np.zeros((3, 3)), [0, 1, 2])
    with pytest.raises(wc.InputError, match="separating_surface"):
        forest.surface().of_label(1)
    with pytest.raises(wc.InputError, match="no labels"):
        forest.separating_surface()
