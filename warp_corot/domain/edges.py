"""The edges of triangles, sorted once for all questions about who shares them."""

from __future__ import annotations

from functools import cached_property

import numpy as np

from warp_corot.mesh.sorting import sorted_keys


class Edges:
    """The edges of triangles, and the half-edges of each.

    Half-edge 3 t + k runs from corner k of triangle t to the next one.

    Args:
        triangles: Point numbers [T, 3].

    Attributes:
        order: Half-edges by edge, ascending within each edge [3 T].
        starts: The place in ``order`` where each edge begins [E]; edges ascend by their lower and then their higher
            point.
        sharers: Number of half-edges of each edge [E].
    """

    def __init__(self, triangles: np.ndarray):
        self.starting = np.ascontiguousarray(triangles).ravel().astype(np.int64)
        self.ending = np.ascontiguousarray(np.roll(triangles, -1, axis=1)).ravel().astype(np.int64)
        count = int(self.starting.max(initial=0)) + 1
        keys, self.order = sorted_keys(
            np.minimum(self.starting, self.ending) * count + np.maximum(self.starting, self.ending), count * count
        )
        self.starts = np.flatnonzero(np.diff(keys, prepend=-1))
        self.sharers = np.diff(self.starts, append=len(keys))

    @cached_property
    def ends(self) -> np.ndarray:
        """The lower and the higher point of each edge, int64 [E, 2]."""
        first = self.order[self.starts]
        ends = np.stack([self.starting[first], self.ending[first]], axis=1)
        ends.sort(axis=1)
        return ends

    @cached_property
    def pairs(self) -> tuple[np.ndarray, np.ndarray]:
        """Half-edges of the same edge: pairs, or chains of pairs for more than two [P], [P]."""
        follows = np.ones(len(self.order), bool)
        follows[self.starts] = False
        at = np.flatnonzero(follows)
        return self.order[at - 1], self.order[at]

    @cached_property
    def twos(self) -> tuple[np.ndarray, np.ndarray]:
        """The half-edges of edges that two share [P], [P]."""
        at = self.starts[self.sharers == 2]
        return self.order[at], self.order[at + 1]

    @cached_property
    def forward(self) -> np.ndarray:
        """Whether half-edges run from the lower to the higher point, bool [3 T]."""
        return self.starting < self.ending

    def net(self) -> tuple[np.ndarray, np.ndarray]:
        """Edges that are not walked as often one way as the other: the boundary of the surface.

        Returns:
            Edges [E, 2], walked the way of the triangles beside them, and how often more, [E].
        """
        if not len(self.starts):
            return np.empty((0, 2), np.int64), np.empty(0, np.int64)
        ways = np.where(self.forward[self.order], np.int8(1), np.int8(-1))
        net = np.add.reduceat(ways, self.starts, dtype=np.int64)
        found = np.flatnonzero(net)
        ends = self.ends[found]
        return np.where((net[found] < 0)[:, None], ends[:, ::-1], ends), np.abs(net[found])
