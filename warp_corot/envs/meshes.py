"""Meshes of the tasks."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import numpy.typing as npt

from warp_corot.mesh.forest import TetForest
from warp_corot.mesh.tetmesh import TetMesh


def box(
    counts: tuple[int, int, int],
    edges: tuple[float, float, float],
    cells: int = 1,
    without: Callable[[npt.NDArray[np.float64]], npt.NDArray[np.bool_]] | None = None,
) -> TetMesh:
    """A box with a corner at the origin, of cubes with six tetrahedra each.

    Args:
        counts: Numbers of cubes along x, y and z.
        edges: Edges of the box [m].
        cells: Factor on the counts.
        without: Which points [n, 3] [m] are not in the body, for the cubes' centroids.
    """
    x, y, z = counts
    whole = TetForest.box((cells * x, cells * y, cells * z))
    points = whole.points * (np.asarray(edges) / (cells * np.asarray(counts)))
    tets = np.asarray(whole.tets)
    if without is not None:
        size = np.asarray(edges) / np.asarray(counts)
        cubes = (np.floor(points[tets].mean(axis=1) / size) + 0.5) * size
        used, tets = np.unique(tets[~without(cubes)], return_inverse=True)
        points, tets = points[used], tets.reshape(-1, 4)
    return TetMesh(points, tets, up_axis="Z")


def nodes_at(mesh: TetMesh, places: Sequence[Sequence[float]]) -> npt.NDArray[np.int32]:
    """The nodes nearest to places [m]."""
    away = np.linalg.norm(mesh.points[:, None] - np.asarray(places), axis=2)
    return np.argmin(away, axis=0).astype(np.int32)
