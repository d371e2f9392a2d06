"""Elements in pairs that share a face, for clusters; see ``kernels.clusters.pair_elements``."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.kernels.clusters.pair_elements import (
    FIRST_MATRIX,
    GENERAL_VOLUMES,
    GENERAL_WORDS,
    LATTICE_WORDS,
    GeneralPairs,
    LatticePairs,
    vec4u,
)

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
