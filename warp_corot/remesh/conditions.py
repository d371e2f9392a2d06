"""What is done to a changing mesh: which nodes are held and loaded, how fibres pull, which keyframes both follow."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import warp as wp

from ..kernels.remesh_state import NO_ROW
from .carried_activation import CarriedActivation
from .carried_material import ACTIVATION, ACTIVATION_ROW
from .keyframes import Keyframes
from .pools import DeviceForest

if TYPE_CHECKING:
    from ..body import SoftBody


#: What is kept for ``put_back``.
KEPT: dict[str, Any] = {
    "held": wp.uint8,
    "load": wp.vec4,
    "row": wp.int32,
    "v": wp.vec4,
    ACTIVATION: wp.float32,
    ACTIVATION_ROW: wp.int32,
}


class Conditions:
    """Held nodes, loads, active stress and keyframes, handed between body and pools.

    Args:
        body: The body.
        forest: Its pools.

    Attributes:
        keyframes: What nodes follow.
        activation: Active stress, and what it follows.
        kept: Held nodes, loads, rows, velocities and active stress as ``put_back`` writes them.
    """

    def __init__(self, body: SoftBody, forest: DeviceForest):
        self._body = body
        self._forest = forest
        self.keyframes = Keyframes()
        self.activation = CarriedActivation(body, forest)
        self._revision = -1
        self._is_back = False
        self.kept: dict[str, wp.array] = {}

    @property
    def of_present_mesh(self) -> bool:
        """Whether what is kept is that of the present mesh."""
        return self._body.mesh_revision == self._revision

    def keep(self) -> None:
        """From now on, what this mesh has last is what ``put_back`` writes."""
        self._revision = self._body.mesh_revision
        self.note()

    def set_kept(self, kept: dict[str, wp.array], *, of_present_mesh: bool) -> None:
        """Write this from now on, of the present mesh or of another."""
        self.kept = kept
        self._revision = self._body.mesh_revision if of_present_mesh else -1

    def note(self) -> None:
        """Take over what the user has done; to be called before the mesh changes."""
        self._take_trajectories()
        self.activation.note(self.kept.get(ACTIVATION_ROW))
        if self.of_present_mesh:
            arrays, count = self._forest.carriage.arrays, self._body.node_count
            self.kept = {name: wp.clone(getattr(arrays, name)[:count]) for name in ("held", "load", "row", "v")}
            self.kept |= self.activation.kept()

    def put_back(self) -> None:
        """Write what was kept into the mesh for which it was."""
        arrays, count = self._forest.carriage.arrays, len(self.kept["held"])
        for name in ("held", "load", "row"):
            wp.copy(getattr(arrays, name), self.kept[name], count=count)
        velocities, held = arrays.v[:count].numpy().copy(), self.kept["held"].numpy() != 0
        velocities[held] = self.kept["v"].numpy()[held]
        arrays.v[:count].assign(velocities)
        arrays.reaction.zero_()
        self.activation.put_back(self.kept)
        self._is_back = True

    def follow(self) -> None:
        """Tell the host which nodes and elements follow keyframes after a pass, new ones among them."""
        self.activation.follow()
        body, arrays = self._body, self._forest.carriage.arrays
        # Nodes that were let go later follow again what they did on the mesh that is back.
        if not (body.trajectories or self._is_back):
            return
        self._is_back = False
        rows = self._of_nodes(arrays.row)
        if (rows < NO_ROW).any():
            ends = self._forest.pools.ends[: len(rows)].numpy()
            rows = self.keyframes.settle(rows, ends, self._of_nodes(arrays.u)[:, :3])
            arrays.row[: len(rows)].assign(rows)
        self._forget(rows)
        found = self.keyframes.trajectories(rows, body.device)
        if found is not body.trajectories:
            body.trajectories = found
            body.revision += 1

    def _take_trajectories(self) -> None:
        """Tell the device which keyframes nodes follow, if the user has changed them."""
        body = self._body
        if not self.keyframes.are(body.trajectories):
            rows = self.keyframes.adopt(body.trajectories, body.node_count)
            self._forest.carriage.arrays.row[: len(rows)].assign(rows)
            self._forget(rows)

    def _forget(self, rows: npt.NDArray[np.int32]) -> None:
        """Forget the keyframes that no node follows, now or in what is kept."""
        kept = self.kept["row"].numpy() if "row" in self.kept else np.empty(0, np.int32)
        self.keyframes.forget(but=np.concatenate([rows, kept]))

    def _of_nodes(self, array: wp.array) -> npt.NDArray[Any]:
        return array[: self._body.node_count].numpy().copy()
