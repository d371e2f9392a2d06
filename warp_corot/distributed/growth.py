"""Forests that follow a domain, grown in parts: no rank ever holds the whole mesh.

Each rank grows the root cubes of its part. Ranks exchange what conformity needs on the faces between their cubes, and
the elements around the nodes that they move. Which nearly empty elements are given up, rank 0 finds from the corners of
all elements.
"""

from __future__ import annotations

import itertools
import warnings
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.discretization.groups import group_numbers
from warp_corot.errors import InputError
from warp_corot.inputs.checks import checked_device, checked_number, shown
from warp_corot.mesh import TetForest
from warp_corot.mesh.growing.fine_classification import Resolved
from warp_corot.mesh.growing.from_domain import checked_wishes, empty_error, filled_tree
from warp_corot.mesh.growing.growth import TETS_OF_CUBE, Growing, grid_around
from warp_corot.mesh.growing.labelling import Growers, labels_of
from warp_corot.mesh.growing.refinement_criteria import Field, Wishes
from warp_corot.mesh.growing.slivers import strays, without_slivers
from warp_corot.mesh.lattice import LATTICE_BITS, checked_cell_size
from warp_corot.mesh.tree import (
    LIVE,
    VOID,
    by_levels,
    in_order_of_leaves,
    live_or_void,
    pruned,
    renumbered,
    with_virtual,
)
from warp_corot.mesh.uniform import halvings

from . import mpi
from .divided_mesh import Arrays, Bools, DividedForest, Numbers, branches_of, joined_trees, pack_tree
from .partition import checked_shares, nobody_empty, numbered_points, places_of

if TYPE_CHECKING:
    from warp_corot.domain import Domain

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int32]
Longs = npt.NDArray[np.int64]

#: The cubes are divided by the elements of a forest that is coarser by this many levels, but has at least some, and
#: which every rank grows.
COARSER, LEAST_LEVEL = 9, 3
#: There an element that the surface cuts stands for this many; for this share if it may hold nothing of the body.
CUT, UNSURE = 64.0, 0.1
#: Keys of lattice points are signed 64-bit numbers.
KEY_BITS = 63


def from_domain(
    domain: Domain,
    cell_size: float,
    *,
    max_level: int | None = None,
    surface_error: float | None = None,
    min_level: int = 0,
    refine_where: Field | None = None,
    field: Field | None = None,
    field_tolerance: float = 0.0,
    sliver: float = 0.02,
    costs: npt.ArrayLike | None = None,
    device: str | wp.Device | None = None,
) -> DividedForest:
    """This rank's part of the mesh that ``TetForest.from_domain`` makes; all ranks must call this.

    Every rank has the domain and grows the root cubes of its part, a range of them; so there must be more cubes than
    ranks, better tens for each. No rank ever holds the whole mesh; rank 0 meanwhile has the corners and volumes of all
    elements, to find which nearly empty ones are given up.
    ``SoftBody`` and ``Simulation`` take the part like a whole mesh, as they take that of ``box``. For any number of
    ranks the mesh is the same, bit by bit, and that of ``TetForest.from_domain`` with these arguments. It has
    the labels of its elements, but no surface of its own: contact acts on the boundary of its tetrahedra.

    Args:
        domain, cell_size, max_level, surface_error, min_level, refine_where, field, field_tolerance, sliver: As for
            ``TetForest.from_domain``. A number of elements cannot be requested, because that takes the whole mesh.
        costs: The cost of an element on each rank, in any unit, [ranks]; None: the same everywhere.
        device: The device that grows the mesh; None: the domain's.

    Raises:
        InputError: On all ranks: MPI is not there, an argument is out of its range, no tetrahedron holds any of the
            body, or fewer cubes than ranks hold any of it.

    Warns:
        UserWarning: As ``TetForest.from_domain``, on rank 0.
    """
    from warp_corot.domain import Domain

    comm = mpi.world()
    if not isinstance(domain, Domain):
        raise InputError(f"domain is {shown(domain)}; it must be a Domain")
    where = checked_device(domain.device if device is None else device)
    size = checked_cell_size(cell_size)
    wishes = checked_wishes(max_level, surface_error, min_level, refine_where, field, field_tolerance)
    if not 0 <= checked_number(sliver, "sliver") < 1:
        raise InputError(f"sliver is {sliver}; it must be a share of an element's volume, from 0 to below 1")
    cells, _ = grid_around(domain.bounds, size)
    key_room(cells, wishes.max_level)
    starts = _starts(domain, size, wishes, where, checked_shares(comm.size, costs))
    partition = RootCubePartition(cells, wishes.max_level, starts, comm)
    growing = GrowingTogether(domain, size, wishes, where, partition)
    growing.run()
    resolved = Resolved(growing.grown(), size)
    del growing
    forest, said = _finished(resolved, domain, sliver, partition)
    if said and comm.rank == 0:
        warnings.warn(said, UserWarning, stacklevel=2)
    del resolved
    return _with_ghosts(forest, partition)


