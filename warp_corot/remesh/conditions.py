"""The conditions of a body whose mesh changes: supports, loads, active stress, and their keyframes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.body.keyframes import Followed, NodeKeyframes
from warp_corot.discretization.changing.pools import DeviceForest
from warp_corot.kernels.plan.changing import begin_counts
from warp_corot.kernels.remesh import derived as kernels
from warp_corot.kernels.remesh.pools import MIXED_ROWS, NO_ROW
from warp_corot.remesh.carried_material import ACTIVATION, ACTIVATION_ROW, CarriedActivation

if TYPE_CHECKING:
    from warp_corot.body.soft_body import SoftBody


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


#: The arrays that ``put_back`` restores.
KEPT: dict[str, Any] = {
    "held": wp.uint8,
    "load": wp.vec4,
    "row": wp.int32,
    "v": wp.vec4,
    ACTIVATION: wp.float32,
    ACTIVATION_ROW: wp.int32,
}


class CarriedConditions:
    """Held nodes, loads, active stress and keyframes, passed between body and pools.

    Args:
        body: The body.
        forest: Its pools.

    Attributes:
        keyframes: The keyframes that nodes follow.
        activation: Active stress and the keyframes that it follows.
        kept: Held nodes, loads, rows, velocities and active stress as ``put_back`` writes them.
        found: The result of ``launch``, int32, for ``follow``.
    """

    def __init__(self, body: SoftBody, forest: DeviceForest):
        self._body = body
        self._forest = forest
        self.keyframes = Keyframes()
        self.activation = CarriedActivation(body, forest)
        self._revision = -1
        self._is_back = False
        self.kept: dict[str, wp.array] = {}
        #: The rows in ``kept``; None: not read yet.
        self._kept_rows: set[int] | None = None
        self.found = wp.zeros(kernels.FOLLOWER_PLACES, dtype=wp.int32, device=forest.device)
        #: Nodes that follow keyframes, and their rows, in any order.
        self._followers = [wp.empty(forest.node_capacity, dtype=wp.int32, device=forest.device) for _ in range(2)]

    @property
    def of_present_mesh(self) -> bool:
        """Whether ``kept`` belongs to the current mesh."""
        return self._body.sizes.version == self._revision

    def keep(self) -> None:
        """Let ``put_back`` restore the last conditions of this mesh from now on."""
        self._revision = self._body.sizes.version
        self.note()

    def set_kept(self, kept: dict[str, wp.array], *, of_present_mesh: bool) -> None:
        """Let ``put_back`` restore these conditions from now on, of the current mesh or of another."""
        self.kept, self._kept_rows = kept, None
        self._revision = self._body.sizes.version if of_present_mesh else -1

    def note(self) -> None:
        """Read the user's changes; call it before the mesh changes."""
        self._take_trajectories()
        self.activation.note(self.kept.get(ACTIVATION_ROW))
        if self.of_present_mesh:
            arrays, count = self._forest.carriage.arrays, self._body.node_count
            self.kept = {name: wp.clone(getattr(arrays, name)[:count]) for name in ("held", "load", "row", "v")}
            self.kept |= self.activation.kept()
            self._kept_rows = None

    def put_back(self) -> None:
        """Write the kept conditions into the mesh to which they belong."""
        arrays, count = self._forest.carriage.arrays, len(self.kept["held"])
        for name in ("held", "load", "row"):
            wp.copy(getattr(arrays, name), self.kept[name], count=count)
        velocities, held = arrays.v[:count].numpy().copy(), self.kept["held"].numpy() != 0
        velocities[held] = self.kept["v"].numpy()[held]
        arrays.v[:count].assign(velocities)
        arrays.reaction.zero_()
        self.activation.put_back(self.kept)
        self._is_back = True

    def launch(self, goes: wp.array) -> None:
        """Find the nodes that follow keyframes if ``goes`` [1] is not zero; may be recorded."""
        forest = self._forest
        device, threads = forest.device, forest.threads
        wp.launch(begin_counts, kernels.FOLLOWER_PLACES, inputs=[goes], outputs=[self.found], device=device)
        inputs = [threads, goes, forest.pools, forest.carriage.arrays]
        wp.launch(kernels.list_followers, threads, inputs, [*self._followers, self.found], device=device)

    def follow(self, found: npt.NDArray[np.int32]) -> None:
        """Tell the host which nodes and elements follow keyframes after a pass, new ones among them.

        Args:
            found: A copy of the attribute ``found``.
        """
        self.activation.follow()
        body = self._body
        # Nodes released later follow their former keyframes again on the restored mesh.
        if not (body.conditions.trajectories or self._is_back):
            return
        self._is_back = False
        if found[kernels.MIXED]:
            self._settle()
        nodes, rows = (array[: int(found[kernels.FOLLOWERS])].numpy() for array in self._followers)
        order = np.argsort(nodes)
        nodes, rows = nodes[order], rows[order]
        self._forget(rows)
        trajectories = self.keyframes.trajectories(nodes, rows, body.device)
        if trajectories is not body.conditions.trajectories:
            body.conditions.set_trajectories(trajectories)

    def _settle(self) -> None:
        """Give rows to new nodes between nodes that follow different ones."""
        arrays = self._forest.carriage.arrays
        rows = self._of_nodes(arrays.row)
        ends = self._forest.pools.ends[: len(rows)].numpy()
        rows = self.keyframes.settle(rows, ends, self._of_nodes(arrays.u)[:, :3])
        arrays.row[: len(rows)].assign(rows)
        everywhere = wp.ones(1, dtype=wp.int32, device=self._forest.device)
        self.launch(everywhere)

    def _take_trajectories(self) -> None:
        """Tell the device which keyframes nodes follow, if the user has changed them."""
        body = self._body
        if not self.keyframes.are(body.conditions.trajectories):
            rows = self.keyframes.adopt(body.conditions.trajectories, body.node_count)
            self._forest.carriage.arrays.row[: len(rows)].assign(rows)
            self._forget(rows)

    def _forget(self, rows: npt.NDArray[np.int32]) -> None:
        """Forget the keyframes that no node follows, now or in ``kept``."""
        if self._kept_rows is None:
            self._kept_rows = set(np.unique(self.kept["row"].numpy()).tolist()) if "row" in self.kept else set()
        self.keyframes.forget(but=self._kept_rows.union(np.unique(rows).tolist()))

    def _of_nodes(self, array: wp.array) -> npt.NDArray[Any]:
        return array[: self._body.node_count].numpy().copy()
