"""Inside or outside where surfaces cross, overlap or lie on one another, against winding numbers in float64."""

import numpy as np
import trimesh

import warp_corot as wc
from warp_corot.domain.winding import winding_number


def box(low, high) -> trimesh.Trimesh:
    return trimesh.creation.box(bounds=(low, high))


def test_signs_are_those_of_winding_numbers(device):
    """Boxes that cross, share a wall, and a hollow whose wall is another's: half of the walls lie on others."""
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
