"""Elements in clusters of pairs that share their nodes' sums; see ``kernels.clusters.pairs``."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.kernels.clusters.pair_elements import GeneralPairs, LatticePairs, vec4u
from warp_corot.kernels.clusters.pair_tables import cut_clusters, pack_slots
from warp_corot.kernels.clusters.pairs import PAIR_TASK_SLOTS, TASK_WORDS, PairClusters
from warp_corot.kernels.elements.elements import GeneralElements
from warp_corot.kernels.tables.cluster_layout import BANK_GROUPS, QUAD_BYTES, PairLayout

from .pairing import device_pairs, gradients_of, paired, roles_of

#: Nodes of a pair.
CORNERS = 5


def pairs_in_clusters(
    chosen: npt.NDArray[np.int32],
    nodes: npt.NDArray[np.int32],
    general: GeneralElements,
    cell: float | None,
    layout: PairLayout,
) -> tuple[PairClusters, LatticePairs | GeneralPairs, int]:
    """Clusters of paired elements, in the given order of the elements.

    Args:
        chosen: The elements, int32 [n].
        nodes: Nodes of all elements, int32 [T, 4].
        general: All of them as ``kernels.elements.elements.GeneralElements``.
        cell: Edge length of a forest's root cubes [m]; None for a general mesh.
        layout: The layout for which the kernel is generated.

    Returns:
        ``PairClusters`` of ``kernels.clusters.pairs``; ``LatticePairs`` or ``GeneralPairs`` of
        ``kernels.clusters.pair_elements``; and the number of clusters.
    """
    device, tets = general.nodes.device, nodes[chosen]
    pairs = paired(tets)
    of_pairs, roles = roles_of(tets, pairs)
    begins = _cut(of_pairs, layout.threads)
    # The place of each pair, and the pair at each place.
    count = len(begins) - 1
    cluster = np.repeat(np.arange(count), np.diff(begins))
    thread = layout.threads * cluster + np.arange(len(pairs)) - begins[cluster]
    clusters, places = _tasks(of_pairs, cluster, thread % layout.threads, count, layout, device)

    def by_thread(values: npt.NDArray[Any]) -> npt.NDArray[Any]:
        padded = np.zeros((count * layout.threads, *values.shape[1:]), values.dtype)
        padded[thread] = values
        return padded

    elements = by_thread(np.where(pairs < 0, 0, chosen[pairs]))
    clusters.elements = wp.array(elements.ravel(), dtype=wp.int32, device=device)
    gradients = gradients_of(general.rest_inverse.numpy()[chosen], pairs, roles)
    volumes = np.where(pairs < 0, 0.0, general.volume.numpy()[chosen][pairs])
    found = device_pairs(by_thread(QUAD_BYTES * places), by_thread(gradients), by_thread(volumes), cell, device)
    return clusters, found, count


def _cut(of_pairs: npt.NDArray[np.int32], threads: int) -> npt.NDArray[np.int32]:
    """The beginning of each cluster and the end of the last; no cluster has more pairs or tasks than threads."""
    nodes = int(of_pairs.max(initial=0)) + 1
    cluster_of, degree = wp.full(nodes, -1, dtype=wp.int32, device="cpu"), wp.zeros(nodes, dtype=wp.int32, device="cpu")
    begins, count = (wp.zeros(n, dtype=wp.int32, device="cpu") for n in (len(of_pairs), 1))
    given = wp.array(of_pairs, dtype=wp.int32, device="cpu")
    inputs = [given, threads, cluster_of, degree]
    wp.launch(cut_clusters, 1, inputs=inputs, outputs=[begins, count], device="cpu")
    return np.append(begins.numpy()[: count.numpy()[0]], len(of_pairs)).astype(np.int32)


def _tasks(
    of_pairs: npt.NDArray[np.int32],
    cluster: npt.NDArray[np.int64],
    thread: npt.NDArray[np.int64],
    count: int,
    layout: PairLayout,
    device: wp.Device,
) -> tuple[PairClusters, npt.NDArray[np.int64]]:
    """Tasks of clusters, and the places of pairs' nodes in theirs, [pairs, 5].

    Args:
        of_pairs: The pairs' nodes, [pairs, 5].
        cluster, thread: The place of each pair, [pairs].
    """
    key = (cluster[:, None] * (int(of_pairs.max(initial=0)) + 1) + of_pairs).ravel()
    # In ``order`` the corners on one node of a cluster are consecutive.
    order = np.argsort(key, kind="stable")
    starts = np.flatnonzero(np.diff(key[order], prepend=-1))
    degree = np.diff(starts, append=len(key))
    owner = cluster[order[starts] // CORNERS]
    # A node's first task is its place, so first tasks come first, the longest of them ahead: then the threads of a warp
    # have about equally long sums.
    pieces = -(-degree // PAIR_TASK_SLOTS)
    node = np.repeat(np.arange(len(starts)), pieces)
    piece = np.arange(len(node)) - np.repeat(np.cumsum(pieces) - pieces, pieces)
    rank = np.lexsort((-degree[node], piece > 0, owner[node]))
    node, piece = node[rank], piece[rank]
    begin = np.searchsorted(owner[node], np.arange(count))
    task = layout.threads * owner[node] + np.arange(len(node)) - begin[owner[node]]
    place = np.empty(len(starts), np.int64)
    place[node[piece == 0]] = task[piece == 0] % layout.threads
    places = np.empty(len(key), np.int64)
    places[order] = np.repeat(place, degree)
    at = PAIR_TASK_SLOTS * piece[:, None] + np.arange(PAIR_TASK_SLOTS)
    corner = order[np.minimum(starts[node, None] + at, len(order) - 1)]
    size = count * layout.threads
    slots, slot_count, nodes = np.zeros((size, PAIR_TASK_SLOTS), np.int32), np.zeros(size), np.full(size, -1)
    slots[task] = corner % CORNERS * layout.threads + thread[corner // CORNERS]
    slot_count[task] = np.minimum(degree[node] - PAIR_TASK_SLOTS * piece, PAIR_TASK_SLOTS)
    nodes[task] = of_pairs.ravel()[order[starts]][node]
    clusters = PairClusters()
    clusters.nodes = wp.array(nodes, dtype=wp.int32, device=device)
    packed = wp.zeros((size, TASK_WORDS), dtype=wp.uint32, device=device)
    given = wp.array(slots, dtype=wp.int32, device=device)
    counts = wp.array(slot_count, dtype=wp.int32, device=device)
    inputs = [layout.zero, counts, given]
    wp.launch(pack_slots, size // BANK_GROUPS, inputs=inputs, outputs=[packed], device=device)
    clusters.slots = packed.view(vec4u)
    return clusters, places.reshape(-1, CORNERS)
