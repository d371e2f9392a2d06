"""Keyframed nodes of a changing mesh: the keyframes of each, and those of new nodes between them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.body.keyframes import Followed, NodeKeyframes
from warp_corot.kernels.remesh.state import MIXED_ROWS, NO_ROW


@dataclass(frozen=True, eq=False)
class Row:
    """Keyframes of one node: times [s], [K], and displacements [m], [K, 3]."""

    times: npt.NDArray[np.float64]
    displacements: npt.NDArray[np.float64]

    def at(self, times: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """Displacements at other times, [n, 3]."""
        return np.stack([np.interp(times, self.times, self.displacements[:, axis]) for axis in range(3)], axis=1)


class Keyframes:
    """The rows of keyframes that nodes follow; ``Carried.row`` has each node's number.

    Attributes:
        rows: The rows by their numbers.
        between: The two rows whose mean a row is.
    """

    def __init__(self) -> None:
        self.rows: dict[int, Row] = {}
        self.between: dict[tuple[int, int], int] = {}
        self._trajectories: list[Followed] = []
        #: The nodes and rows from which these were made; None if they were not made here.
        self._made_of: tuple[npt.NDArray[np.int32], npt.NDArray[np.int32]] | None = None

    def are(self, trajectories: Sequence[Followed]) -> bool:
        """Whether these trajectories are those made or adopted last."""
        return len(trajectories) == len(self._trajectories) and all(
            a is b for a, b in zip(trajectories, self._trajectories, strict=True)
        )

    def adopt(self, trajectories: Sequence[Followed], node_count: int) -> npt.NDArray[np.int32]:
        """Adopt trajectories, and return the row that each node follows, int32 [N]."""
        found = np.full(node_count, int(NO_ROW), np.int32)
        for trajectory in trajectories:
            times, displacements = trajectory.keys()
            columns = displacements[:, None] if displacements.ndim == 2 else displacements
            numbers = [self._add(Row(times.copy(), column.copy())) for column in np.moveaxis(columns, 1, 0)]
            found[trajectory.host_numbers] = numbers
        self._trajectories, self._made_of = list(trajectories), None
        return found

    def settle(
        self, rows: npt.NDArray[np.int32], ends: npt.NDArray[np.int32], displacements: npt.NDArray[np.floating]
    ) -> npt.NDArray[np.int32]:
        """Give a row to each new node between nodes that follow different ones: the mean of the two.

        Args:
            rows: Current rows of the nodes, int32 [N].
            ends: The two ends of the edge whose midpoint each node is, int32 [N, 2].
            displacements: Current displacements of the nodes [m], [N, 3], where an end without keyframes stays.
        """
        settled = rows.copy()
        left = np.flatnonzero(settled == int(MIXED_ROWS))
        while len(left):
            known = (settled[ends[left]] != int(MIXED_ROWS)).all(axis=1)
            for node in left[known]:
                settled[node] = self._mean_row(ends[node], settled, displacements)
            left = left[~known]
        return settled

    def trajectories(
        self, nodes: npt.NDArray[np.int32], rows: npt.NDArray[np.int32], device: wp.Device
    ) -> list[Followed]:
        """The nodes' keyframes as trajectories; the last ones if they are still valid.

        Args:
            nodes: Nodes that follow a row, ascending, int32 [n].
            rows: The row of each, int32 [n].
            device: The device of the result.
        """
        of = nodes, rows
        if self._made_of is not None and all(map(np.array_equal, of, self._made_of)):
            return self._trajectories
        made = []
        of_times: dict[bytes, list[int]] = {}
        for row in np.unique(rows).tolist():
            of_times.setdefault(self.rows[row].times.tobytes(), []).append(row)
        for same_times in of_times.values():
            chosen = np.isin(rows, same_times)
            times = self.rows[same_times[0]].times
            if len(same_times) == 1:
                displacements = self.rows[same_times[0]].displacements
            else:
                displacements = np.stack([self.rows[row].displacements for row in rows[chosen].tolist()], axis=1)
            made.append(NodeKeyframes.checked(nodes[chosen], times, displacements).on(device))
        if not _alike(made, self._trajectories):
            self._trajectories = made
        self._made_of = of
        return self._trajectories

    def forget(self, but: set[int]) -> None:
        """Keep only the rows with these numbers."""
        wanted = but & self.rows.keys()
        if len(wanted) < len(self.rows):
            self.rows = {number: row for number, row in self.rows.items() if number in wanted}
            self.between = {ends: row for ends, row in self.between.items() if {*ends, row} <= wanted}

    def _mean_row(
        self, ends: npt.NDArray[np.int32], rows: npt.NDArray[np.int32], displacements: npt.NDArray[np.floating]
    ) -> int:
        a, b = sorted(int(row) for row in rows[ends])
        if a >= 0 and (a, b) in self.between:
            return self.between[a, b]
        followed = [self.rows[row] for row in (a, b) if row >= 0]
        times = np.unique(np.concatenate([row.times for row in followed]))
        stays = [np.tile(displacements[end], (len(times), 1)) for end in ends if rows[end] < 0]
        mean = np.mean([row.at(times) for row in followed] + stays, axis=0)
        number = self._add(Row(times, mean))
        if a >= 0:
            self.between[a, b] = number
        return number

    def _add(self, row: Row) -> int:
        number = max(self.rows, default=-1) + 1
        self.rows[number] = row
        return number


def _alike(ones: Sequence[Followed], others: Sequence[Followed]) -> bool:
    """Whether two lists of trajectories have the same nodes on the same keyframes, in the same order."""
    return len(ones) == len(others) and all(
        np.array_equal(a.host_numbers, b.host_numbers)
        and np.array_equal(a.times.numpy(), b.times.numpy())
        and np.array_equal(a.values.numpy(), b.values.numpy())
        for a, b in zip(ones, others, strict=True)
    )
