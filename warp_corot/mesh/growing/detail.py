"""A body's surface at a finer resolution than the mesh: parts of tetrahedra with their values and labels."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from warp_corot.mesh.surfaces.bound import SurfaceMesh
from warp_corot.mesh.surfaces.creases import sharpened
from warp_corot.mesh.surfaces.marching import marched
from warp_corot.mesh.surfaces.separating import separated

if TYPE_CHECKING:
    from warp_corot.domain import Domain


@dataclass(frozen=True, eq=False)
class Detail:
    """Conforming tetrahedra that contain all of a body's surface, each inside one element of the mesh or outside the
    mesh.

    Attributes:
        points: float64 [n, 3] [m].
        tets: int32 [k, 4].
        phi: The body's signed function at the points [m], float32 [n].
        labels: Labels of the points, for points outside that of the nearest part, int32 [n]; None: no labels.
        sharp_points, sharp_triangles: The body's surface with its edges, float64 [V, 3] [m] and int32 [F, 3]; None: the
            marched one is drawn.
    """

    points: np.ndarray
    tets: np.ndarray
    phi: np.ndarray
    labels: np.ndarray | None = None
    sharp_points: np.ndarray | None = None
    sharp_triangles: np.ndarray | None = None

    @classmethod
    def of(cls, points: np.ndarray, tets: np.ndarray, phi: np.ndarray, labels: np.ndarray | None) -> Detail:
        """Of tetrahedra of a larger mesh, with the points that they need."""
        used, corners = np.unique(tets, return_inverse=True)
        named = None if labels is None else labels[used]
        return cls(points[used], corners.reshape(-1, 4).astype(np.int32), phi[used], named)

    def surface(self) -> SurfaceMesh:
        """The body's surface: with its edges if these are known, bound to nothing yet; else bound to these points."""
        if self.sharp_points is None or self.sharp_triangles is None:
            return marched(self.points, self._across(self.phi < 0), self.phi)
        unbound = np.zeros((len(self.sharp_points), 4))
        return SurfaceMesh(self.sharp_points, unbound.astype(np.int32), unbound, self.sharp_triangles)

    def separating_surface(self) -> SurfaceMesh:
        """The surfaces between labels and around them, bound to these points."""
        assert self.labels is not None
        return separated(self.points, self.tets, self.phi, self.labels)

    def sharpened(self, domain: Domain) -> Detail:
        """With the edges of the body."""
        points, triangles = sharpened(self.points, self._across(self.phi < 0), self.phi, domain)
        return replace(self, sharp_points=points, sharp_triangles=triangles)

    def _across(self, inside: np.ndarray) -> np.ndarray:
        own = inside[self.tets]
        return self.tets[own.any(axis=1) & ~own.all(axis=1)]
