"""The division of a mesh among ranks: which elements each rank computes, which nodes it moves, which elements of other
ranks it needs, and the numbers of nodes of parts in the whole mesh."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from warp_corot.discretization.elements import Mesh
from warp_corot.discretization.groups import group_numbers, neighbour_groups
from warp_corot.errors import InputError
from warp_corot.inputs.checks import checked_numbers, shown
from warp_corot.mesh import TetForest, TetMesh
from warp_corot.mesh.topology import linked
from warp_corot.mesh.tree import UniformTree

Ints = npt.NDArray[np.int32]
Longs = npt.NDArray[np.int64]

#: Bits of each coordinate on the curve along which general elements are divided.
CURVE_BITS = 20


@dataclass(frozen=True, eq=False)
class Partition:
    """The division of a mesh.

    Attributes:
        groups: The group of each element, int32 [T]; elements of a group are computed together.
        sharing: The group in which the element may share its dilatation, int32 [T]; a group consists of one or several
            of these.
        rank_of_element: The rank that counts the element's energy, int32 [T].
        rank_of_node: The rank that moves the node, int32 [N]; -1 for nodes of no element.
    """

    groups: Ints
    sharing: Ints
    rank_of_element: Ints
    rank_of_node: Ints

    @classmethod
    def of(
        cls,
        mesh: Mesh,
        ranks: int,
        costs: npt.ArrayLike | None = None,
        *,
        grouped: bool = False,
        rotation_level: int | None = None,
    ) -> Partition:
        """Divide a mesh.

        Leaves of a forest are divided along the tree's order, which is a space-filling curve, in whole groups; general
        meshes by METIS if ``pymetis`` is installed, else along a curve. The lowest rank around a node moves it.

        Args:
            mesh: The whole mesh.
            ranks: Number of ranks.
            costs: The cost of an element on each rank, in any unit, [ranks]; None: the same everywhere.
            grouped: Whether elements of a general mesh share their dilatation in groups; for leaves it is always
                possible.
            rotation_level: The level of a forest's tree at which rotations are shared: the leaves below an element of
                this level are in one group.

        Raises:
            InputError: Fewer groups than ranks, or costs that are not positive.
        """
        shares = checked_shares(ranks, costs)
        groups = sharing = sharing_groups(mesh, grouped)
        if rotation_level is not None and isinstance(mesh, TetForest):
            groups = _merged(groups, mesh.ancestors(rotation_level))
        order, sizes = _ordered(groups)
        if len(sizes) < ranks:
            raise InputError(f"the body has {len(sizes)} groups of elements for {ranks} ranks; take fewer ranks")
        if isinstance(mesh, TetMesh):
            rank = _dealt_general(mesh, ranks, shares)
            # A group belongs to the rank of its first element.
            _, first, place = np.unique(groups, return_index=True, return_inverse=True)
            rank = rank[first][place]
        else:
            ends = np.cumsum(sizes) - 0.5 * sizes
            rank_of_group = np.searchsorted(np.cumsum(shares)[:-1] * len(groups), ends, side="right")
            rank_of_group = _without_gaps(rank_of_group, ranks)
            rank = np.empty(len(groups), np.int32)
            rank[order] = np.repeat(rank_of_group, sizes)
        owner = np.full(len(mesh.points), ranks, np.int32)
        np.minimum.at(owner, mesh.tets.ravel(), np.repeat(rank, 4))
        owner[owner == ranks] = -1
        return cls(groups, sharing, rank.astype(np.int32), owner)

    def needed(self, mesh: Mesh, rank: int) -> npt.NDArray[np.bool_]:
        """The elements that a rank computes, its own and copies of other ranks', bool [T]: the groups of all elements
        around its nodes."""
        around = (self.rank_of_node == rank)[mesh.tets].any(axis=1)
        in_groups = np.zeros(int(self.groups.max()) + 1, bool)
        in_groups[self.groups[around]] = True
        return in_groups[self.groups] | (self.rank_of_element == rank)


def checked_shares(ranks: int, costs: npt.ArrayLike | None) -> npt.NDArray[np.float64]:
    """The share of the elements that each rank gets, [ranks].

    Raises:
        InputError: Costs that are not positive numbers, one for each rank.
    """
    given = np.ones(ranks) if costs is None else checked_numbers(costs, "costs", "one for each rank")
    if given.shape != (ranks,) or not (np.isfinite(given) & (given > 0.0)).all():
        raise InputError(f"costs is {shown(costs)}; it must be {ranks} positive numbers, one for each rank")
    return (1.0 / given) / np.sum(1.0 / given)


def sharing_groups(mesh: Mesh, grouped: bool) -> Ints:
    """The group in which each element may share its dilatation, int32 [T]; see ``Partition``."""
    count = len(mesh.tets)
    if not isinstance(mesh, TetForest):
        return neighbour_groups(mesh.points, mesh.tets) if grouped else np.arange(count, dtype=np.int32)
    if isinstance(mesh.tree, UniformTree) and mesh.tree.depth >= 3:
        return (np.arange(count, dtype=np.int32) >> 3).astype(np.int32)
    return group_numbers(mesh, np.arange(count))


def _merged(groups: Ints, others: npt.NDArray[np.integer]) -> Ints:
    """The smallest groups that divide none of these groups and none of the others, int32 [T]."""
    ends = [np.unique(each, return_inverse=True)[1].ravel() for each in (groups, others)]
    first, count = int(ends[0].max()) + 1, sum(int(each.max()) + 1 for each in ends)
    return linked(np.stack([ends[0], first + ends[1]], axis=1), count)[ends[0]].astype(np.int32)


def _ordered(groups: Ints) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]]:
    """The elements, group after group in the order of the groups' first elements; and the size of each group."""
    _, first, inverse, sizes = np.unique(groups, return_index=True, return_inverse=True, return_counts=True)
    turn = np.argsort(first, kind="stable")
    place = np.empty_like(turn)
    place[turn] = np.arange(len(turn))
    return np.argsort(place[inverse], kind="stable"), sizes[turn]


