"""Points in tetrahedra of any shape: a tree of bounding boxes finds the one that holds each."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.errors import InputError
from warp_corot.inputs.checks import checked_numbers
from warp_corot.kernels.meshing.embedding import find_holders
from warp_corot.kernels.meshing.measuring import find_nearest

from .boundary import boundary_faces

#: Points farther away than this many lengths of the mesh are moved to that distance; float32 cannot resolve more.
FARTHEST = 1.0e3


def checked_points(points: npt.ArrayLike) -> np.ndarray:
    """Points float64 [n, 3].

    Raises:
        InputError: They have another shape, or are not finite.
    """
    points = checked_numbers(points, "points", "[n, 3]")
    if points.ndim != 2 or points.shape[1] != 3:
        raise InputError(f"points has shape {points.shape}; it must be [n, 3]")
    bad = np.flatnonzero(~np.isfinite(points).all(axis=1))
    if len(bad):
        raise InputError(f"point {bad[0]} is {points[bad[0]].tolist()}; its coordinates must be finite")
    return points


def embed_in_tets(nodes: np.ndarray, tets: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The tetrahedron that holds each point, or the one behind the nearest face, and the point's coordinates in it.

    Args:
        nodes: float64 [N, 3].
        tets: int32 [T, 4].
        points: [n, 3].

    Returns:
        Tetrahedra int32 [n], and barycentric coordinates float64 [n, 4]; some are negative for points outside.

    Raises:
        InputError: The points are not [n, 3], or not finite.
    """
    points = checked_points(points)
    device = wp.get_device("cpu")
    # Relative to the centre of the mesh, because float32 keeps few digits far from zero.
    middle = nodes[tets].reshape(-1, 3).mean(axis=0)
    placed, moved = nodes - middle, points - middle
    size = float(np.ptp(placed, axis=0).max())
    corners = placed[tets]
    low, high = corners.min(axis=1) - 1e-6 * size, corners.max(axis=1) + 1e-6 * size
    lowers, uppers = (wp.array(x.astype(np.float32), dtype=wp.vec3, device=device) for x in (low, high))
    tree = wp.Bvh(lowers, uppers)
    moved = moved * (FARTHEST * size / np.maximum(np.abs(moved).max(axis=1, keepdims=True), FARTHEST * size))
    at = wp.array(moved, dtype=wp.vec3d, device=device)
    inverse = np.linalg.inv(np.swapaxes(corners[:, 1:] - corners[:, :1], 1, 2))
    inputs = [
        tree.id,
        at,
        wp.array(corners[:, 0], dtype=wp.vec3d, device=device),
        wp.array(inverse, dtype=wp.mat33d, device=device),
    ]
    found = wp.empty(len(points), dtype=wp.int32, device=device)
    wp.launch(find_holders, len(points), inputs, [found], device=device)
    elements = found.numpy()
    outside = np.flatnonzero(elements < 0)
    if len(outside):
        faces, parents = boundary_faces(tets, nodes)
        elements[outside] = parents[nearest_faces(placed, faces, moved[outside], 10.0 * FARTHEST * size)]
    later = np.einsum("nij,nj->ni", inverse[elements], points - middle - corners[elements, 0])
    return elements, np.column_stack([1.0 - later.sum(axis=1), later])


def nearest_faces(nodes: np.ndarray, faces: np.ndarray, points: np.ndarray, far: float) -> np.ndarray:
    """The triangle closest to each point, int32 [n]; -1 if none is closer than ``far`` [m]."""
    return _nearest(nodes, faces, points, far, "cpu")[0]


def distances_from(
    nodes: np.ndarray, faces: np.ndarray, points: np.ndarray, far: float, device: wp.Device | str = "cpu"
) -> np.ndarray:
    """The distance of each point from a surface, at most ``far`` [m], float32 [n]."""
    middle = nodes.mean(axis=0)  # float32 keeps few digits far from zero
    return _nearest(nodes - middle, faces, points - middle, far, device)[1]


def _nearest(
    nodes: np.ndarray, faces: np.ndarray, points: np.ndarray, far: float, device: wp.Device | str
) -> tuple[np.ndarray, np.ndarray]:
    mesh = wp.Mesh(
        wp.array(nodes, dtype=wp.vec3, device=device),
        wp.array(np.ascontiguousarray(faces, dtype=np.int32).ravel(), dtype=wp.int32, device=device),
    )
    given = wp.array(points, dtype=wp.vec3, device=device)
    found = [wp.empty(len(points), dtype=dtype, device=device) for dtype in (wp.int32, wp.float32)]
    wp.launch(find_nearest, len(points), [given, mesh.id, far], found, device=device)
    return found[0].numpy(), found[1].numpy()
