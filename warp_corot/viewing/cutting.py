"""Cuts through a body along a plane of its rest shape: the rest of its surface, and the section, bound to nodes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from warp_corot.mesh.surfaces.bound import BoundPoints, SurfaceMesh

#: Nodes of a tetrahedron on one side, as a number of four bits, and the crossed edges around the section in order; the
#: other side's numbers have the same edges.
_AROUND = {
    0b0001: ((0, 1), (0, 2), (0, 3)),
    0b0010: ((1, 0), (1, 2), (1, 3)),
    0b0100: ((2, 0), (2, 1), (2, 3)),
    0b1000: ((3, 0), (3, 1), (3, 2)),
    0b0011: ((0, 2), (0, 3), (1, 3), (1, 2)),
    0b0101: ((0, 1), (0, 3), (2, 3), (2, 1)),
    0b0110: ((1, 0), (1, 3), (2, 3), (2, 0)),
}


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
    section = _section(mesh, plane.distances(mesh.points, bounds))
    phi = getattr(mesh, "phi", None)
    if phi is not None:
        section = _kept(section, np.einsum("vn,vn->v", section.weights, phi[section.nodes]))
    first = len(kept.points)
    return SurfaceMesh(
        np.concatenate([kept.points, section.points]),
        np.concatenate([kept.nodes, section.nodes]).astype(np.int32),
        np.concatenate([kept.weights, section.weights]),
        np.concatenate([kept.triangles, section.triangles + first]).astype(np.int32),
    )


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


def _section(mesh: Any, beyond: npt.NDArray[np.float64]) -> SurfaceMesh:
    """The polygons in which the plane cuts tetrahedra, facing the removed part."""
    tets, outside = mesh.tets, beyond[mesh.tets] > 0.0
    sides = outside @ np.array([1, 2, 4, 8])
    sides = np.where(np.isin(sides, list(_AROUND)), sides, 15 - sides)
    ends, weights, triangles, first = [], [], [], 0
    for number, edges in _AROUND.items():
        found = tets[sides == number]
        if not len(found):
            continue
        corners = np.stack([found[:, list(edge)] for edge in edges], axis=1)
        d = beyond[corners]
        t = d[..., 0] / (d[..., 0] - d[..., 1])
        ends.append(corners.reshape(-1, 2))
        weights.append(np.stack([1.0 - t, t], axis=-1).reshape(-1, 2))
        start = first + len(edges) * np.arange(len(found))[:, None]
        triangles += [start + np.array([0, k, k + 1]) for k in range(1, len(edges) - 1)]
        first += len(edges) * len(found)
    if not ends:
        empty = np.zeros((0, 4))
        return SurfaceMesh(np.zeros((0, 3)), empty.astype(np.int32), empty, np.zeros((0, 3), np.int32))
    joined, shares, faces = np.concatenate(ends), np.concatenate(weights), np.concatenate(triangles)
    points = np.einsum("ve,vec->vc", shares, mesh.points[joined])
    # Each crossing of an edge is one point, so that shading is smooth.
    order = np.sort(joined, axis=1)
    _, kept, place = np.unique(order, axis=0, return_index=True, return_inverse=True)
    faces = place.ravel()[faces]
    points, joined, shares = points[kept], joined[kept], shares[kept]
    nodes = np.concatenate([joined, joined[:, :1], joined[:, :1]], axis=1).astype(np.int32)
    bound = np.concatenate([shares, np.zeros((len(shares), 2))], axis=1)
    return SurfaceMesh(points, nodes, bound, _facing(points, faces, mesh, beyond))


def _facing(
    points: npt.NDArray[np.float64],
    faces: npt.NDArray[np.integer],
    mesh: Any,
    beyond: npt.NDArray[np.float64],
) -> npt.NDArray[np.integer]:
    """Triangles of the section, wound to face the removed part, without triangles of zero area."""
    far, near = mesh.points[np.argmax(beyond)], mesh.points[np.argmin(beyond)]
    a, b, c = np.moveaxis(points[faces], 1, 0)
    normal = np.cross(b - a, c - a)
    axis = int(np.argmax(np.abs(normal).sum(axis=0)))
    wrong = normal[:, axis] * (far - near)[axis] < 0.0
    return np.where(wrong[:, None], faces[:, ::-1], faces)
