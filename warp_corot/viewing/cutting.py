"""Cuts through a body along a plane of its rest shape: the rest of its surface, and the section, bound to nodes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from warp_corot.io.write.skins import joined_surfaces
from warp_corot.mesh.surfaces.bound import BoundPoints, SurfaceMesh
from warp_corot.mesh.surfaces.marching import marched


@dataclass(frozen=True)
class Plane:
    """A plane of the rest shape; the part beyond it is removed.

    Attributes:
        axis: 0, 1 or 2: the axis at right angles to the plane.
        share: Its position, as a share of the body's extent along the axis.
        flipped: Whether the other side is removed.
    """

    axis: int
    share: float
    flipped: bool = False

    def distances(self, points: npt.NDArray[np.float64], bounds: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """How far points [n, 3] are beyond the plane [m], float64 [n].

        Args:
            bounds: Lowest and highest coordinates of the body [m], [2, 3].
        """
        low, high = bounds[:, self.axis]
        distances = points[:, self.axis] - (low + self.share * (high - low))
        return -distances if self.flipped else distances


def cut(surface: SurfaceMesh, mesh: Any, plane: Plane) -> SurfaceMesh:
    """The surface without what is beyond a plane, closed by the section through the tetrahedra.

    The section of a body made from a domain ends at its marched surface, any other where the elements end.

    Args:
        surface: Bound to the nodes of ``mesh``.
        mesh: A forest or a general mesh.
    """
    bounds = np.stack([surface.points.min(axis=0), surface.points.max(axis=0)])
    kept = _kept(surface, plane.distances(surface.points, bounds))
    section = marched(mesh.points, mesh.tets, plane.distances(mesh.points, bounds))
    phi = getattr(mesh, "phi", None)
    if phi is not None:
        section = _kept(section, np.einsum("vn,vn->v", section.weights, phi[section.nodes]))
    return joined_surfaces([kept, section])


def _kept(surface: SurfaceMesh, beyond: npt.NDArray[np.float64]) -> SurfaceMesh:
    """The triangles on the near side. The far corners of those that the plane crosses move along edges to the plane."""
    outside = beyond > 0.0
    corners = surface.triangles
    count = outside[corners].sum(axis=1)
    whole = corners[count == 0]
    crossed = corners[(count == 1) | (count == 2)]
    single = np.where(outside[crossed].sum(axis=1) == 1, outside[crossed].T, ~outside[crossed].T).T
    turn = np.argmax(single, axis=1)
    a, b, c = (crossed[np.arange(len(crossed)), (turn + k) % 3] for k in range(3))
    ab, ac = _between(surface, beyond, a, b), _between(surface, beyond, a, c)
    n, m = len(surface.points), len(crossed)
    p, q = n + np.arange(m), n + m + np.arange(m)
    alone_outside = outside[a]
    quads = np.concatenate([np.stack([p, b, c], axis=1)[alone_outside], np.stack([p, c, q], axis=1)[alone_outside]])
    triangles = np.concatenate([whole, quads, np.stack([a, p, q], axis=1)[~alone_outside]])
    points, nodes, weights = (
        np.concatenate([getattr(part, name) for part in (surface, ab, ac)]) for name in ("points", "nodes", "weights")
    )
    used, numbered = np.unique(triangles, return_inverse=True)
    return SurfaceMesh(points[used], nodes[used], weights[used], numbered.reshape(-1, 3))


def _between(
    surface: SurfaceMesh, beyond: npt.NDArray[np.float64], a: npt.NDArray[np.integer], b: npt.NDArray[np.integer]
) -> BoundPoints:
    """Where the plane crosses edges from a to b, int [n], bound to the nodes of both ends."""
    t = (beyond[a] / (beyond[a] - beyond[b]))[:, None]
    nodes = np.concatenate([surface.nodes[a], surface.nodes[b]], axis=1)
    weights = np.concatenate([(1.0 - t) * surface.weights[a], t * surface.weights[b]], axis=1)
    # The four nodes with the largest weights; marched surfaces and boundaries have no more.
    most = np.argsort(-np.abs(weights), axis=1, kind="stable")[:, :4]
    nodes, weights = (np.take_along_axis(each, most, axis=1) for each in (nodes, weights))
    weights /= weights.sum(axis=1, keepdims=True)
    return BoundPoints(surface.points[a] + t * (surface.points[b] - surface.points[a]), nodes, weights)
