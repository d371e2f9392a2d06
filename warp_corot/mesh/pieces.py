"""The pieces of a mesh."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from warp_corot.mesh.sorting import sorted_keys

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
    a, b, c, d = np.sort(tets, axis=1).astype(np.int64).T
    count = int(tets.max()) + 1
    ab, cd = a * count + b, c * count + d
    if count**3 <= 2**63:
        keys = np.concatenate([b * count**2 + cd, a * count**2 + cd, ab * count + d, ab * count + c])
        keys, order = sorted_keys(keys, count**3)
        same = keys[1:] == keys[:-1]
    else:
        first = np.concatenate([b * count + c, a * count + c, ab, ab])
        last = np.concatenate([d, d, d, c])
        order = np.lexsort((last, first))
        same = (first[order[1:]] == first[order[:-1]]) & (last[order[1:]] == last[order[:-1]])
    return np.sort(np.stack([order[:-1][same], order[1:][same]], axis=1) % len(tets), axis=1)


def linked(pairs: Array, count: int) -> Array:
    """The number of the connected part that each of ``count`` items belongs to, from pairs [m, 2] that are linked."""
    links = coo_array((np.ones(len(pairs), np.int8), pairs.T), shape=(count, count))
    # In 64 bits, since callers multiply.
    return connected_components(links, directed=False)[1].astype(np.int64)


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
