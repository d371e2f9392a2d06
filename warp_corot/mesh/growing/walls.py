"""Walls thinner than the elements that they pass: no corner is inside, and few random points are.

Random points miss the wall in most of these elements, and a mesh without them is full of holes. An element holds a
part of the wall if the point of the body's surface that is nearest to it lies in it. The wall's thickness there says
how much; all of them together hold what random points say.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from warp_corot.domain import Domain

#: A body is one of walls if elements without a corner inside hold more than this share of it.
OF_WALLS = 0.2
#: Normals come from differences over this share of the distance to the surface, and at least and at most of an element.
APART, LEAST_APART, MOST_APART = 0.2, 1.0e-3, 0.05
#: How far from the surface a point that was moved there may be, and how thick a wall, over the length of the element.
OFF, THICKEST = 0.02, 0.25
#: How far outside an element the surface may be, as a barycentric coordinate.
OUTSIDE = -1.0e-3
#: Four directions whose differences give a gradient.
_AROUND = np.array([[1.0, 1.0, 1.0], [1.0, -1.0, -1.0], [-1.0, 1.0, -1.0], [-1.0, -1.0, 1.0]]) / np.sqrt(3.0)


def wall_shares(corners: np.ndarray, points: np.ndarray, sampled: np.ndarray, domain: Domain) -> np.ndarray:
    """The share of each element without a corner inside that is wall, float64 [n].

    Args:
        corners: Corners of the elements [m], float64 [n, 4, 3].
        points: A point in each that is near the body [m], float64 [n, 3].
        sampled: The share of random points in each that are inside [n].
        domain: The body.
    """
    edges = np.swapaxes(corners[:, 1:] - corners[:, :1], 1, 2)
    volumes = np.abs(np.linalg.det(edges)) / 6.0
    lengths = np.cbrt(6.0 * volumes)
    value = _phi(domain, points)
    apart = np.clip(APART * np.abs(value), LEAST_APART * lengths, MOST_APART * lengths)
    normal = _phi(domain, points[:, None] + apart[:, None, None] * _AROUND) @ _AROUND
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
    at = points - value[:, None] * normal
    later = np.linalg.solve(edges, (at - corners[:, 0])[:, :, None])[:, :, 0]
    within = np.minimum(later.min(axis=1), 1.0 - later.sum(axis=1)) > OUTSIDE
    crossed = np.flatnonzero(within & (np.abs(_phi(domain, at)) < OFF * lengths))
    reach = THICKEST * float(lengths[crossed].max(initial=0.0))
    if not reach:
        return sampled
    thickness = domain.thickness(at[crossed], -normal[crossed], reach)
    wall = thickness < THICKEST * lengths[crossed]
    crossed, thickness = crossed[wall], thickness[wall]
    # A plane through an element cuts it in about so large an area.
    weights = thickness * np.cbrt(volumes[crossed]) ** 2
    rest = sampled.copy()
    rest[crossed] = 0.0
    held = float((sampled - rest) @ volumes) if len(crossed) else 0.0
    found = rest
    found[crossed] = np.minimum(held * weights / max(float(weights.sum()), 1e-300) / volumes[crossed], 1.0)
    return found


def _phi(domain: Domain, points: np.ndarray) -> np.ndarray:
    return np.asarray(domain.phi(points.reshape(-1, 3)), np.float64).reshape(points.shape[:-1])
