"""The division of a matrix's rows for threads that sweep over them side by side (nested dissection; George 1973)."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Numbers = npt.NDArray[np.integer]

#: A row takes as long as so many entries besides its own.
PER_ROW = 6
#: So few rows are left to one thread.
FEW = 64


def dissected(points: npt.NDArray[np.float64], starts: Numbers, columns: Numbers, parts: int) -> list[Numbers]:
    """The nodes of each level and part: no node of a level is coupled with one in another part of it, and the parts of
    a level take about equally long.

    A level is cut in halves, and these again, by coordinates; what separates two halves goes on to the next level.

    Args:
        points: Positions of the nodes, [N, 3].
        starts, columns: The entries of each row, [N + 1] and [entries].
        parts: Number of parts.

    Returns:
        The nodes of the parts of the first level, then those of the next one, and so on.
    """
    counts = np.diff(starts)
    weight, side = counts + PER_ROW, np.zeros(len(points), np.int8)
    edges = np.stack([np.repeat(np.arange(len(points)), counts), columns[: starts[-1]]])
    found, left = [], np.arange(len(points))
    while len(left) > FEW:
        level: list[Numbers] = [left[:0]] * parts
        between, waiting = [left[:0]], [(left, edges, 0, parts)]
        while waiting:
            nodes, own, first, share = waiting.pop()
            if share == 1 or not len(nodes):
                level[first] = np.sort(nodes)
                continue
            axes = np.argsort(-np.ptp(points[nodes], axis=0))
            # Points in one plane are ordered by the other axes; lattices have many such points.
            nodes = nodes[np.lexsort(points[nodes][:, axes[::-1]].T)]
            before, separating = np.cumsum(weight[nodes]), 0
            for _ in range(3):  # the halves are as large without what separates them, which is in the second one
                cut = int(np.searchsorted(before, (before[-1] - separating) * (share // 2) / share))
                side[nodes[:cut]], side[nodes[cut:]] = 1, 2
                ends = side[own]
                meets = own[1, (ends[0] == 1) & (ends[1] == 2)]
                side[meets] = 3
                separating = int(weight[nodes[side[nodes] == 3]].sum())
            ends = side[own]
            between.append(nodes[side[nodes] == 3])
            for half, begin, number in ((1, first, share // 2), (2, first + share // 2, share - share // 2)):
                waiting.append((nodes[side[nodes] == half], own[:, (ends == half).all(axis=0)], begin, number))
        found += level
        left = np.concatenate(between)
        side[:], side[left] = 0, 1
        edges = edges[:, side[edges].all(axis=0)]
    return [*found, left, *[left[:0]] * (parts - 1)] if len(left) else found
