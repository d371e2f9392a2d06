"""Domains in tests: points around them, surfaces as arrays."""

import numpy as np
import trimesh

from warp_corot.domain import Domain

#: float32 on coordinates of about one.
ROUNDING = 3e-6


def arrays(mesh: trimesh.Trimesh) -> tuple[np.ndarray, np.ndarray]:
    return np.array(mesh.vertices), np.array(mesh.faces)


def around(domain: Domain, rng, count: int = 2000, reach: float = 0.5) -> np.ndarray:
    """Random points in the bounds and beyond."""
    size = np.ptp(domain.bounds, axis=0)
    return domain.bounds[0] - reach * size + rng.random((count, 3)) * (1.0 + 2.0 * reach) * size


def with_hole() -> tuple[np.ndarray, np.ndarray]:
    """A sphere without the triangles around one of its corners."""
    points, triangles = arrays(trimesh.creation.icosphere(2))
    return points, triangles[(triangles != 0).all(axis=1)]


def same(domain: Domain, other: Domain, rng, atol: float = ROUNDING) -> None:
    points = around(other, rng)
    assert np.allclose(domain.phi(points), other.phi(points), atol=atol)
