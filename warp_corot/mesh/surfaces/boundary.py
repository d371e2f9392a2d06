"""The surface of a tetrahedral mesh: the faces that belong to one tetrahedron only."""

import warnings

import numpy as np
from numpy.typing import ArrayLike, NDArray

# The faces of a tetrahedron with det(x1-x0, x2-x0, x3-x0) > 0, each opposite the vertex of the same number and
# wound so that its normal points away from it (OpenUSD's order for right-handed tetrahedra).
FACES_OF_TET = np.array([[1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1]], dtype=np.int32)


def right_handed(tets: NDArray[np.int32], mirrored: NDArray[np.bool_]) -> NDArray[np.int32]:
    """Tetrahedra with two nodes of each mirrored one exchanged, int32 [T, 4], because file formats need that order."""
    turned = tets.copy()
    turned[mirrored, 2], turned[mirrored, 3] = tets[mirrored, 3], tets[mirrored, 2]
    return turned


def signed_volumes(points: ArrayLike, tets: ArrayLike) -> NDArray[np.float64]:
    """Volumes [m³] of tetrahedra, negative for mirrored ones.

    Args:
        points: Vertex positions [N, 3] [m].
        tets: Vertex indices [T, 4].

    Returns:
        det(x1−x0, x2−x0, x3−x0) / 6, float64 [T].
    """
    x = np.asarray(points, dtype=np.float64)
    t = np.asarray(tets)
    x0 = x[t[:, 0]]
    a, b, c = x[t[:, 1]] - x0, x[t[:, 2]] - x0, x[t[:, 3]] - x0
    return np.einsum("ij,ij->i", a, np.cross(b, c)) / 6.0


def boundary_faces(tets: ArrayLike, points: ArrayLike | None = None) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Faces that belong to exactly one tetrahedron, wound counter-clockwise seen from outside.

    Args:
        tets: Vertex indices [T, 4].
        points: Vertex positions [N, 3], needed if some tetrahedra are mirrored, as half of those of a forest are: their
            faces are reversed. Without points, all tetrahedra must be positively oriented,
            det(x1−x0, x2−x0, x3−x0) > 0.

    Returns:
        ``faces`` int32 [F, 3], in the order of the tetrahedra they come from, and ``parents`` int32 [F], the
        tetrahedron of each. A face shared by three or more tetrahedra (they overlap) is not a boundary; a warning
        counts these faces.
    """
    t = np.ascontiguousarray(tets, dtype=np.int32).reshape(-1, 4)
    if len(t) == 0:
        return np.empty((0, 3), np.int32), np.empty(0, np.int32)
    corners = t[:, FACES_OF_TET]
    if points is not None:
        mirrored = signed_volumes(points, t) < 0.0
        corners[mirrored] = corners[mirrored][:, :, ::-1]
    corners = corners.reshape(-1, 3)

    order, first = _sort_faces(corners)
    start = np.flatnonzero(first)
    sharers = np.diff(start, append=len(order))
    if sharers.max() > 2:
        example = corners[order[start[np.argmax(sharers)]]]
        warnings.warn(
            f"{int((sharers > 2).sum())} faces are shared by more than two tetrahedra, which therefore overlap: "
            f"nodes {sorted(example.tolist())} by {int(sharers.max())}",
            stacklevel=2,
        )
    boundary = np.sort(order[start[sharers == 1]])
    return corners[boundary], (boundary // 4).astype(np.int32)


def _sort_faces(corners: NDArray[np.int32]) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
    """An order in which equal faces (as sets of nodes) are neighbours, and where in it a new face begins."""
    low = corners.min(axis=1).astype(np.uint64)
    high = corners.max(axis=1).astype(np.uint64)
    middle = corners.astype(np.int64).sum(axis=1).astype(np.uint64) - low - high
    count = int(high.max()) + 1
    pair = low * np.uint64(count) + middle
    keys = (pair * np.uint64(count) + high,) if count**3 < 2**64 else (high, pair)
    order = np.argsort(keys[0], kind="stable") if len(keys) == 1 else np.lexsort(keys)
    first = np.zeros(len(order), bool)
    first[0] = True
    for key in keys:
        ordered = key[order]
        first[1:] |= ordered[1:] != ordered[:-1]
    return order, first
