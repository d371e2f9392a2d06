"""Elements in clusters that share their nodes' sums; see ``kernels.clusters``."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from .kernels.block_layout import TASK_SLOTS, VECTOR_BYTES
from .kernels.clusters import CLUSTER, CORNERS, Clusters


def clusters_of(chosen: npt.NDArray[np.int32], nodes: npt.NDArray[np.int32], device: wp.Device) -> tuple[Any, int]:
    """Clusters of some of a mesh's elements, which follow one another in them as they are given.

    Args:
        chosen: The elements, int32 [n].
        nodes: Nodes of all elements, int32 [T, 4].

    Returns:
        ``kernels.clusters.Clusters``, and how many there are.
    """
    count = -(-len(chosen) // CLUSTER)
    elements = np.full(count * CLUSTER, -1, np.int32)
    elements[: len(chosen)] = chosen
    corners = nodes[chosen].ravel()
    cluster = np.arange(len(corners)) // CORNERS
    # Each cluster's nodes once; in ``order`` the corners on one node follow one another.
    key = cluster * (int(nodes.max(initial=0)) + 1) + corners
    order = np.argsort(key, kind="stable")
    is_first = np.diff(key[order], prepend=-1) != 0
    starts = np.flatnonzero(is_first)
    degree = np.diff(starts, append=len(key))
    owner = cluster[order][starts]
    # Up to TASK_SLOTS of a node's corners a task. A node's first task is its place in the cluster, so these come first,
    # busy ones at their head: then the threads of a warp have about as much to add up.
    pieces = -(-degree // TASK_SLOTS)
    node = np.repeat(np.arange(len(starts)), pieces)
    piece = np.arange(len(node)) - np.repeat(np.cumsum(pieces) - pieces, pieces)
    rank = np.lexsort((-degree[node], piece > 0, owner[node]))
    node, piece = node[rank], piece[rank]
    begin = np.searchsorted(owner[node], np.arange(count + 1)).astype(np.int32)
    local = np.empty(len(starts), np.int64)
    local[node[piece == 0]] = (np.arange(len(node)) - begin[owner[node]])[piece == 0]
    of_corner = np.empty(len(key), np.int64)
    of_corner[order] = local[np.cumsum(is_first) - 1]
    packed = np.zeros((count * CLUSTER, 4), "<u2")
    packed[: len(chosen)] = of_corner.reshape(-1, 4)
    at = TASK_SLOTS * piece[:, None] + np.arange(TASK_SLOTS)
    corner = order[np.minimum(starts[node, None] + at, len(order) - 1)] % CORNERS
    slots = np.where(at < degree[node, None], corner % 4 * CLUSTER + corner // 4, CORNERS)
    clusters = Clusters()
    clusters.elements = wp.array(elements, dtype=wp.int32, device=device)
    clusters.corners = wp.array(packed.view("<u8").ravel(), dtype=wp.uint64, device=device)
    clusters.begin = wp.array(begin, dtype=wp.int32, device=device)
    clusters.nodes = wp.array(corners[order][starts][node].astype(np.int32), dtype=wp.int32, device=device)
    words = np.ascontiguousarray((VECTOR_BYTES * slots).astype("<u2").view("<u8").T)
    clusters.slots = wp.array(words, dtype=wp.uint64, device=device)
    return clusters, count
