"""Elements in clusters that share their nodes' sums; see ``kernels.clusters.single``."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.kernels.clusters.elements import BACKWARDS, SWAPS
from warp_corot.kernels.clusters.single import Clusters, vec2ul
from warp_corot.kernels.clusters.tables import find_clusters
from warp_corot.kernels.tables.cluster_layout import DEFAULT_LAYOUT, ClusterLayout
from warp_corot.kernels.tables.shapes import SQRT2


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


def order_in_clusters(
    points: npt.NDArray[np.float64], tets: npt.NDArray[np.int32], layout: ClusterLayout = DEFAULT_LAYOUT
) -> npt.NDArray[np.int32]:
    """An order of a mesh's elements in which neighbours are close, int32 [T]; the given one if it is good enough.

    Args:
        points: Rest positions, [N, 3].
        tets: Nodes of elements, [T, 4].
    """
    given = np.arange(len(tets), dtype=np.int32)
    along_curve = np.argsort(_morton(points[tets].mean(axis=1)), kind="stable").astype(np.int32)
    # The fewer nodes clusters have, the less they read and sum.
    counts = [_node_count(tets[order], layout) for order in (given, along_curve)]
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


def _node_count(tets: npt.NDArray[np.int32], layout: ClusterLayout) -> int:
    """Total number of clusters' nodes for elements in this order."""
    whole = len(tets) // layout.elements * layout.elements
    if whole == 0:
        return 0
    nodes = np.sort(tets[:whole].reshape(-1, layout.corners), axis=1)
    return int((np.diff(nodes, axis=1) != 0).sum())


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
