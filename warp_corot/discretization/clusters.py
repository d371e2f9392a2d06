"""Elements in clusters that share their nodes' sums: in pairs that share a face, see ``kernels.clusters.pairs``, or one
by one, see ``kernels.clusters.single``."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.kernels.clusters.pair_tables import cut_clusters, pack_slots
from warp_corot.kernels.clusters.pairs import (
    FIRST_MATRIX,
    GENERAL_VOLUMES,
    GENERAL_WORDS,
    LATTICE_WORDS,
    PAIR_TASK_SLOTS,
    TASK_WORDS,
    GeneralPairs,
    LatticePairs,
    PairClusters,
    vec4u,
)
from warp_corot.kernels.clusters.single import BACKWARDS, SWAPS, Clusters, vec2ul
from warp_corot.kernels.clusters.single_tables import find_clusters
from warp_corot.kernels.elements.elements import GeneralElements
from warp_corot.kernels.tables.cluster_layout import BANK_GROUPS, DEFAULT_LAYOUT, QUAD_BYTES, ClusterLayout, PairLayout
from warp_corot.kernels.tables.shapes import SQRT2

#: Elements of a stretch that is about a cluster.
STRETCH = 128
#: Nodes of a pair.
CORNERS = 5
#: Elements are paired if they are at most this far apart in the list of those without a partner.
REACH = 6
#: The four nodes in an order that begins with a face's three, for each node opposite the face.
_OPPOSITE = np.array([[1, 2, 3, 0], [0, 2, 3, 1], [0, 1, 3, 2], [0, 1, 2, 3]])


def paired(tets: npt.NDArray[np.int32]) -> npt.NDArray[np.int32]:
    """Pairs of elements that share a face and are near one another in a list; the others are pairs without a second.

    Args:
        tets: Nodes of elements, int32 [T, 4].

    Returns:
        Places in the list, ordered by the first of each pair, int32 [pairs, 2]; the second is -1 if there is none.
    """
    left = np.arange(len(tets), dtype=np.int32)
    found = [np.empty((0, 2), np.int32)]
    for step in range(1, REACH + 1):
        if len(left) <= step:
            break
        first, second = left[:-step], left[step:]
        chosen = _every_other(_share_a_face(tets, first, second), step)
        found.append(np.column_stack([first[chosen], second[chosen]]))
        alone = np.ones(len(left), bool)
        alone[chosen] = alone[chosen + step] = False
        left = left[alone]
    found.append(np.column_stack([left, np.full_like(left, -1)]))
    pairs = np.concatenate(found)
    return pairs[np.argsort(pairs[:, 0], kind="stable")]


def _share_a_face(
    tets: npt.NDArray[np.int32], first: npt.NDArray[np.int32], second: npt.NDArray[np.int32]
) -> npt.NDArray[np.bool_]:
    count = np.zeros(len(first), np.int8)
    for i in range(4):
        for j in range(4):
            count += tets[first, i] == tets[second, j]
    return count == 3


def _every_other(fits: npt.NDArray[np.bool_], step: int) -> npt.NDArray[np.int64]:
    """Places i where i and i + step make a pair, chosen so that no element is in two pairs."""
    places = np.flatnonzero(fits)
    places = places[np.lexsort((places, places % step))]
    # In a chain i, i + step, i + 2 step, ..., these are the first, the third and so on.
    begins = np.flatnonzero(np.diff(places, prepend=-2 * step - 1) != step)
    in_chain = np.arange(len(places)) - np.repeat(begins, np.diff(begins, append=len(places)))
    return np.sort(places[in_chain % 2 == 0])


def roles_of(
    tets: npt.NDArray[np.int32], pairs: npt.NDArray[np.int32]
) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.int64]]:
    """Nodes a, b, c of the face, d and e of pairs, int32 [pairs, 5], and which of its four nodes an element has in the
    roles a, b, c and d, or e: [pairs, 2, 4].

    Without a second element e is a, and its roles have no meaning.
    """
    first, second = tets[pairs[:, 0]], tets[pairs[:, 1]]
    shared = (first[:, :, None] == second[:, None, :]).any(axis=2)
    alone = pairs[:, 1] < 0
    shared[alone] = [True, True, True, False]
    order = _OPPOSITE[np.argmin(shared, axis=1)]
    nodes = np.take_along_axis(first, order, axis=1)
    # Where the second element has a, b and c; the remaining place follows from 0 + 1 + 2 + 3.
    at = np.argmax(second[:, None, :] == nodes[:, :3, None], axis=2)
    apex = 6 - at.sum(axis=1, keepdims=True)
    apex[alone] = 0
    e = np.where(alone, nodes[:, 0], np.take_along_axis(second, apex, axis=1)[:, 0])
    return np.column_stack([nodes, e]).astype(np.int32), np.stack([order, np.hstack([at, apex])], axis=1)


def gradients_of(
    rest_inverse: npt.NDArray[np.float32], pairs: npt.NDArray[np.int32], roles: npt.NDArray[np.int64]
) -> npt.NDArray[np.float32]:
    """B of both elements of each pair, zero if there is none: [pairs, 2, 3, 3].

    Args:
        rest_inverse: Inverse rest edges from each element's first node, [T, 3, 3].
    """
    rows = rest_inverse[pairs]
    gradients = np.concatenate([-rows.sum(axis=2, keepdims=True), rows], axis=2)
    b = np.take_along_axis(gradients, roles[:, :, 1:, None], axis=2)
    b[pairs[:, 1] < 0, 1] = 0.0
    return b


def device_pairs(
    corners: npt.NDArray[np.integer],
    gradients: npt.NDArray[np.float32],
    volumes: npt.NDArray[np.float32],
    cell: float | None,
    device: wp.Device,
) -> LatticePairs | GeneralPairs:
    """Pairs as the kernels read them.

    Args:
        corners: Places of nodes a to e in bytes, [pairs, 5].
        gradients: B of both elements, [pairs, 2, 3, 3].
        volumes: Volumes of both, zero without a second, [pairs, 2].
        cell: Edge length of a forest's root cubes; None for a general mesh.
    """
    count, words = len(corners), GENERAL_WORDS if cell is None else LATTICE_WORDS
    records = np.zeros((count, words), "<u4")
    halves = records.view("<u2")
    halves[:, :5] = corners
    if cell is None:
        pairs: LatticePairs | GeneralPairs = GeneralPairs()
        records[:, FIRST_MATRIX : FIRST_MATRIX + 18] = gradients.reshape(count, 18).astype("<f4").view("<u4")
        records[:, GENERAL_VOLUMES : GENERAL_VOLUMES + 2] = volumes.astype("<f4").view("<u4")
    else:
        pairs = LatticePairs()
        pairs.inverse_cell, pairs.scale = 1.0 / cell, cell * cell / 6.0
        whole = np.round(gradients.reshape(count, 18) * cell).astype("<f4")
        halves[:, 2 * FIRST_MATRIX : 2 * FIRST_MATRIX + 18] = whole.view("<u4") >> 16
        # Six volumes over a root cube's volume are a power of two; the kernels read its exponent as float32 stores it.
        sixths = (volumes * (6.0 / cell**3)).astype("<f4")
        exponents = np.where(sixths > 0, np.round(np.log2(np.maximum(sixths, 1e-30))) + 127, 0).astype(np.uint16)
        halves[:, 5] = exponents[:, 0] | exponents[:, 1] << 8
    pairs.count = count
    quads = np.ascontiguousarray(records.reshape(count, -1, 4).transpose(1, 0, 2)).reshape(-1, 4)
    pairs.records = wp.array(quads, dtype=vec4u, device=device)
    return pairs


def order_in_clusters(points: npt.NDArray[np.float64], tets: npt.NDArray[np.int32]) -> npt.NDArray[np.int32]:
    """An order of a mesh's elements in which neighbours are close, int32 [T]; the given one if it is good enough.

    Args:
        points: Rest positions, [N, 3].
        tets: Nodes of elements, [T, 4].
    """
    given = np.arange(len(tets), dtype=np.int32)
    along_curve = np.argsort(_morton(points[tets].mean(axis=1)), kind="stable").astype(np.int32)
    # The fewer nodes clusters have, the less they read and sum.
    counts = [_node_count(tets[order]) for order in (given, along_curve)]
    return given if counts[0] <= counts[1] else along_curve


def _morton(x: npt.NDArray[np.float64]) -> npt.NDArray[np.uint64]:
    """Places of points [n, 3] on a curve that goes through each octant of a cube before it enters the next."""
    low = x.min(axis=0)
    cells = ((x - low) * (((1 << 20) - 1) / max(float(np.ptp(x, axis=0).max()), 1e-300))).astype(np.uint64)
    for shift, mask in (
        (32, 0x1F00000000FFFF),
        (16, 0x1F0000FF0000FF),
        (8, 0x100F00F00F00F00F),
        (4, 0x10C30C30C30C30C3),
        (2, 0x1249249249249249),
    ):
        cells = (cells | cells << np.uint64(shift)) & np.uint64(mask)
    return cells[:, 0] << np.uint64(2) | cells[:, 1] << np.uint64(1) | cells[:, 2]


def _node_count(tets: npt.NDArray[np.int32]) -> int:
    """Total number of nodes of stretches of elements in this order."""
    whole = len(tets) // STRETCH * STRETCH
    if whole == 0:
        return 0
    nodes = np.sort(tets[:whole].reshape(-1, 4 * STRETCH), axis=1)
    return int((np.diff(nodes, axis=1) != 0).sum())


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
        ``kernels.clusters.pairs``; and the number of clusters.
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


# --- elements one by one ---------------------------------------------------------------------------------------------


def changing_clusters(most: int, count: wp.array, layout: ClusterLayout = DEFAULT_LAYOUT) -> tuple[Clusters, int]:
    """Allocate clusters of all elements of a changing mesh; ``find_tables`` fills them in.

    Args:
        most: The largest possible number of elements.
        count: The number of elements, int32 [1] on the device.
        layout: The layout for which kernels are generated.

    Returns:
        ``kernels.clusters.single.Clusters``, and the largest possible number of clusters.
    """
    device = count.device
    clusters, places = Clusters(), -(-most // layout.elements)
    # A cluster has at most as many tasks as corners.
    tasks = layout.corners * places
    clusters.count = count
    clusters.elements = wp.array(np.arange(most), dtype=wp.int32, device=device)
    clusters.corners = wp.zeros(layout.elements * places, dtype=wp.uint64, device=device)
    clusters.begin = wp.array(np.arange(0, tasks, layout.corners), dtype=wp.int32, device=device)
    clusters.task_count, clusters.node_count = (wp.zeros(places, dtype=wp.int32, device=device) for _ in range(2))
    clusters.nodes = wp.zeros(tasks, dtype=wp.int32, device=device)
    clusters.slots = wp.zeros(tasks, dtype=vec2ul, device=device)
    return clusters, places


def find_tables(
    clusters: Clusters, places: int, nodes: wp.array, goes: wp.array, layout: ClusterLayout = DEFAULT_LAYOUT
) -> None:
    """Find the tables for elements with these nodes, vec4i, by launches, if ``goes``, int32 [1], is not zero."""
    lanes = layout.threads if goes.device.is_cuda else 1
    wp.launch(
        find_clusters(layout),
        dim=places * lanes,
        inputs=[lanes, nodes, goes],
        outputs=[clusters],
        device=goes.device,
        block_dim=layout.threads,
    )


def axis_words(frames: npt.NDArray[np.float64]) -> npt.NDArray[np.int32]:
    """The integers of elements without their halvings, by frame, mirrored or not, and type: int32 [n, 2, 3].

    Args:
        frames: Proper local frames, [n, 3, 3]; if a frame does not occur with a type, its integer has no meaning.
    """
    words = np.zeros((len(frames), 2, 3), np.int32)
    orders = _orders()
    for mirrored in range(2):
        columns = frames * [1.0, 1.0, 1.0 - 2.0 * mirrored]
        q0, q1, q2 = np.moveaxis(columns, 2, 0)
        halves = np.stack([(q1 - q0) / SQRT2, -(q0 + q1) / SQRT2, q2], axis=2)
        for shape in range(3):
            axes = np.round(halves if shape == 2 else columns).astype(int)
            for k, (entries, order) in enumerate(zip(axes, np.abs(axes).argmax(axis=1), strict=True)):
                # Axis i points along component order[i], backwards if its entry is negative.
                swaps = orders.get((int(order[0]), int(order[1]), int(order[2])), 0)
                backwards = sum(bit for i, bit in enumerate(BACKWARDS) if entries[order[i], i] < 0)
                words[k, mirrored, shape] = shape | swaps | backwards
    return words


def _orders() -> dict[tuple[int, int, int], int]:
    """For each order of the three components, the swaps that produce it."""
    found: dict[tuple[int, int, int], int] = {}
    for bits in range(8):
        x, y, z = 0, 1, 2
        if bits & 1:
            x, y = y, x
        if bits & 2:
            y, z = z, y
        if bits & 4:
            x, y = y, x
        found.setdefault((x, y, z), sum(SWAPS[k] for k in range(3) if bits >> k & 1))
    return found