def _starts(
    domain: Domain, cell_size: float, wishes: Wishes, device: wp.Device, shares: npt.NDArray[np.float64]
) -> Longs:
    """The first root cube of each rank, and the number of cubes, int64 [ranks + 1].

    Raises:
        InputError: Fewer cubes than ranks have elements.
    """
    deepest = max(wishes.max_level - COARSER, min(wishes.max_level, LEAST_LEVEL))
    wishes, below = replace(wishes, max_level=deepest, min_level=min(wishes.min_level, deepest)), wishes
    growing = Growing(domain, cell_size, wishes, device)
    growing.run()
    coarse = growing.grown()
    tree = coarse.tree
    roots = tree.ancestors(tree.leaves, 0)
    level, inside = tree.leaf_levels, (coarse.phi[tree.leaf_tets] < 0).sum(axis=1)
    at_surface = CUT ** ((below.max_level - deepest) / COARSER)
    weight = np.where((level == deepest) & (inside < 4), at_surface * np.where(inside > 0, 1.0, UNSURE), 1.0)
    weight = np.maximum(weight, 2.0 ** np.clip(below.min_level - level, 0, None))
    of_cube = np.bincount(roots // TETS_OF_CUBE, weight, int(np.prod(coarse.cells)))
    ranks, used = len(shares), np.flatnonzero(of_cube)
    if len(used) < ranks:
        raise InputError(f"the body is in {len(used)} cubes for {ranks} ranks; take fewer ranks, or smaller cubes")
    middle = np.cumsum(of_cube[used]) - 0.5 * of_cube[used]
    first = np.searchsorted(middle, np.cumsum(shares)[:-1] * of_cube.sum())
    first = nobody_empty(np.append(0, first), len(used))[1:]
    return np.concatenate([[0], used[first], [len(of_cube)]]).astype(np.int64)


def _finished(resolved: Resolved, domain: Domain, sliver: float, partition: RootCubePartition) -> tuple[TetForest, str]:
    """This rank's leaves, without empty and nearly empty ones, and what else is left out; as of a whole mesh.

    Raises:
        InputError: On all ranks, if there are none.
    """
    comm, grown, size = partition.comm, resolved.grown, resolved.cell_size
    child = resolved.as_wished()
    tree, stays = filled_tree(resolved, child)
    _check_all_have_some(comm.allgather(int((tree.first_child == LIVE).sum())), domain, size)
    leaves = tree.leaves
    volume = resolved.volume[stays[leaves]]
    keys = partition.keys(grown.lattice)[tree.leaf_tets]
    held, given_up, said = _without_slivers(keys, resolved.held[stays[leaves]], volume, sliver, domain, comm)
    counts = comm.allgather(int((~given_up).sum()))
    _check_all_have_some(counts, domain, size)
    live = np.zeros(len(tree.level), bool)
    live[leaves[~given_up]] = True
    tree = live_or_void(tree, live)
    tree, _ = pruned(tree, tree.first_child == VOID)
    tree = by_levels(tree)
    order = with_virtual(in_order_of_leaves(tree), tree, grown.lattice)
    ends, tree = renumbered(order, grown.ends, tree)
    fill = (held / volume)[~given_up]
    lattice = grown.lattice[order]
    forest = TetForest(grown.cells, size, grown.origin, lattice, ends, tree, domain.up_axis, fill=fill)
    if domain.label_names:
        growers = Growers(sum(counts[: comm.rank]), comm.allgather)
        labels = labels_of(resolved, child, stays[leaves[~given_up]], forest, domain, growers)
        forest = replace(forest, labels=labels, label_names=tuple(domain.label_names))
    return forest, said


def _without_slivers(
    corners: Longs, held: Floats, volume: Floats, sliver: float, domain: Domain, comm: Any
) -> tuple[Floats, Bools, str]:
    """What ``from_domain`` gives up of a whole mesh, found by rank 0; all ranks must call this.

    Args:
        corners: The keys of the corners of this rank's elements, int64 [n, 4].
        held, volume: The volume of the body in each, and its own [n].
        sliver, domain: As for ``from_domain``.
        comm: The ranks.

    Returns:
        The new volumes of the body in this rank's elements; which of these are given up; and a sentence about pieces
        that are left out, empty if they hold next to nothing.
    """
    given = comm.gather((corners, held, volume), root=0)
    found = None
    if given is not None:
        ends = np.cumsum([len(of_rank) for of_rank, *_ in given])[:-1]
        corners, held, volume = (np.concatenate(each) for each in zip(*given, strict=True))
        tets = np.unique(corners, return_inverse=True)[1].reshape(-1, 4).astype(np.int32)
        held, given_up = without_slivers(tets, held, volume, sliver)
        stray, said = strays(tets, held, given_up, domain)
        parts = zip(np.split(held, ends), np.split(given_up | stray, ends), strict=True)
        found = [(*part, said) for part in parts]
    mine: tuple[Floats, Bools, str] = comm.scatter(found, root=0)
    return mine


def _check_all_have_some(counts: list[int], domain: Domain, cell_size: float) -> None:
    """Check that every rank has elements.

    Raises:
        InputError: On all ranks, if one has none.
    """
    if not sum(counts):
        raise empty_error(domain, cell_size)
    if not min(counts):
        raise InputError(
            f"rank {counts.index(0)} of {len(counts)} has cubes without elements; take fewer ranks, or smaller cubes"
        )


# --- closure --------------------------------------------------------------------------------------------------------


class GrowingTogether(Growing):
    """The part of a forest in this rank's root cubes.

    An element is bisected if the body asks for it, or if an edge has an active midpoint. Both depend only on the
    element and on the set of active midpoints, which only grows. So all orders of bisection end in the same forest,
    and ranks need to exchange nothing but active midpoints on the faces between their cubes.

    Args:
        domain, cell_size, wishes, device: As for ``Growing``; the number of elements must not be limited.
        partition: The cubes of each rank.
    """

    def __init__(
        self, domain: Domain, cell_size: float, wishes: Wishes, device: wp.Device, partition: RootCubePartition
    ):
        super().__init__(domain, cell_size, wishes, device, partition.own)
        self._partition = partition
        self._known = np.zeros(0, bool)
        self._pending = np.zeros((0, 2), np.int64)

    def run(self, first: int = 0) -> None:
        """Bisect elements until all ranks together have a conforming forest; all ranks must call this."""
        self.run_down(first)
        while self._partition.comm.allreduce(self._exchange()):
            count = self.growth.element_count
            self.growth.close(self.judge.wished, count)
        self.judge.evaluate()

    def _exchange(self) -> int:
        """Give other ranks the new active midpoints on their cubes, and take theirs; returns how many there were."""
        growth, partition = self.growth, self._partition
        lattice, ends = growth.nodes()
        known = np.zeros(growth.node_count, bool)
        known[: len(self._known)] = self._known
        # The corners of cubes are no midpoints.
        fresh = np.flatnonzero((growth.forest.active[: growth.node_count].numpy() != 0) & ~known & (ends[:, 0] >= 0))
        known[fresh] = True
        given = []
        for places in partition.shared(lattice[fresh]):
            both = ends[fresh[places]]
            given.append(np.stack([partition.keys(lattice[both[:, end]]) for end in (0, 1)], axis=1))
        taken = partition.comm.alltoall(given)
        pending = np.concatenate([self._pending, *taken])
        on_faces = np.unique(np.concatenate([np.zeros(0, np.intp), *partition.shared(lattice)]))
        place = places_of(pending.ravel(), partition.keys(lattice[on_faces])).reshape(-1, 2)
        here = (place >= 0).all(axis=1)
        middles = growth.bisect_edges(on_faces[place[here]])
        self._pending = pending[~here]
        # All ranks on whose cubes these are know them already.
        self._known = np.zeros(growth.node_count, bool)
        self._known[: len(known)] = known
        self._known[middles] = True
        return sum(len(each) for each in given) + len(middles)


# --- ghosts ---------------------------------------------------------------------------------------------------------


def _with_ghosts(own: TetForest, partition: RootCubePartition) -> DividedForest:
    """This rank's part of the mesh that all ranks' leaves make together; all ranks must call this.

    Args:
        own: The forest of this rank's root cubes, at least one leaf, with all levels in the order of the tree.
        partition: The cubes of each rank.
    """
    comm = partition.comm
    leaves, rows = (comm.allgather(len(each)) for each in (own.tets, own.tree.level))
    first, first_row = sum(leaves[: comm.rank]), sum(rows[: comm.rank])
    keys = partition.keys(own.lattice)
    owner = _owners(own, keys, partition)
    numbers, node_count = numbered_points(owner, keys, comm)
    groups = group_numbers(own, np.arange(len(own.tets)))

    def branch(kept: npt.NDArray[np.bool_]) -> Arrays:
        """Some leaves with the tree above them, as arrays by number in the whole mesh."""
        lattice, ends, tree, fill, points, stays = branches_of(own, kept, prunes=True)
        found = pack_tree(lattice, ends, tree, tree.leaves, first_row + stays.astype(np.int64), numbers[points])
        found |= {"owner": owner[points], "elements": first + np.flatnonzero(kept), "groups": first + groups[kept]}
        return found | {"fill": fill} | ({} if own.labels is None else {"labels": own.labels[kept]})

    given: list[Arrays | None] = [None] * comm.size
    # The first rank around a node moves it, so that copies go to ranks before this one.
    for rank in range(comm.rank):
        kept = np.isin(groups, groups[(owner == rank)[own.tets].any(axis=1)])
        given[rank] = branch(kept) if kept.any() else None
    taken = comm.alltoall(given)
    branches = [branch(np.ones(len(own.tets), bool)), *(each for each in taken if each is not None)]
    volumes = own.volumes
    told = comm.allgather((len(volumes), float(volumes.min()), own.points.min(axis=0), own.points.max(axis=0)))
    counts, smallest, low, high = zip(*told, strict=True)
    whole = {"element_count": sum(counts), "smallest_volume": min(smallest)}
    bounds = np.array([np.min(low, axis=0), np.max(high, axis=0)])
    return _together(own, branches, node_count=node_count, is_embedded=True, bounds=bounds, **whole)


def _owners(own: TetForest, keys: Longs, partition: RootCubePartition) -> Ints:
    """The rank that moves each lattice point, the first with a leaf around it; if no leaf has it, the first rank that
    has it, plus the number of ranks; int32."""
    comm = partition.comm
    claim = np.full(len(keys), comm.rank + comm.size, np.int32)
    claim[: own.node_count] = comm.rank
    owner = claim.copy()
    places = partition.shared(own.lattice)
    taken = comm.alltoall([(keys[each], claim[each]) for each in places])
    for mine, (their_keys, claims) in zip(places, taken, strict=True):
        found = places_of(keys[mine], their_keys)
        both = found >= 0
        owner[mine[both]] = np.minimum(owner[mine[both]], claims[found[both]])
    return owner


def _together(own: TetForest, branches: list[Arrays], *, node_count: int, **whole: Any) -> DividedForest:
    """The part that branches of different ranks make, in the order of the ranks, the rank's own first."""
    points, rows = (np.unique(np.concatenate([each[name] for each in branches])) for name in ("points", "rows"))
    lattice, ends, tree = joined_trees(branches)
    owner = np.zeros(len(points), np.int32)
    for each in branches:
        owner[np.searchsorted(points, each["points"])] = each["owner"]
    order = with_virtual(in_order_of_leaves(tree), tree, lattice)
    ends, tree = renumbered(order, ends, tree)
    joined: Arrays = {
        name: np.concatenate([each[name] for each in branches])
        for name in ("elements", "groups", "fill", "labels")
        if name in branches[0]
    }
    nodes, elements = order[: int(tree.leaf_tets.max()) + 1], joined["elements"]
    counted = np.arange(len(elements)) < len(own.tets)
    numbers = Numbers(points[nodes], elements, owner[nodes], counted, node_count, rows, points[order])
    return DividedForest(
        own.cells,
        own.cell_size,
        own.origin,
        lattice[order],
        ends,
        tree,
        own.up_axis,
        fill=joined["fill"],
        labels=joined.get("labels"),
        label_names=own.label_names,
        leaf_groups=np.unique(joined["groups"], return_inverse=True)[1].ravel().astype(np.int32),
        of_whole=whole | {"numbers": numbers},
    )


# --- root cubes -----------------------------------------------------------------------------------------------------


class RootCubePartition:
    """The root cubes of each rank, a range in their order, z fastest.

    Attributes:
        starts: The first cube of each rank, and the number of cubes, int64 [ranks + 1].
        comm: The ranks.

    Args:
        cells: Number of cubes along x, y, z.
        level: The deepest level of elements.
        starts, comm: As above.

    Raises:
        InputError: There are too many cubes for this level.
    """

    def __init__(self, cells: tuple[int, int, int], level: int, starts: Longs, comm: Any):
        self.starts, self.comm = starts, comm
        self._cells = np.array(cells)
        self._spare, self._sides = key_room(cells, level)

    @property
    def own(self) -> tuple[int, int]:
        """This rank's cubes: the first one, and the one after the last."""
        first, end = self.starts[self.comm.rank : self.comm.rank + 2].tolist()
        return first, end

    def keys(self, lattice: Ints) -> Longs:
        """A number for each lattice point [n, 3], int64 [n]."""
        x, y, z = (lattice.astype(np.int64) >> self._spare).T
        found: Longs = (x * self._sides[1] + y) * self._sides[2] + z
        return found

    def shared(self, lattice: Ints) -> list[npt.NDArray[np.intp]]:
        """For each rank, the lattice points [n, 3] that are on its cubes; none for this rank."""
        near = np.flatnonzero((lattice & ((1 << LATTICE_BITS) - 1) == 0).any(axis=1))
        low, high = (lattice[near] - 1) >> LATTICE_BITS, lattice[near] >> LATTICE_BITS
        ranks = np.full((len(low), 8), -1)
        for k, choice in enumerate(itertools.product((False, True), repeat=3)):
            cube = np.where(choice, high, low)
            inside = ((cube >= 0) & (cube < self._cells)).all(axis=1)
            place = (cube[:, 0].astype(np.int64) * self._cells[1] + cube[:, 1]) * self._cells[2] + cube[:, 2]
            ranks[inside, k] = np.searchsorted(self.starts, place[inside], side="right") - 1
        found = [near[(ranks == rank).any(axis=1)] for rank in range(self.comm.size)]
        found[self.comm.rank] = np.zeros(0, np.intp)
        return found


def key_room(cells: tuple[int, int, int], level: int) -> tuple[int, Longs]:
    """The bits of lattice coordinates that keys leave out, and the number of points along x, y, z that they tell apart.

    Raises:
        InputError: There are too many cubes for this level.
    """
    # The body is evaluated at midpoints of the smallest elements, too.
    spare = max(LATTICE_BITS - halvings(level) - 1, 0)
    sides = (np.array(cells, np.int64) << (LATTICE_BITS - spare)) + 1
    if sum(int(side).bit_length() for side in sides) > KEY_BITS:
        raise InputError(f"max_level is {level}; with {' x '.join(map(str, cells))} cubes it must be less in parts")
    return spare, sides
