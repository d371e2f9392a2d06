"""Forests that follow a domain, grown in parts: no rank ever holds the whole mesh."""

from __future__ import annotations

import warnings
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.errors import InputError
from warp_corot.inputs.checks import checked_number, shown
from warp_corot.inputs.device import checked_device
from warp_corot.mesh import TetForest
from warp_corot.mesh.growing.adapt import TETS_OF_CUBE, Growing, grid_around
from warp_corot.mesh.growing.from_domain import checked_wishes, empty_error, filled_tree
from warp_corot.mesh.growing.judging import Field, Wishes
from warp_corot.mesh.growing.labelling import Growers, labels_of
from warp_corot.mesh.growing.resolved import Resolved
from warp_corot.mesh.lattice import checked_cell_size
from warp_corot.mesh.numbering import by_levels, in_order_of_leaves, live_or_void, pruned, renumbered, with_virtual
from warp_corot.mesh.tree import LIVE, VOID

from . import mpi
from .divided_mesh import DividedForest
from .faces import faces_of
from .ghost_layer import joined
from .parallel_closure import GrowingTogether
from .parallel_slivers import Elements, without_slivers
from .partition import checked_shares, nobody_empty
from .root_cube_partition import RootCubePartition, key_room

if TYPE_CHECKING:
    from warp_corot.domain import Domain

Longs = npt.NDArray[np.int64]

#: The cubes are divided by the elements of a forest that is coarser by this many levels, but has at least some, and
#: which every rank grows.
COARSER, LEAST_LEVEL = 9, 3
#: There an element that the surface cuts stands for this many; for this share if it may hold nothing of the body.
CUT, UNSURE = 64.0, 0.1


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
    ranks, better tens for each. Ranks exchange what conformity needs on the faces between their cubes, which nearly
    empty elements they give up, and the elements around the nodes that they move. No rank ever holds the whole mesh.
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
    return joined(forest, partition)


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
    counts = comm.allgather(int((tree.first_child == LIVE).sum()))
    _check_all_have_some(counts, domain, size)
    leaves = tree.leaves
    firsts = np.cumsum([0, *counts])
    volume = resolved.volume[stays[leaves]]
    faces = faces_of(tree.leaf_tets, grown.lattice, int(firsts[comm.rank]), partition)
    elements = Elements(
        tree.leaf_tets, partition.keys(grown.lattice), resolved.held[stays[leaves]], volume, faces, firsts
    )
    held, given_up, said = without_slivers(elements, sliver, domain, partition)
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
