"""Points in a forest: a walk down the tree finds the element that holds each."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.kernels.meshing import embedding as kernels
from warp_corot.mesh.forest_arrays import ForestArrays
from warp_corot.mesh.lattice import LATTICE_BITS
from warp_corot.mesh.tree import VOID, Tree

from .boundary import boundary_faces
from .locating import FARTHEST, checked_points, nearest_faces

#: The path from one corner of a cube to the opposite one, by the axes in descending order of a point's coordinates.
_WALKS = np.array([[0, 1, 2], [0, 2, 1], [1, 0, 2], [1, 2, 0], [2, 0, 1], [2, 1, 0]])


def embed(forest: ForestArrays, points: npt.ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    """See `TetForest.embed`."""
    points = checked_points(points)
    found = leaves_at(forest.tree, forest.cells, forest.origin, forest.cell_size, points)
    number = np.full(len(forest.tree.level) + 1, -1, np.int32)
    number[forest.tree.leaves] = np.arange(len(forest.tree.leaves), dtype=np.int32)
    elements = number[found]
    outside = np.flatnonzero(elements < 0)
    if len(outside):
        elements[outside] = _nearest(forest, points[outside])
    return elements, barycentric(forest, elements, points)


def barycentric(forest: ForestArrays, elements: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Barycentric coordinates of points in leaves, float64 [n, 4]; some are negative for points outside."""
    x = forest.points[forest.tets[elements]]
    edges = np.swapaxes(x[:, 1:] - x[:, :1], 1, 2)
    later = np.linalg.solve(edges, (points - x[:, 0])[..., None])[..., 0]
    return np.column_stack([1 - later.sum(axis=1), later])


def leaves_at(
    tree: Tree, grid: tuple[int, int, int], origin: npt.ArrayLike, cell_size: float, points: np.ndarray
) -> np.ndarray:
    """The live leaf of a tree, by its number there, that contains each point, int32 [n], -1 if there is none."""
    cells = np.array(grid)
    scaled = (points - np.asarray(origin)) / cell_size
    within = np.flatnonzero(((scaled >= 0) & (scaled <= cells)).all(axis=1))
    found = np.full(len(points), -1, np.int32)
    if not len(within):
        return found
    scaled = scaled[within]
    cube = np.minimum(scaled.astype(np.int64), cells - 1)
    rest = scaled - cube
    order = np.argsort(-rest, axis=1, kind="stable")
    walk = np.argmax((order[:, None] == _WALKS).all(axis=2), axis=1)
    down = np.take_along_axis(rest, order, axis=1)
    weights = np.column_stack([1 - down[:, 0], down[:, 0] - down[:, 1], down[:, 1] - down[:, 2], down[:, 2]])
    roots = 6 * np.ravel_multi_index(tuple(cube.T), grid) + walk
    device = wp.get_device("cpu")
    inputs = [
        wp.array(roots, dtype=wp.int32, device=device),
        wp.array(weights, dtype=wp.vec4d, device=device),
        wp.array(tree.level, dtype=wp.int32, device=device),
        wp.array(tree.first_child, dtype=wp.int32, device=device),
    ]
    leaves = wp.empty(len(within), dtype=wp.int32, device=device)
    wp.launch(kernels.descend, len(within), inputs, [leaves], device=device)
    found[within] = leaves.numpy()
    return found


def _nearest(forest: ForestArrays, points: np.ndarray) -> np.ndarray:
    """The element behind the boundary face that is closest to each point, int32 [n]."""
    faces, parents = _boundary_faces(forest)
    # Relative to the centre of the mesh, because float32 keeps few digits far from zero.
    middle = forest.points.mean(axis=0)
    moved = points - middle
    limit = FARTHEST * np.ptp(forest.points, axis=0).max()
    moved *= limit / np.maximum(np.abs(moved).max(axis=1, keepdims=True), limit)
    return parents[nearest_faces(forest.points - middle, faces, moved, 10.0 * limit)]


def _boundary_faces(forest: ForestArrays) -> tuple[np.ndarray, np.ndarray]:
    """Boundary faces and their leaves; the nodes of these faces are on void tetrahedra or on the border of the grid."""
    tree = forest.tree
    lattice = forest.lattice[: forest.node_count]
    on_rim = ((lattice == 0) | (lattice == np.array(forest.cells) << LATTICE_BITS)).any(axis=1)
    if forest.phi is not None:
        # Void tetrahedra far outside may be non-conforming, but then no node on their faces is inside.
        on_rim |= forest.phi[: forest.node_count] >= 0
        of_void = tree.tets[tree.first_child == VOID]
        of_void = of_void[(forest.phi[of_void] < 0).any(axis=1)]
        on_rim[of_void[of_void < forest.node_count]] = True
    near = np.flatnonzero(on_rim[forest.tets].sum(axis=1) >= 3)
    faces, parents = boundary_faces(forest.tets[near], forest.points)
    # Faces between near leaves and others only look like boundary faces.
    real = on_rim[faces].all(axis=1)
    return faces[real], near[parents[real]].astype(np.int32)
