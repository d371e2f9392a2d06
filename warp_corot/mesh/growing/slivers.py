"""Elements that a mesh gives up: nearly empty ones, where that breaks no piece of the mesh, and disconnected tips of a
body."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from warp_corot.mesh.topology import face_pairs, linked

if TYPE_CHECKING:
    from warp_corot.domain import Domain

Array = np.ndarray

#: A part that would come off is given up if it has at most this many elements and less than this fraction of its piece.
FEW_ELEMENTS, LITTLE = 4, 1.0e-3


@dataclass(frozen=True, eq=False)
class Filling:
    """The parts of a body in elements.

    Attributes:
        pairs: Pairs of elements that share a face [m, 2].
        held: Volume of the body in each element [n].
        least: Elements that hold less than this are small [n].
        total: About the volume of all elements.
    """

    pairs: Array
    held: Array
    least: Array
    total: float

    def exact(self, volumes: Array) -> Array:
        """Volumes as whole numbers, whose sums do not depend on the order [n]."""
        return np.rint(np.ldexp(volumes, 50 - int(np.ceil(np.log2(self.total)))))

    def without(self, left_out: Array, held: Array) -> Filling:
        """The rest, in the same order, with other volumes."""
        kept, number = np.flatnonzero(~left_out), np.cumsum(~left_out) - 1
        pairs = number[self.pairs[~left_out[self.pairs].any(axis=1)]]
        return replace(self, pairs=pairs, held=held[kept], least=self.least[kept])


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
    small = held < sliver * volume
    if not small.any():
        return held, small
    filling = Filling(face_pairs(tets), held, sliver * volume, float(volume.sum()))
    crumbs, held = _crumbs(tets, filling, linked(filling.pairs, len(held)), small)
    volumes, given_up = np.zeros(len(held)), crumbs.copy()
    kept = np.flatnonzero(~crumbs)
    volumes[kept], given_up[kept] = _without(filling.without(crumbs, held) if crumbs.any() else filling)
    return volumes, given_up


def _without(filling: Filling) -> tuple[Array, Array]:
    """`without_slivers` of elements that are connected to others through faces, or not at all."""
    pairs, held = filling.pairs, filling.held
    small = held < filling.least
    if not small.any():
        return held, small
    piece = linked(pairs, len(held))
    volumes, given_up = merged(pairs, held, small)
    broken, small_parts = _broken(filling, piece, ~given_up, volumes)
    if broken.any() or small_parts.any():
        small |= small_parts
        small &= ~_ways(filling, piece, ~given_up & ~small_parts, broken)
        volumes, given_up = merged(pairs, held, small)
    return volumes, given_up


def _broken(filling: Filling, piece: Array, kept: Array, volumes: Array) -> tuple[Array, Array]:
    """The pieces that break without the elements that are not kept.

    Returns:
        The mask of elements of these pieces, bool [n], and the mask of elements of their negligible parts.
    """
    count, pairs, volumes = len(piece), filling.pairs, filling.exact(volumes)
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


def _ways(filling: Filling, piece: Array, kept: Array, broken: Array) -> Array:
    """Elements through which the parts of broken pieces are connected by the shortest ways, bool [n]."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import breadth_first_order

    count, pairs = len(piece), filling.pairs
    found = np.zeros(count, bool)
    if not broken.any():
        return found
    part = linked(pairs[kept[pairs].all(axis=1)], count)
    sizes = np.bincount(part, kept)
    largest = np.zeros(int(piece.max()) + 1, np.int64)
    by_size = np.argsort(sizes[part], kind="stable")
    largest[piece[by_size]] = part[by_size]
    apart = broken & (part != largest[piece])
    # An additional node, linked to the largest part of each piece, allows one search for all pieces. Of ways of one
    # length it finds the one through the first elements.
    pairs = pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))]
    start = np.flatnonzero(kept & (part == largest[piece]))
    rows, columns = np.append(pairs[:, 0], np.full(len(start), count)), np.append(pairs[:, 1], start)
    links = coo_array((np.ones(len(rows), np.int8), (rows, columns)), shape=(count + 1, count + 1)).tocsr()
    order, before = breadth_first_order(links, count, directed=False)
    order = order[1:]
    others = order[kept[order] & apart[order]]
    _, first = np.unique(part[others], return_index=True)
    at = others[first]
    while len(at):
        at = before[at]
        at = np.unique(at[(at != count) & ~found[np.minimum(at, count - 1)]])
        found[at] = True
        at = at[part[at] != largest[piece[at]]]
    return found


