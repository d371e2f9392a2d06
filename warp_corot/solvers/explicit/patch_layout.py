"""Patches of a mesh: compact sets of nodes, each with all elements that touch it, for thread blocks that stay resident.

Plain NumPy. A patch owns its nodes and computes every element with a corner there, so that it needs no forces from
other patches; each patch computes the elements between patches for itself. In every step a patch needs only the
positions of its halo, the other corners of its elements.

Where elements share their dilatation in groups, a patch measures all elements of each group of which it computes one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

WARP = 32

#: The slot number of corners that another patch owns.
NO_SLOT = 0xFFFF

#: The most threads that add up one node: a node has two dozen elements.
MOST_LANES = 8


@dataclass(frozen=True, eq=False)
class Patches:
    """The nodes and elements of each patch; ``*_start`` arrays say where each patch's part begins, int32 [patches + 1].

    Within a patch, nodes are numbered from 0: first its own, those with the most elements first, then its halo.
    ``lanes`` neighbouring threads add up each own node. The slots that the 32 threads of a warp read at once lie side
    by side: slot ``base + 32 row + thread``. A warp has as many rows as its busiest thread needs; unused places stay
    zero.

    Attributes:
        lanes: Threads that add up one node: 1, 2, 4, 8, 16 or 32.
        own, own_start: Nodes that patches own, int32 [N].
        halo, halo_start: Nodes of other patches that patches read, int32 [H].
        elements, element_start: Elements of patches: those without halo, then the others that they compute, then those
            that they only measure; int32 [E].
        interior: Number of elements of each patch without a corner in the halo, int32 [patches].
        computed: Number of elements that each patch computes, int32 [patches].
        corners: The four nodes of each element, numbered in the patch, int32 [E, 4].
        slots: The slot of each corner's force; ``NO_SLOT`` at corners of the halo; int32 [E, 4].
        bases, base_start: Where each warp's slots begin, and after a patch's last warp the number of its slots, int32.
        groups: The group of each element, numbered in the patch, int32 [E]; zero where there are no groups.
        ranks: Its place in that group, int32 [E].
        group_counts: Number of groups of each patch, int32 [patches].
    """

    lanes: int
    own: np.ndarray
    own_start: np.ndarray
    halo: np.ndarray
    halo_start: np.ndarray
    elements: np.ndarray
    element_start: np.ndarray
    interior: np.ndarray
    computed: np.ndarray
    corners: np.ndarray
    slots: np.ndarray
    bases: np.ndarray
    base_start: np.ndarray
    groups: np.ndarray
    ranks: np.ndarray
    group_counts: np.ndarray

    @classmethod
    def of(
        cls, points: np.ndarray, tets: np.ndarray, count: int, threads: int, groups: np.ndarray | None = None
    ) -> Patches:
        """Patches with about equal numbers of corners.

        Args:
            points: Rest positions, float64 [N, 3].
            tets: int32 [T, 4].
            count: Number of patches, at most the number of nodes.
            threads: Threads of a block; they determine how many add up one node.
            groups: The group of each element, int [T]; None: there are none.
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

        patch, element, element_start, interior, computed = _elements_by_patch(owner[tets], count, groups)
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
            computed,
            corners,
            slots,
            bases,
            base_start,
            *_groups_by_patch(patch, element, groups, count),
        )
        return cls(lanes, *(array.astype(np.int32) for array in arrays))

    @property
    def count(self) -> int:
        return len(self.own_start) - 1

    @property
    def most_own(self) -> int:
        """The most own nodes of a patch."""
        return int(np.diff(self.own_start).max())

    @property
    def most_halo(self) -> int:
        """The most nodes of a halo."""
        return int(np.diff(self.halo_start).max())

    @property
    def most_nodes(self) -> int:
        """The most nodes of a patch, its own and its halo's."""
        return int((np.diff(self.own_start) + np.diff(self.halo_start)).max())

    @property
    def most_slots(self) -> int:
        """The most slots of a patch."""
        return int(self.bases[self.base_start[1:] - 1].max())

    @property
    def most_groups(self) -> int:
        """The most groups of a patch."""
        return int(self.group_counts.max())

    @property
    def most_members(self) -> int:
        """The most elements of a group; zero where there are no groups."""
        return int(self.ranks.max()) + 1 if self.most_groups else 0

    @property
    def most_computed(self) -> int:
        """The most elements that a patch computes."""
        return int(self.computed.max())

    @property
    def most_elements(self) -> int:
        """The most elements of a patch."""
        return int(np.diff(self.element_start).max())


