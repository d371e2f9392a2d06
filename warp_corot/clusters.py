"""Elements in clusters that share their nodes' sums; see ``kernels.clusters``."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from .kernels.clusters import CLUSTER, CORNERS, FIRST_BITS, Clusters


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
    # Busy nodes first, so that the threads of a warp have about as much to add up.
    rank = np.lexsort((-degree, owner))
    begin = np.searchsorted(owner, np.arange(count + 1)).astype(np.int32)
    local = np.empty(len(starts), np.int64)
    local[rank] = np.arange(len(starts)) - begin[owner[rank]]
    of_corner = np.empty(len(key), np.int64)
    of_corner[order] = local[np.cumsum(is_first) - 1]
    packed = np.zeros((count * CLUSTER, 4), "<u2")
    packed[: len(chosen)] = of_corner.reshape(-1, 4)
    slots = np.zeros(count * CORNERS, np.uint16)
    slots[: len(order)] = order % CORNERS
    sums = (starts % CORNERS | degree << FIRST_BITS)[rank]
    clusters = Clusters()
    clusters.elements = wp.array(elements, dtype=wp.int32, device=device)
    clusters.corners = wp.array(packed.view("<u8").ravel(), dtype=wp.uint64, device=device)
    clusters.begin = wp.array(begin, dtype=wp.int32, device=device)
    clusters.nodes = wp.array(corners[order][starts][rank].astype(np.int32), dtype=wp.int32, device=device)
    clusters.sums = wp.array(sums.astype(np.int32), dtype=wp.int32, device=device)
    clusters.slots = wp.array(slots, dtype=wp.uint16, device=device)
    return clusters, count
