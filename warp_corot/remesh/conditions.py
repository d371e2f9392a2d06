"""The conditions of a body whose mesh changes: supports, loads, active stress, and their keyframes."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.discretization.changing.pools import DeviceForest
from warp_corot.kernels.plan.changing import begin_counts
from warp_corot.kernels.remesh import followers as kernels

from .carried_activation import CarriedActivation
from .carried_material import ACTIVATION, ACTIVATION_ROW
from .keyframes import Keyframes

if TYPE_CHECKING:
    from warp_corot.body.soft_body import SoftBody


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
        self.found = wp.zeros(kernels.PLACES, dtype=wp.int32, device=forest.device)
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
        wp.launch(begin_counts, kernels.PLACES, inputs=[goes], outputs=[self.found], device=device)
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