def patch_of_nodes(points: np.ndarray, weight: np.ndarray, count: int) -> np.ndarray:
    """Split points across the longest extent, and the parts again, into patches of about equal weight: int64 [N]."""
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


def _elements_by_patch(
    owners: np.ndarray, count: int, groups: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Pairs of a patch and an element, patch by patch, in the order of ``Patches.elements``: both [E]; where each patch
    begins, how many inner elements it has, and how many it computes.

    Args:
        owners: The patches of the elements' nodes, [T, 4].
        count: Number of patches.
        groups: As for ``Patches.of``.
    """
    new = np.ones(owners.shape, bool)
    for k in range(1, 4):
        for earlier in range(k):
            new[:, k] &= owners[:, k] != owners[:, earlier]
    element, corner = np.nonzero(new)
    patch = owners[element, corner]
    kind = (new.sum(axis=1) > 1)[element].astype(np.int64)
    if groups is not None:
        others = _other_members(patch, element, groups)
        patch, element = (np.concatenate(pair) for pair in zip((patch, element), others, strict=True))
        kind = np.concatenate([kind, np.full(len(others[0]), 2)])
    order = np.lexsort((element, kind, patch))
    interior, computed = (np.bincount(patch[kind <= most], minlength=count) for most in (0, 1))
    return patch[order], element[order], _starts(np.bincount(patch, minlength=count)), interior, computed


def _other_members(patch: np.ndarray, element: np.ndarray, groups: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The elements in the groups of each patch's elements that are not among these, and their patches."""
    order = np.argsort(groups, kind="stable")
    sizes = np.bincount(groups)
    first = _starts(sizes)
    pairs = np.unique(patch * len(sizes) + groups[element])
    of_patch, group = np.divmod(pairs, len(sizes))
    size = sizes[group]
    at = np.repeat(first[group] - _starts(size)[:-1], size) + np.arange(size.sum())
    member, its_patch = order[at], np.repeat(of_patch, size)
    is_new = ~np.isin(its_patch * len(groups) + member, patch * len(groups) + element)
    return its_patch[is_new], member[is_new]


def _groups_by_patch(
    patch: np.ndarray, element: np.ndarray, groups: np.ndarray | None, count: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """``groups``, ``ranks`` and ``group_counts`` of pairs of a patch and an element; ranks in the elements' order."""
    if groups is None:
        return np.zeros(len(element)), np.zeros(len(element)), np.zeros(count)
    pairs, of_pair = np.unique(patch * (groups.max() + 1) + groups[element], return_inverse=True)
    counts = np.bincount(pairs // (groups.max() + 1), minlength=count)
    order = np.lexsort((element, of_pair))
    ranks = np.empty(len(element), np.int64)
    ranks[order] = np.arange(len(element)) - _starts(np.bincount(of_pair))[of_pair[order]]
    return of_pair - _starts(counts)[patch], ranks, counts


def _slot_bases(valence: np.ndarray, own_start: np.ndarray, lanes: int) -> tuple[np.ndarray, np.ndarray]:
    """``bases`` and ``base_start``.

    Args:
        valence: Elements of each node, in the order of ``own``; they decrease within a patch.
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
    """For each entry of a list of nodes, how often the same node came before."""
    order = np.argsort(nodes, kind="stable")
    start = _starts(valence)
    rank = np.empty(len(nodes), np.int64)
    rank[order] = np.arange(len(nodes)) - start[nodes[order]]
    return rank


def _starts(counts: np.ndarray) -> np.ndarray:
    return np.concatenate([[0], np.cumsum(counts)])
