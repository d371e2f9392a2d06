"""Elements cut by a surface: their filled fraction, and the treatment of nearly empty ones.

All quantities belong to the linear interpolant of the nodes' values. A node is inside if its value is negative; zero
counts as outside, so that the surface lies in elements that contain a part of the body.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from warp_corot.mesh.sorting import sorted_keys

Array = np.ndarray

#: A part that would come off is given up if it has at most this many elements and less than this fraction of its piece.
FEW_ELEMENTS, LITTLE = 4, 1.0e-3

#: Node orders that put the inside nodes first, by the set of inside nodes (bit n for node n), and the number of inside
#: nodes.
_INSIDE_FIRST = np.array([sorted(range(4), key=lambda n: 1 - (code >> n & 1)) for code in range(16)])
_COUNT = np.array([code.bit_count() for code in range(16)])


def codes(inside: Array) -> Array:
    """The set of inside nodes of elements, bool [n, 4], as a number from 0 to 15."""
    return inside @ np.array([1, 2, 4, 8])


def shares(inside: Array, crossing: Callable[[Array, Array], Array]) -> Array:
    """Share of each element's volume around its inside nodes, float64 [n].

    Args:
        inside: bool [n, 4].
        crossing: A function of a node inside and one outside of each element, both int [n]: the fraction of their edge,
            from the inside node to the border, [n].
    """
    code = codes(inside)
    found = (code == 15).astype(np.float64)
    for count, share in ((1, _share_of_one), (2, _share_of_two), (3, _share_of_three)):
        chosen = np.flatnonzero(_COUNT[code] == count)
        nodes = _INSIDE_FIRST[code[chosen]]

        def at(i: int, j: int, chosen: Array = chosen, nodes: Array = nodes) -> Array:
            return crossing(chosen, nodes[:, [i, j]])

        found[chosen] = share(at)
    return found


def _share_of_one(t: Callable[[int, int], Array]) -> Array:
    return t(0, 1) * t(0, 2) * t(0, 3)


def _share_of_two(t: Callable[[int, int], Array]) -> Array:
    """The wedge from a-ac-ad to b-bc-bd, in three tetrahedra."""
    ac, ad, bc, bd = t(0, 2), t(0, 3), t(1, 2), t(1, 3)
    return ac * ad + (1 - ad) * ac * bd + (1 - ac) * bc * bd


def _share_of_three(t: Callable[[int, int], Array]) -> Array:
    return 1 - (1 - t(0, 3)) * (1 - t(1, 3)) * (1 - t(2, 3))


def inside_shares(values: Array) -> Array:
    """Fraction of each element's volume in which the linear interpolant of its nodes' values [n, 4] is negative."""

    def crossing(elements: Array, ends: Array) -> Array:
        inner, outer = values[elements[:, None], ends].T.astype(np.float64)
        return inner / (inner - outer)

    return shares(values < 0, crossing)


def label_shares(values: Array, labels: Array) -> Array:
    """Share of each element's volume that the label of each of its nodes takes, float64 [n, 4].

    If several inside nodes have a label, its fraction is stored at the first of them. Between nodes of two labels the
    border is halfway; towards the outside it is at the zero of the interpolant. Each label is cut out separately; if
    three labels meet, these cuts leave a gap, which the labels share in proportion.

    Args:
        values: Signed function at the nodes [n, 4].
        labels: int32 [n, 4].
    """
    inside = values < 0

    def crossing(elements: Array, ends: Array) -> Array:
        own, other = values[elements[:, None], ends].T.astype(np.float64)
        return np.divide(own, own - other, out=np.full(len(own), 0.5), where=other >= 0)

    found = np.zeros(values.shape)
    counted = np.zeros(values.shape, bool)
    for node in range(4):
        alike = inside & (labels == labels[:, [node]])
        found[:, node] = np.where(inside[:, node] & ~counted[:, node], shares(alike, crossing), 0.0)
        counted |= alike & inside[:, [node]]
    total = found.sum(axis=1, keepdims=True)
    return np.divide(found * inside_shares(values)[:, None], total, out=np.zeros_like(found), where=total > 0)


def merged(pairs: Array, held: Array, small: Array) -> tuple[Array, Array]:
    """Add the contents of small elements to the fullest neighbour across a face, and so on outwards.

    Among small elements that have only small neighbours, the fullest one stays.

    Args:
        pairs: Pairs of elements that share a face [m, 2].
        held: Volume of the body in each element [n].
        small: Mask of the elements to be given up, bool [n].

    Returns:
        The new volumes, and the mask of elements that are given up.
    """
    held, small = held.copy(), small.copy()
    pairs = np.concatenate([pairs[small[pairs[:, 0]]], pairs[small[pairs[:, 1]]][:, ::-1]])
    goes_to = np.full(len(held), -1)
    waiting = small.copy()
    while waiting.any():
        # From each waiting element to its settled neighbours; of several, to the fullest one.
        usable = pairs[waiting[pairs[:, 0]] & ~waiting[pairs[:, 1]]]
        if not len(usable):
            waiting[_fullest_of_each_piece(pairs, waiting, held)] = False
            continue
        usable = usable[np.lexsort((usable[:, 1], held[usable[:, 1]]))]
        goes_to[usable[:, 0]] = usable[:, 1]
        waiting[usable[:, 0]] = False
    given_up = goes_to >= 0
    target = goes_to.copy()
    while (on := given_up & given_up[np.maximum(target, 0)]).any():
        target[on] = goes_to[target[on]]
    np.add.at(held, target[given_up], held[given_up])
    held[given_up] = 0.0
    return held, given_up


def without_slivers(tets: Array, held: Array, volume: Array, sliver: float) -> tuple[Array, Array]:
    """Give up elements that contain too little of a body, but none that connects parts of a piece.

    Pieces are connected through faces.

    Args:
        tets: int32 [n, 4].
        held: Volume of the body in each element [n].
        volume: Of each [n].
        sliver: Elements filled by less than this fraction are small.

    Returns:
        The new volumes of the body in elements, and the mask of elements that are given up.
    """
    least = sliver * volume
    if (held >= least).all():
        return held, np.zeros(len(tets), bool)
    return _without(tets, face_pairs(tets), held, least)


def _without(tets: Array, pairs: Array, held: Array, least: Array) -> tuple[Array, Array]:
    """`without_slivers` by the pairs that share a face [m, 2], with the least volume for each element [n]."""
    small, count = held < least, len(tets)
    if not small.any():
        return held, small
    piece = linked(pairs, count)
    crumbs, held = _crumbs(tets, piece, small, held)
    if crumbs.any():
        kept = np.flatnonzero(~crumbs)
        given_up = crumbs.copy()
        volumes = np.zeros(count)
        number = np.cumsum(~crumbs) - 1
        rest = number[pairs[~crumbs[pairs].any(axis=1)]]
        volumes[kept], given_up[kept] = _without(tets[kept], rest, held[kept], least[kept])
        return volumes, given_up
    volumes, given_up = merged(pairs, held, small)
    broken, small_parts = _broken(pairs, piece, ~given_up, volumes)
    if broken.any() or small_parts.any():
        small |= small_parts
        small &= ~_ways(pairs, piece, ~given_up & ~small_parts, broken)
        volumes, given_up = merged(pairs, held, small)
    return volumes, given_up


def _broken(pairs: Array, piece: Array, kept: Array, volumes: Array) -> tuple[Array, Array]:
    """The pieces that break without the elements that are not kept.

    Returns:
        The mask of elements of these pieces, bool [n], and the mask of elements of their negligible parts.
    """
    count = len(piece)
    part = linked(pairs[kept[pairs].all(axis=1)], count)
    sizes, held = np.bincount(part, kept), np.bincount(part, volumes)
    whole = np.bincount(piece, volumes)
    of_part = np.zeros(len(sizes), np.int64)
    of_part[part] = piece
    minor = (sizes > 0) & (sizes <= FEW_ELEMENTS) & (held < LITTLE * whole[of_part])
    parts = np.bincount(of_part, (sizes > 0) & ~minor, len(whole))
    # If all parts are negligible, none is given up for this reason.
    minor &= parts[of_part] > 0
    return (parts > 1)[piece], minor[part] & kept


def _ways(pairs: Array, piece: Array, kept: Array, broken: Array) -> Array:
    """Elements through which the parts of broken pieces are connected by the shortest ways, bool [n]."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import breadth_first_order

    count = len(piece)
    found = np.zeros(count, bool)
    if not broken.any():
        return found
    part = linked(pairs[kept[pairs].all(axis=1)], count)
    sizes = np.bincount(part, kept)
    largest = np.zeros(int(piece.max()) + 1, np.int64)
    by_size = np.argsort(sizes[part], kind="stable")
    largest[piece[by_size]] = part[by_size]
    # An additional node, linked to the largest part of each piece, allows one search for all pieces.
    start = np.flatnonzero(kept & (part == largest[piece]))
    rows, columns = np.append(pairs[:, 0], np.full(len(start), count)), np.append(pairs[:, 1], start)
    links = coo_array((np.ones(len(rows), np.int8), (rows, columns)), shape=(count + 1, count + 1)).tocsr()
    order, before = breadth_first_order(links, count, directed=False)
    order = order[1:]
    others = order[kept[order] & broken[order] & (part[order] != largest[piece[order]])]
    _, first = np.unique(part[others], return_index=True)
    at = others[first]
    while len(at):
        at = before[at]
        at = np.unique(at[(at != count) & ~found[np.minimum(at, count - 1)]])
        found[at] = True
        at = at[part[at] != largest[piece[at]]]
    return found


