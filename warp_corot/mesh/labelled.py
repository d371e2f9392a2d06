"""Parts of a mesh by name, and points that follow it: what meshes of every kind have."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from warp_corot.errors import InputError
from warp_corot.inputs.checks import shown

from .surfaces.bound import BoundPoints, bound


class LabelledMesh:
    """Tetrahedra, each with a label or none; ``TetForest`` and ``TetMesh`` document the attributes."""

    points: np.ndarray
    tets: np.ndarray
    labels: np.ndarray | None
    label_names: tuple[str, ...]

    def elements_of(self, label: str) -> np.ndarray:
        """Tetrahedra with this label, bool [T].

        Raises:
            InputError: The mesh has no label of this name.
        """
        if label not in self.label_names or self.labels is None:
            raise InputError(f"there is no label {shown(label)}; there are: {', '.join(self.label_names) or 'none'}")
        return np.equal(self.labels, self.label_names.index(label) + 1)

    def nodes_of(self, label: str) -> np.ndarray:
        """Nodes of the tetrahedra with this label, bool [N]; nodes on a border belong to both sides.

        Raises:
            InputError: The mesh has no label of this name.
        """
        found = np.zeros(len(self.points), bool)
        found[self.tets[self.elements_of(label)]] = True
        return found

    def embed(self, points: npt.ArrayLike) -> tuple[np.ndarray, np.ndarray]:
        """The tetrahedron that holds each point, or the nearest one, and the point's weights in it.

        Args:
            points: [n, 3] [m].

        Returns:
            Tetrahedra int32 [n], and barycentric weights of their nodes float64 [n, 4]; some are negative if the point
            is outside.

        Raises:
            InputError: The points are not [n, 3], or not finite.
        """
        raise NotImplementedError

    def bind(self, points: npt.ArrayLike, triangles: npt.ArrayLike | None = None) -> BoundPoints:
        """Bind your own points, or with triangles [F, 3] a surface, to the mesh, so that they follow it.

        A closed surface is wound outwards, as `Domain.from_surface` winds it.

        Raises:
            InputError: As for `embed`, or triangles name points that do not exist.
        """
        elements, weights = self.embed(points)
        return bound(np.asarray(points), self.tets[elements], weights, triangles)