def _crumbs(tets: Array, filling: Filling, piece: Array, small: Array) -> tuple[Array, Array]:
    """Pieces of few or only small elements that are connected to others only through nodes, about which they would
    rotate.

    Returns:
        The mask of their elements, bool [n], and the volumes after they are added to the connected elements.
    """
    held, exact = filling.held, filling.exact(filling.held)
    sizes, volumes = np.bincount(piece), np.bincount(piece, exact)
    little = volumes < LITTLE * volumes.sum()
    tiny = (sizes <= FEW_ELEMENTS) & little | (np.bincount(piece, ~small) == 0)
    suspects = tiny[piece]
    if not suspects.any() or suspects.all():
        return np.zeros(len(piece), bool), held
    # For each suspect the last other element that shares a node with it.
    last, rest = np.full(int(tets.max()) + 1, -1), np.flatnonzero(~suspects)
    last[tets[rest]] = rest[:, None]
    to = np.full(len(sizes), -1)
    np.maximum.at(to, piece[suspects], last[tets[suspects]].max(axis=1))
    crumbs = suspects & (to[piece] >= 0)
    held = held.copy()
    np.add.at(held, to[piece[crumbs]], held[crumbs])
    held[crumbs] = 0.0
    return crumbs, held


def _fullest_of_each_piece(pairs: Array, waiting: Array, held: Array) -> Array:
    n = len(waiting)
    piece = linked(pairs[waiting[pairs].all(axis=1)], n)
    left = np.flatnonzero(waiting)
    left = left[np.argsort(held[left], kind="stable")]
    fullest = np.full(n, -1)
    fullest[piece[left]] = left
    return fullest[fullest >= 0]


#: A piece that holds less than this share of the body is a stray.
STRAY = 2.0e-4
#: Meshes of more elements keep their strays; the search would take long.
MOST_ELEMENTS = 100_000
#: Strays that together hold more than this share of the body are named.
NAMED = 1.0e-4


def strays(tets: np.ndarray, held: np.ndarray, given_up: np.ndarray, domain: Domain) -> tuple[np.ndarray, str]:
    """Which elements are strays, bool [n], and a sentence about them, empty if they hold next to nothing. None are if
    the body is not known to be one piece.

    Args:
        tets: int32 [n, 4].
        held: Volume that each holds [n].
        given_up: Which are not part of the mesh, bool [n].
        domain: The body.
    """
    found, body = np.zeros(len(held), bool), cast("Any", domain)
    if not hasattr(body, "closed") or len(tets) > MOST_ELEMENTS:
        return found, ""
    pairs = face_pairs(tets)
    kept = np.flatnonzero(~given_up)
    _, piece = np.unique(linked(pairs[~given_up[pairs].any(axis=1)], len(held))[kept], return_inverse=True)
    # Parts of a surface that touch or cross are one piece of the body.
    if not piece.any() or body.joined[0] > 1:
        return found, ""
    volumes = np.bincount(piece, held[kept])
    stray = volumes < STRAY * volumes.sum()
    found[kept] = stray[piece]
    share = float(volumes[stray].sum() / volumes.sum())
    if share <= NAMED:
        return found, ""
    return found, (
        f"{np.count_nonzero(stray)} pieces of the mesh, tips of the body that are thinner than its tetrahedra, touch "
        f"the rest by less than a face and are left out: {share:.2%} of the volume; more tetrahedra would help"
    )
