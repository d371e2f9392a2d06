"""Inside and outside of surfaces that cross, overlap or coincide, against winding numbers in float64."""

from pathlib import Path

import numpy as np
import trimesh
import warp as wp
import warp.examples

import warp_corot as wc
from warp_corot.domain.closing import winding_number
from warp_corot.domain.surface import lines_through, surface_mesh, windings_of


def box(low, high) -> trimesh.Trimesh:
    return trimesh.creation.box(bounds=(low, high))


def test_signs_are_those_of_winding_numbers(device):
    """Boxes that cross, boxes with a common wall, and a cavity with another's wall: half of the walls coincide."""
    hollow = box((0.0, 0.2, 0.2), (0.5, 0.8, 0.8))
    hollow.invert()
    parts = [
        box((0, 0, 0), (1, 1, 1)),
        hollow,
        box((0.5, 0.2, 0.2), (1.5, 0.8, 0.8)),
        box((-0.6, 0.3, 0.3), (0.0, 1, 1)),
    ]
    whole = trimesh.util.concatenate([*parts, trimesh.creation.icosphere(2, 0.4).apply_translation((1.2, 0.5, 0.5))])
    domain = wc.Domain.from_surface((whole.vertices, whole.faces), device=device)
    rng = np.random.default_rng(0)
    points = rng.uniform(domain.bounds[0], domain.bounds[1], (1500, 3))
    corners = domain.closed.points[domain.closed.triangles]
    exact = np.array([winding_number(corners, point) for point in points]) > 0.5
    assert 0.2 < exact.mean() < 0.8
    assert np.array_equal(domain.phi(points) < 0.0, exact)
    assert np.array_equal(domain.holds(points), exact)


def test_lines_that_are_parallel_to_faces_and_through_corners_count_right(device):
    """Winding numbers of stacked and crossing boxes at points straight above and below their corners and edges."""
    steps = [box((0, 0, 0), (1, 1, 1)), box((0, 0, 1), (0.5, 0.5, 1.5)), box((0.25, 0.25, 0.25), (0.75, 1.25, 2))]
    whole = trimesh.util.concatenate(steps)
    triangles = np.asarray(whole.faces)
    mesh = surface_mesh(whole.vertices, triangles, wp.get_device(device))
    eighths = np.arange(-1, 18, dtype=float) / 8.0
    points = np.stack(np.meshgrid(eighths, eighths, eighths, indexing="ij"), axis=-1).reshape(-1, 3)
    on = np.zeros(len(points), bool)
    for part in steps:
        low, high = part.bounds
        on |= ((points >= low) & (points <= high)).all(axis=1) & ((points == low) | (points == high)).any(axis=1)
    points = points[~on][::7]
    exact = np.array([winding_number(whole.triangles, point) for point in points])
    placed = wp.array(points, dtype=wp.vec3, device=device)
    for axis in range(3):
        lines = lines_through(whole.bounds)
        lines.axis, lines.low, lines.high = axis, whole.bounds[0, axis] - 0.1, whole.bounds[1, axis] + 0.1
        assert np.array_equal(windings_of(mesh, lines, placed), np.round(exact))


def test_lines_through_points_in_which_many_triangles_meet_count_right(device):
    ball = trimesh.creation.icosphere(3)
    points = ball.vertices.astype(np.float32).astype(float)
    mesh = surface_mesh(points, ball.faces, wp.get_device(device))
    for axis in range(3):
        lines = lines_through(ball.bounds)
        lines.axis = axis
        for share, expected in ((0.5, 1), (-0.5, 1), (1.5, 0), (-1.5, 0)):
            scale = np.ones(3)
            scale[axis] = share
            off = points[np.abs(points[:, axis]) > 0.1]
            assert (windings_of(mesh, lines, wp.array(off * scale, dtype=wp.vec3, device=device)) == expected).all()


def test_a_part_that_crosses_itself_is_right_away_from_the_crossing(device):
    """A ring that is thicker than its hole: its middle is enclosed once in each direction, so it is outside."""
    ring = trimesh.creation.torus(0.15, 0.3, major_sections=48, minor_sections=40)
    ring.apply_transform(trimesh.transformations.euler_matrix(0.3, 0.2, 0.1))
    domain = wc.Domain.from_surface((ring.vertices, ring.faces), device=device)
    rng = np.random.default_rng(0)
    points = ring.triangles_center[rng.integers(len(ring.faces), size=1500)]
    points = points + rng.standard_normal((1500, 3)) * 10.0 ** rng.uniform(-3.0, -1.0, (1500, 1))
    exact = np.array([winding_number(ring.triangles, point) for point in points]) > 0.5
    assert np.array_equal(domain.phi(points) < 0.0, exact)


def test_segments_leave_the_body_where_it_ends(device):
    """Crossing balls, nested balls, and a box around them: a segment ends where the value changes its sign, with the
    normal there."""
    balls = [
        trimesh.creation.icosphere(3, 0.5).apply_translation((0.7 * k, 0.013 * k, 0.0)).apply_scale(1.0 + 1e-3 * k)
        for k in range(3)
    ]
    whole = trimesh.util.concatenate([*balls, trimesh.creation.icosphere(2, 0.2), box((-0.2, -0.8, -0.1), (2, 0, 0.1))])
    domain = wc.Domain.from_surface((whole.vertices, whole.faces), device=device)
    rng = np.random.default_rng(0)
    points = rng.uniform(domain.bounds[0], domain.bounds[1], (4000, 3))
    inside = domain.phi(points) < 0.0
    starts = points[inside]
    ends = points[~inside][: len(starts)]
    starts = starts[: len(ends)]
    shares, normals = domain.exits(starts, ends)
    known = np.isfinite(shares)
    assert known.mean() > 0.3
    x, along = (starts + shares[:, None] * (ends - starts))[known], (ends - starts)[known]
    normals = normals[known]
    assert np.allclose(np.linalg.norm(normals, axis=1), 1.0)
    assert (np.einsum("nc,nc->n", normals, along) > 0.0).all()
    assert np.abs(domain.phi(x)).max() < 1e-5
    # Grazing segments leave by less than the step.
    steep = np.einsum("nc,nc->n", normals, along) > 0.2 * np.linalg.norm(along, axis=1)
    step = 1e-3 * along[steep] / np.linalg.norm(along[steep], axis=1, keepdims=True)
    signs = np.stack([domain.phi(x[steep] - step) < 0.0, domain.phi(x[steep] + step) > 0.0])
    assert signs.mean() > 0.98


def test_a_needle_turned_over_by_rounding_leaves_signs_right(device):
    """Warp's rocks have a triangle 60 mm long and 3 um high. Its normal is noise, and made signs wrong 0.9 m away."""
    path = Path(wp.examples.get_asset_directory()) / "rocks.usd"
    domain = wc.Domain.from_surface(path, device=device)
    below = np.array([-5.27155, 1.67255, 10.06171])
    points = below + np.random.default_rng(0).normal(scale=1e-3, size=(200, 3))
    assert np.allclose(domain.phi(points), -0.9031, atol=0.01)
