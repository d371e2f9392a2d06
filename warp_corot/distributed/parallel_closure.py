"""A forest that ranks grow together: each bisects its own root cubes, and they exchange what conformity needs."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.mesh.growing.adapt import Growing
from warp_corot.mesh.growing.judging import Wishes

from .root_cube_partition import RootCubePartition, places_of

if TYPE_CHECKING:
    from warp_corot.domain import Domain

Longs = npt.NDArray[np.int64]


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
        fresh = np.flatnonzero((growth.active[: growth.node_count].numpy() != 0) & ~known & (ends[:, 0] >= 0))
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
