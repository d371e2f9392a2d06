"""Root cubes divided among ranks, and the lattice points that ranks share on faces between their cubes."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import numpy.typing as npt

from warp_corot.errors import InputError
from warp_corot.mesh.lattice import LATTICE_BITS
from warp_corot.mesh.uniform import halvings

Ints = npt.NDArray[np.int32]
Longs = npt.NDArray[np.int64]

#: Keys of lattice points are signed 64-bit numbers.
KEY_BITS = 63


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
        return [near[each] for each in self._of_ranks(low, high)]

    def across(self, corners: Ints) -> list[npt.NDArray[np.intp]]:
        """For each rank, the triangles [n, 3, 3] that are on its cubes; none for this rank."""
        flat = (corners == corners[:, :1]).all(axis=1) & (corners[:, 0] & ((1 << LATTICE_BITS) - 1) == 0)
        near = np.flatnonzero(flat.any(axis=1))
        inner = corners[near].min(axis=1) >> LATTICE_BITS
        return [near[each] for each in self._of_ranks(inner - flat[near], inner)]

    def _of_ranks(self, low: Ints, high: Ints) -> list[npt.NDArray[np.intp]]:
        """For each rank, the places of ranges of cubes, at most two along each axis, that have one of its cubes."""
        ranks = np.full((len(low), 8), -1)
        for k, choice in enumerate(itertools.product((False, True), repeat=3)):
            cube = np.where(choice, high, low)
            inside = ((cube >= 0) & (cube < self._cells)).all(axis=1)
            place = (cube[:, 0].astype(np.int64) * self._cells[1] + cube[:, 1]) * self._cells[2] + cube[:, 2]
            ranks[inside, k] = np.searchsorted(self.starts, place[inside], side="right") - 1
        found = [np.flatnonzero((ranks == rank).any(axis=1)) for rank in range(self.comm.size)]
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


def places_of(wanted: Longs, keys: Longs) -> Longs:
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