def nobody_empty(starts: npt.NDArray[np.integer], count: int) -> npt.NDArray[np.int64]:
    """The same ascending first items of each rank, changed so that each of the ranks has at least one of ``count``."""
    turn = np.arange(len(starts))
    found: npt.NDArray[np.int64] = np.minimum(
        np.maximum.accumulate(np.maximum(starts - turn, 0)) + turn, count - len(starts) + turn
    )
    found[0] = 0
    return found


def _without_gaps(rank_of_item: npt.NDArray[np.intp], ranks: int) -> npt.NDArray[np.intp]:
    """The same ascending ranks, changed so that each has at least one item."""
    count = len(rank_of_item)
    starts = nobody_empty(np.searchsorted(rank_of_item, np.arange(ranks)), count)
    return np.searchsorted(starts, np.arange(count), side="right") - 1


def _dealt_general(mesh: TetMesh, ranks: int, shares: npt.NDArray[np.float64]) -> Ints:
    """The rank of each element of a general mesh."""
    if ranks == 1:
        return np.zeros(len(mesh.tets), np.int32)
    try:
        import pymetis
    except ImportError:
        return _along_curve(mesh, ranks, shares)
    from warp_corot.mesh.topology import face_pairs

    pairs = face_pairs(mesh.tets)
    both = np.concatenate([pairs, pairs[:, ::-1]])
    both = both[np.argsort(both[:, 0], kind="stable")]
    starts = np.searchsorted(both[:, 0], np.arange(len(mesh.tets) + 1))
    _, rank = pymetis.part_graph(ranks, xadj=starts, adjncy=both[:, 1], tpwgts=list(shares))
    found = np.asarray(rank, np.int32)
    complete = len(np.unique(found)) == ranks
    return found if complete else _along_curve(mesh, ranks, shares)


def _along_curve(mesh: TetMesh, ranks: int, shares: npt.NDArray[np.float64]) -> Ints:
    """The ranks of elements along the curve that interleaves the bits of their centroids' coordinates."""
    centre = mesh.points[mesh.tets].mean(axis=1)
    extent = max(float(np.ptp(centre, axis=0).max()), 1e-300)
    place = np.minimum(((centre - centre.min(axis=0)) / extent * 2**CURVE_BITS).astype(np.int64), 2**CURVE_BITS - 1)
    key = np.zeros(len(centre), np.int64)
    for bit in range(CURVE_BITS):
        for axis in range(3):
            key |= (place[:, axis] >> bit & 1) << (3 * bit + axis)
    order = np.argsort(key, kind="stable")
    turn = np.searchsorted(np.cumsum(shares)[:-1] * len(order), np.arange(len(order)) + 0.5, side="right")
    rank = np.empty(len(order), np.int32)
    rank[order] = _without_gaps(turn, ranks)
    return rank


def places_of(wanted: npt.NDArray[np.integer], keys: npt.NDArray[np.integer]) -> Longs:
    """The places of numbers in others, all different, int64 [n]; -1 for those that are not there."""
    if not len(keys):
        return np.full(len(wanted), -1, np.int64)
    order = np.argsort(keys)
    place = order[np.searchsorted(keys, wanted, sorter=order).clip(max=len(keys) - 1)]
    return np.where(keys[place] == wanted, place, -1)


def numbered_points(owner: Ints, keys: Longs, comm: Any) -> tuple[Longs, int]:
    """The numbers of lattice points in the whole mesh, int64, and the number of its nodes; all ranks must call this.

    Nodes are in the order in which the leaves of the whole mesh first name them, so that those of a rank have
    consecutive numbers; lattice points that no leaf names follow, rank after rank.

    Args:
        owner: The rank that moves each point, plus the number of ranks if no leaf names the point, int32 [n].
        keys: The points' keys, the same on all ranks, int64 [n].
        comm: The ranks.
    """
    found = np.full(len(owner), -1, np.int64)
    before = 0
    for claim in (comm.rank, comm.rank + comm.size):
        mine = np.flatnonzero(owner == claim)
        counts = comm.allgather(len(mine))
        found[mine] = before + sum(counts[: comm.rank]) + np.arange(len(mine))
        if claim == comm.rank:
            before = total = sum(counts)
    ghosts = [np.flatnonzero((owner % comm.size == rank) & (found < 0)) for rank in range(comm.size)]
    asked = comm.alltoall([keys[each] for each in ghosts])
    told = comm.alltoall([found[places_of(each, keys)] for each in asked])
    for places, numbers in zip(ghosts, told, strict=True):
        found[places] = numbers
    return found, total
