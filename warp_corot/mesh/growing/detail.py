"""A body's surface where it is finer than the mesh: parts of tetrahedra, their values and their labels."""

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
    from warp_corot.mesh.forest import TetForest


@dataclass(frozen=True, eq=False)
class Detail:
    """Tetrahedra, conforming, that hold all of a body's surface, each within an element of the mesh or outside of it.

    Attributes:
        points: float64 [n, 3] [m].
        tets: int32 [k, 4].
        phi: The body's signed function at the points [m], float32 [n].
        labels: Of the points, those outside that of the nearest part, int32 [n]; None: no labels.
        sharp: The body's surface with its edges and corners, bound to nothing; None: the marched one is drawn.
    """

    points: np.ndarray
    tets: np.ndarray
    phi: np.ndarray
    labels: np.ndarray | None = None
    sharp: SurfaceMesh | None = None

    @classmethod
    def of(cls, points: np.ndarray, tets: np.ndarray, phi: np.ndarray, labels: np.ndarray | None) -> Detail:
        """Of tetrahedra of a larger mesh, with the points that they need."""
        used, corners = np.unique(tets, return_inverse=True)
        named = None if labels is None else labels[used]
        return cls(points[used], corners.reshape(-1, 4).astype(np.int32), phi[used], named)

    def surface(self, forest: TetForest) -> SurfaceMesh:
        """The body's surface, bound to the nodes of a forest."""
        if self.sharp is not None:
            return _bound(forest, self.sharp)
        return _bound(forest, marched(self.points, self._across(self.phi < 0), self.phi))

    def separating_surface(self, forest: TetForest) -> SurfaceMesh:
        """The surfaces between labels and around them, bound to the nodes of a forest."""
        assert self.labels is not None
        return _bound(forest, separated(self.points, self.tets, self.phi, self.labels))

    def sharpened(self, domain: Domain) -> Detail:
        """With the edges and corners of the body."""
        return replace(self, sharp=sharpened(self.points, self._across(self.phi < 0), self.phi, domain))

    def within(self, forest: TetForest, kept: np.ndarray) -> Detail:
        """The part in elements of a mask bool [T], or nearest to them; its surface is the marched one."""
        stays = kept[forest.embed(self.points[self.tets].mean(axis=1))[0]]
        return Detail.of(self.points, self.tets[stays], self.phi, self.labels)

    def _across(self, inside: np.ndarray) -> np.ndarray:
        own = inside[self.tets]
        return self.tets[own.any(axis=1) & ~own.all(axis=1)]


def _bound(forest: TetForest, found: SurfaceMesh) -> SurfaceMesh:
    elements, weights = forest.embed(found.points)
    return replace(found, nodes=forest.tets[elements], weights=weights)
