"""Elements and faces: pairs of elements at faces, boundaries, connected pieces."""

from __future__ import annotations

import warnings

import numpy as np
import numpy.typing as npt
import scipy
import warp as wp
from numpy.typing import ArrayLike, NDArray

#: Fewer numbers are left to NumPy.
FEW = 20_000


def sorted_keys(keys: np.ndarray, limit: int) -> tuple[np.ndarray, np.ndarray]:
    """Keys from 0 to below a limit in ascending order, and their places before; equal keys keep their order.

    Args:
        keys: int64 [n].
        limit: A number above all keys, at most 2**63.
    """
    count = len(keys)
    bits = max(count - 1, 1).bit_length()
    if (limit - 1).bit_length() + bits <= 63:
        # Numbers that hold key and place sort faster than places do by their keys.
        both = np.sort(keys << bits | np.arange(count))
        return both >> bits, both & ((1 << bits) - 1)
    if count < FEW:
        order = np.argsort(keys, kind="stable")
        return keys[order], order
    cpu = wp.get_device("cpu")
    # The sort needs as much room again.
    ordered, places = (wp.empty(2 * count, dtype=kind, device=cpu) for kind in (wp.int64, wp.int32))
    ordered.numpy()[:count], places.numpy()[:count] = keys, np.arange(count, dtype=np.int32)
    wp.utils.radix_sort_pairs(ordered, places, count)
    return ordered.numpy()[:count], places.numpy()[:count]


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


def coordinates_in(corners: np.ndarray, points: np.ndarray) -> NDArray[np.float64]:
    """Barycentric coordinates of points [n, 3] in tetrahedra [n, 4, 3], float64 [n, 4]; some are negative outside."""
    edges = np.swapaxes(corners[:, 1:] - corners[:, :1], 1, 2)
    later = np.linalg.solve(edges, (points - corners[:, 0])[..., None])[..., 0]
    return np.column_stack([1.0 - later.sum(axis=1), later])


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


def _sort_faces(corners: NDArray[np.int32]) -> tuple[NDArray[np.integer], NDArray[np.bool_]]:
    """An order in which equal faces (as sets of nodes) are neighbours, and where in it a new face begins."""
    a, b, c = corners.T.astype(np.int64)
    low, high = np.minimum(np.minimum(a, b), c), np.maximum(np.maximum(a, b), c)
    count = int(high.max()) + 1
    pair = low * count + (a + b + c - low - high)
    if count**3 <= 2**63:
        keys, order = sorted_keys(pair * count + high, count**3)
        return order, np.append(True, keys[1:] != keys[:-1])
    order = np.lexsort((high, pair))
    return order, np.append(True, (np.diff(pair[order]) != 0) | (np.diff(high[order]) != 0))


Array = np.ndarray


def pieces_of(tets: npt.NDArray[np.integer]) -> npt.NDArray[np.int32]:
    """The piece of each element, int32 [T]; the piece with most elements has the number 0.

    Elements that share a face belong to one piece. Parts that meet only in a node or an edge are different pieces,
    because one can rotate about it.

    Args:
        tets: Nodes of each element [T, 4].
    """
    piece = linked(face_pairs(tets), len(tets))
    rank = np.argsort(np.argsort(-np.bincount(piece), kind="stable"), kind="stable")
    return rank[piece].astype(np.int32)


def face_pairs(tets: Array) -> Array:
    """Pairs of elements that share a face [m, 2]."""
    order, first = _sort_faces(np.ascontiguousarray(tets)[:, FACES_OF_TET].reshape(-1, 3))
    same = np.flatnonzero(~first)
    return np.sort(np.stack([order[same - 1], order[same]], axis=1) // 4, axis=1)


def linked(pairs: Array, count: int) -> Array:
    """The number of the connected part that each of ``count`` items belongs to, from pairs [m, 2] that are linked."""
    links = scipy.sparse.coo_array((np.ones(len(pairs), np.int8), pairs.T), shape=(count, count))
    # In 64 bits, since callers multiply.
    return scipy.sparse.csgraph.connected_components(links, directed=False)[1].astype(np.int64)


def connected(tets: Array) -> Array:
    """The piece of each element [n]; elements that share a node are connected. Negative nodes connect nothing."""
    count = int(tets.max()) + 1
    first = tets.max(axis=1)
    tets = np.where(tets < 0, first[:, None], tets)
    # An element without any node is a piece by itself.
    alone = first < 0
    tets[alone] = count + np.arange(np.count_nonzero(alone), dtype=tets.dtype)[:, None]
    count += int(np.count_nonzero(alone))
    return linked(node_pairs(tets), count)[tets[:, 0]]


def node_pairs(tets: Array) -> Array:
    """Pairs of nodes that link all nodes of each element, [3 n, 2]."""
    return np.stack([np.repeat(tets[:, 0], 3), tets[:, 1:].ravel()], axis=1)


def codes(inside: Array) -> Array:
    """The set of inside nodes of elements, bool [n, 4], as a number from 0 to 15."""
    return inside @ np.array([1, 2, 4, 8])
