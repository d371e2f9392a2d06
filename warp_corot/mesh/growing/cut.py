"""Elements cut by a surface: their filled fraction.

All quantities belong to the linear interpolant of the nodes' values. A node is inside if its value is negative; zero
counts as outside, so that the surface lies in elements that contain a part of the body.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

Array = np.ndarray

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
