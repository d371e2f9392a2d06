"""Patches of a mesh: compact sets of nodes, each with every element that touches it, for thread blocks that stay.

Plain NumPy. A patch owns its nodes and computes every element that has a corner there, so that its forces are whole
without another patch's help; elements between patches are computed by each of them. What a patch must be told in every
step are the positions of its halo, the other corners of its elements.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

WARP = 32

#: The slot of a corner that another patch owns.
NO_SLOT = 0xFFFF

#: Threads that add up one node at most: a node has two dozen elements.
MOST_LANES = 8


@dataclass(frozen=True, eq=False)
class Patches:
    """Who computes what; ``*_start`` arrays tell where each patch's part begins, int32 [patches + 1].

    Within a patch, nodes are numbered from 0: its own, most elements first, then its halo. Each own node is summed up
    by ``lanes`` neighbouring threads. The slots that the 32 threads of a warp read at once lie side by side: slot
    ``base + 32 row + thread``, where a warp has as many rows as its busiest thread needs and other places stay zero.

    Attributes:
        lanes: Threads that add up one node: 1, 2, 4, 8, 16 or 32.
        own, own_start: Nodes that patches own, int32 [N].
        halo, halo_start: Nodes that patches read of others, int32 [H].
        elements, element_start: Elements that patches compute, those without halo first, int32 [E].
        interior: How many elements of each patch have no corner in the halo, int32 [patches].
        corners: The four nodes of each of these, numbered in the patch, int32 [E, 4].
        slots: Where each corner's force goes; ``NO_SLOT`` at corners of the halo; int32 [E, 4].
        bases, base_start: Where each warp's slots begin, and past its last warp's the number of the patch's slots,
            int32.
    """

    lanes: int
    own: np.ndarray
    own_start: np.ndarray
    halo: np.ndarray
    halo_start: np.ndarray
    elements: np.ndarray
    element_start: np.ndarray
    interior: np.ndarray
    corners: np.ndarray
    slots: np.ndarray
    bases: np.ndarray
    base_start: np.ndarray

    @classmethod
    def of(cls, points: np.ndarray, tets: np.ndarray, count: int, threads: int) -> Patches:
        """Patches of about the same number of corners.

        Args:
            points: Rest positions, float64 [N, 3].
            tets: int32 [T, 4].
            count: How many patches, at most as many as nodes.
            threads: Of a block; they set how many add up one node.
        """
        n = len(points)
        valence = np.bincount(tets.ravel(), minlength=n)
        owner = patch_of_nodes(points, valence + 1, count)
        own = np.lexsort((np.arange(n), -valence, owner))
        own_start = _starts(np.bincount(owner, minlength=count))
        lanes = MOST_LANES
        while lanes > 1 and lanes * np.diff(own_start).max() > threads:
            lanes //= 2
        place = np.empty(n, np.int64)
        place[own] = np.arange(n)
        place -= own_start[owner]

        patch, element, element_start, interior = _elements_by_patch(owner[tets], count)
        nodes = tets[element]
        foreign = owner[nodes] != patch[:, None]
        halo, inverse = np.unique((patch[:, None] * n + nodes)[foreign], return_inverse=True)
        halo_start = _starts(np.bincount(halo // n, minlength=count))
        corners = place[nodes]
        of_halo = np.repeat(patch, foreign.sum(axis=1))
        corners[foreign] = inverse - halo_start[of_halo] + np.diff(own_start)[of_halo]

        bases, base_start = _slot_bases(valence[own], own_start, lanes)
        slots = np.full(nodes.shape, NO_SLOT)
        mine = nodes[~foreign]
        rank = _rank(mine, valence)
        thread = place[mine] * lanes + rank % lanes
        warp = base_start[owner[mine]] + thread // WARP
        slots[~foreign] = bases[warp] + rank // lanes * WARP + thread % WARP
        arrays = (
            own,
            own_start,
            halo % n,
            halo_start,
            element,
            element_start,
            interior,
            corners,
            slots,
            bases,
            base_start,
        )
        return cls(lanes, *(array.astype(np.int32) for array in arrays))

    @property
    def count(self) -> int:
        return len(self.own_start) - 1

    @property
    def most_own(self) -> int:
        """Own nodes of the patch that has most."""
        return int(np.diff(self.own_start).max())

    @property
    def most_halo(self) -> int:
        """Nodes in the largest halo."""
        return int(np.diff(self.halo_start).max())

    @property
    def most_nodes(self) -> int:
        """Nodes of the largest patch, own and of the halo."""
        return int((np.diff(self.own_start) + np.diff(self.halo_start)).max())

    @property
    def most_slots(self) -> int:
        """Slots of the patch that has most."""
        return int(self.bases[self.base_start[1:] - 1].max())

    @property
    def most_elements(self) -> int:
        """Elements of the largest patch."""
        return int(np.diff(self.element_start).max())


def patch_of_nodes(points: np.ndarray, weight: np.ndarray, count: int) -> np.ndarray:
    """Split points across the longest extent, and so on, into parts of about the same weight: int64 [N]."""
    patch = np.zeros(len(points), np.int64)
    waiting = [(np.arange(len(points)), 0, count)]
    while waiting:
        chosen, first, parts = waiting.pop()
        if parts == 1:
            patch[chosen] = first
            continue
        x = points[chosen]
        axes = np.argsort(-np.ptp(x, axis=0))
        # Points in one plane are ordered by the other axes; lattices have many such points.
        chosen = chosen[np.lexsort(x[:, axes[::-1]].T)]
        left = parts // 2
        share = np.cumsum(weight[chosen]) / weight[chosen].sum()
        cut = int(np.searchsorted(share, left / parts, side="right"))
        cut = min(max(cut, left), len(chosen) - (parts - left))
        waiting += [(chosen[:cut], first, left), (chosen[cut:], first + left, parts - left)]
    return patch


def _elements_by_patch(owners: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Each patch with each element that has a corner there, patch by patch, inner ones first: both [E]; where each
    patch begins, and how many are inner ones.

    Args:
        owners: The patches of the elements' nodes, [T, 4].
    """
    new = np.ones(owners.shape, bool)
    for k in range(1, 4):
        for earlier in range(k):
            new[:, k] &= owners[:, k] != owners[:, earlier]
    element, corner = np.nonzero(new)
    patch = owners[element, corner]
    shared = (new.sum(axis=1) > 1)[element]
    order = np.lexsort((element, shared, patch))
    interior = np.bincount(patch[~shared], minlength=count)
    return patch[order], element[order], _starts(np.bincount(patch, minlength=count)), interior


def _slot_bases(valence: np.ndarray, own_start: np.ndarray, lanes: int) -> tuple[np.ndarray, np.ndarray]:
    """``bases`` and ``base_start``.

    Args:
        valence: Elements of each node, in the order of ``own``, so falling within a patch.
    """
    each = WARP // lanes
    own = np.diff(own_start)
    warps = -(-own // each)
    base_start = _starts(warps + 1)
    bases = np.zeros(base_start[-1], np.int64)
    for patch in range(len(own)):
        busiest = valence[own_start[patch] : own_start[patch + 1] : each]
        rows = -(-busiest // lanes)
        bases[base_start[patch] + 1 : base_start[patch + 1]] = np.cumsum(rows) * WARP
    return bases, base_start


def _rank(nodes: np.ndarray, valence: np.ndarray) -> np.ndarray:
    """How many times the same node came before, for each of a list of all nodes' corners."""
    order = np.argsort(nodes, kind="stable")
    start = _starts(valence)
    rank = np.empty(len(nodes), np.int64)
    rank[order] = np.arange(len(nodes)) - start[nodes[order]]
    return rank


def _starts(counts: np.ndarray) -> np.ndarray:
    return np.concatenate([[0], np.cumsum(counts)])