def _crumbs(tets: Array, piece: Array, small: Array, held: Array) -> tuple[Array, Array]:
    """Pieces of few or only small elements that are connected to others only through nodes, about which they would
    rotate.

    Returns:
        The mask of their elements, bool [n], and the volumes after they are added to the connected elements.
    """
    sizes, volumes = np.bincount(piece), np.bincount(piece, held)
    tiny = (sizes <= FEW_ELEMENTS) & (volumes < LITTLE * volumes.sum()) | (np.bincount(piece, ~small) == 0)
    suspects = tiny[piece]
    if not suspects.any() or suspects.all():
        return np.zeros(len(tets), bool), held
    anchor = np.full(int(tets.max()) + 1, -1)
    rest = np.flatnonzero(~suspects)
    anchor[tets[rest]] = rest[:, None]
    at = anchor[tets[suspects]].max(axis=1)
    to = np.full(len(sizes), -1)
    np.maximum.at(to, piece[suspects], at)
    crumbs = suspects & (to[piece] >= 0)
    held = held.copy()
    np.add.at(held, to[piece[crumbs]], held[crumbs])
    held[crumbs] = 0.0
    return crumbs, held


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
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    links = coo_array((np.ones(len(pairs), np.int8), pairs.T), shape=(count, count))
    return connected_components(links, directed=False)[1]


def connected(tets: Array) -> Array:
    """The piece of each element [n]; elements that share a node are connected. Negative nodes connect nothing."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    count = int(tets.max()) + 1
    first = tets.max(axis=1)
    tets = np.where(tets < 0, first[:, None], tets)
    # An element without any node is a piece by itself.
    alone = first < 0
    tets[alone] = count + np.arange(np.count_nonzero(alone), dtype=tets.dtype)[:, None]
    count += int(np.count_nonzero(alone))
    rows, columns = np.repeat(tets[:, 0], 3), tets[:, 1:].ravel()
    links = coo_array((np.ones(len(rows), np.int8), (rows, columns)), shape=(count, count))
    return connected_components(links, directed=False)[1][tets[:, 0]]


def _fullest_of_each_piece(pairs: Array, waiting: Array, held: Array) -> Array:
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    linked = pairs[waiting[pairs].all(axis=1)]
    n = len(waiting)
    _, piece = connected_components(coo_array((np.ones(len(linked)), linked.T), shape=(n, n)), directed=False)
    left = np.flatnonzero(waiting)
    left = left[np.argsort(held[left], kind="stable")]
    fullest = np.full(n, -1)
    fullest[piece[left]] = left
    return fullest[fullest >= 0]
