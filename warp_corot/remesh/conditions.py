"""The conditions of a body whose mesh changes: supports, loads, active stress, and their keyframes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.body.keyframes import Followed
from warp_corot.discretization.changing.pools import DeviceForest
from warp_corot.kernels.plan.changing import begin_counts
from warp_corot.kernels.remesh import derived as kernels
from warp_corot.kernels.remesh.pools import MIXED_ROWS, NO_ROW
from warp_corot.remesh.carried_material import ACTIVATION, ACTIVATION_ROW

if TYPE_CHECKING:
    from warp_corot.body.soft_body import SoftBody


@dataclass(frozen=True, eq=False)
class Keys:
    """Keyframes of rows ``first`` and following: times [s], [K], and displacements [m], [K, rows, 3], or active stress
    [Pa], [K, rows]."""

    first: int
    times: npt.NDArray[np.float64]
    values: npt.NDArray[np.floating]

    @property
    def end(self) -> int:
        return self.first + self.values.shape[1]

    def follow(self, rows: npt.NDArray[np.int32]) -> npt.NDArray[np.bool_]:
        """Which nodes or elements have a row in these keyframes."""
        return (rows >= self.first) & (rows < self.end)

    def at(self, row: int, times: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """Displacements of a row at other times [m], [n, 3]."""
        own = self.values[:, row - self.first]
        return np.stack([np.interp(times, self.times, own[:, axis]) for axis in range(3)], axis=1)


class Keyframes:
    """The rows of keyframes that nodes or elements follow, each of which carries the number of its row.

    Attributes:
        keys: The rows, ascending.
        between: The two rows whose mean a row is.
        made: The keyframes that were made or adopted last.
    """

    def __init__(self) -> None:
        self.keys: list[Keys] = []
        self.between: dict[tuple[int, int], int] = {}
        self.made: list[Followed] = []
        #: The numbers and rows from which these were made; None if they were not made here.
        self._made_of: tuple[npt.NDArray[np.integer], npt.NDArray[np.int32]] | None = None

    def are(self, followed: Sequence[Followed]) -> bool:
        """Whether these keyframes are those made or adopted last."""
        return len(followed) == len(self.made) and all(a is b for a, b in zip(followed, self.made, strict=True))

    def adopt(self, followed: Sequence[Followed], count: int) -> npt.NDArray[np.int32]:
        """Adopt keyframes, and return the row that each of ``count`` nodes or elements follows, int32."""
        found = np.full(count, int(NO_ROW), np.int32)
        for each in followed:
            keys, numbers = self._add(each.times.numpy().copy(), each.values.numpy().copy()), each.host_numbers
            found[numbers] = keys.first + (np.arange(len(numbers)) if keys.end - keys.first > 1 else 0)
        self.made, self._made_of = list(followed), None
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

    def make(
        self, numbers: npt.NDArray[np.integer], rows: npt.NDArray[np.int32], dtype: type, device: wp.Device
    ) -> list[Followed]:
        """The keyframes of nodes or elements; the last ones if they are still valid.

        Args:
            numbers: Those that follow a row, ascending [n].
            rows: The row of each, int32 [n].
            dtype: Of the values.
            device: The device of the result.
        """
        of = numbers, rows
        if self._made_of is not None and all(map(np.array_equal, of, self._made_of)):
            return self.made
        alike: dict[bytes, list[Keys]] = {}
        for keys in self.keys:
            if keys.follow(rows).any():
                alike.setdefault(keys.times.tobytes(), []).append(keys)
        made = []
        for same_times in alike.values():
            there = np.concatenate([np.arange(keys.first, keys.end) for keys in same_times])
            values = np.concatenate([keys.values for keys in same_times], axis=1)
            chosen = np.isin(rows, there)
            column = np.searchsorted(there, rows[chosen])
            column = column[:1] if (column == column[0]).all() else column
            made.append(Followed.made(numbers[chosen], same_times[0].times, values[:, column], dtype, device))
        if not _alike(made, self.made):
            self.made = made
        self._made_of = of
        return self.made

    def forget(self, but: npt.NDArray[np.int32]) -> None:
        """Forget keyframes with none of these rows."""
        self.keys = [keys for keys in self.keys if keys.follow(but).any()]
        self.between = {ends: row for ends, row in self.between.items() if all(map(self._of, (*ends, row)))}

    def _of(self, row: int) -> Keys | None:
        return next((keys for keys in self.keys if keys.first <= row < keys.end), None)

    def _mean_row(
        self, ends: npt.NDArray[np.int32], rows: npt.NDArray[np.int32], displacements: npt.NDArray[np.floating]
    ) -> int:
        a, b = sorted(int(row) for row in rows[ends])
        if a >= 0 and (a, b) in self.between:
            return self.between[a, b]
        followed = [(row, keys) for row in (a, b) if (keys := self._of(row))]
        times = np.unique(np.concatenate([keys.times for _, keys in followed]))
        stays = [np.tile(displacements[end], (len(times), 1)) for end in ends if rows[end] < 0]
        mean = np.mean([keys.at(row, times) for row, keys in followed] + stays, axis=0)
        number = self._add(times, mean[:, None]).first
        if a >= 0:
            self.between[a, b] = number
        return number

    def _add(self, times: npt.NDArray[np.float64], values: npt.NDArray[np.floating]) -> Keys:
        keys = Keys(self.keys[-1].end if self.keys else 0, times, values)
        self.keys.append(keys)
        return keys


def _alike(ones: Sequence[Followed], others: Sequence[Followed]) -> bool:
    """Whether two lists of keyframes have the same followers and values, in the same order."""
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
        of_activation: Those that active stresses of elements follow, or followed on the mesh that ``put_back``
            restores; bodies without active stress are left alone.
        kept: Held nodes, loads, rows, velocities and active stress as ``put_back`` writes them.
        found: The result of ``launch``, int32, for ``follow``.
    """

    def __init__(self, body: SoftBody, forest: DeviceForest):
        self._body = body
        self._forest = forest
        self.keyframes, self.of_activation = Keyframes(), Keyframes()
        self._revision = -1
        self._is_back = False
        self.kept: dict[str, wp.array] = {}
        #: The rows in ``kept``; None: not read yet.
        self._kept_rows: npt.NDArray[np.int32] | None = None
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
        self._take_activation()
        if self.of_present_mesh:
            arrays, count = self._forest.carriage.arrays, self._body.node_count
            self.kept = {name: wp.clone(getattr(arrays, name)[:count]) for name in ("held", "load", "row", "v")}
            if self._body.discretization.has_activation:
                self.kept |= {name: self._of_leaves(name).contiguous() for name in (ACTIVATION, ACTIVATION_ROW)}
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
        for name in (ACTIVATION, ACTIVATION_ROW):
            if name in self.kept:
                wp.copy(self._of_leaves(name, len(self.kept[name])), self.kept[name])
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
        self.follow_activation()
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
        trajectories = self.keyframes.make(nodes, rows, wp.vec3, body.device)
        if trajectories is not body.conditions.trajectories:
            body.conditions.set_trajectories(trajectories)

    def follow_activation(self) -> None:
        """Make the body's elements follow the keyframes of the rows that they carry."""
        if self.of_activation.keys:
            rows = self._of_leaves(ACTIVATION_ROW).contiguous().numpy()
            elements = np.flatnonzero(rows >= 0)
            made = self.of_activation.make(elements, rows[elements], wp.float32, self._body.device)
            if made is not self._body.conditions.activations:
                self._body.conditions.set_activations(made)

    def _settle(self) -> None:
        """Give rows to new nodes between nodes that follow different ones."""
        arrays = self._forest.carriage.arrays
        rows = self._of_nodes(arrays.row)
        ends = self._forest.pools.ends[: len(rows)].numpy()
        rows = self.keyframes.settle(rows, ends, self._of_nodes(arrays.u)[:, :3])
        arrays.row[: len(rows)].assign(rows)
        everywhere = wp.ones(1, dtype=wp.int32, device=self._forest.device)
        self.launch(everywhere)

    def _take_activation(self) -> None:
        """Tell the device the active stress of elements, and which keyframes they follow, if the user has changed
        them."""
        body, keyframes = self._body, self.of_activation
        if not body.discretization.has_activation:
            return
        wp.copy(self._of_leaves(ACTIVATION), body.discretization.activation[: body.element_count])
        if not keyframes.are(body.conditions.activations):
            kept = self.kept.get(ACTIVATION_ROW)
            keyframes.forget(but=np.empty(0, np.int32) if kept is None else kept.numpy())
            rows = keyframes.adopt(body.conditions.activations, body.element_count)
            wp.copy(self._of_leaves(ACTIVATION_ROW), wp.array(rows, dtype=wp.int32, device=body.device))

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
            self._kept_rows = self.kept["row"].numpy() if "row" in self.kept else np.empty(0, np.int32)
        self.keyframes.forget(but=np.concatenate([self._kept_rows, rows]))

    def _of_leaves(self, name: str, count: int | None = None) -> Any:
        """What the leaves of the present mesh, or so many, carry by a name, in place."""
        carriage, leaves = self._forest.carriage, self._forest.pools.leaves
        leaves = leaves[: self._body.element_count if count is None else count]
        if name in carriage.names:
            return wp.indexedarray(carriage.arrays.values[:, carriage.names.index(name)], [leaves])
        return wp.indexedarray(carriage.arrays.numbers[:, carriage.number_names.index(name)], [leaves])

    def _of_nodes(self, array: wp.array) -> npt.NDArray[Any]:
        return array[: self._body.node_count].numpy().copy()
