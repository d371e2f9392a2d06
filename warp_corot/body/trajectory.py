"""Motion that nodes are told to make: keyframes of their displacements."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.errors import InputError
from warp_corot.inputs.checks import checked_numbers
from warp_corot.inputs.keys import checked_times


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Keyframed displacements that a set of nodes follows, on the device.

    Attributes:
        nodes: int32 [n].
        times: float64 [K] [s].
        displacements: vec3 [K, n], or [K, 1] for all nodes alike [m].
        host_nodes: ``nodes`` as the host knows them.
    """

    nodes: wp.array
    times: wp.array
    displacements: wp.array
    host_nodes: npt.NDArray[np.int32]

    @classmethod
    def of_keys(
        cls, nodes: np.ndarray, times: npt.ArrayLike | None, displacements: npt.ArrayLike | None, device: wp.Device
    ) -> Trajectory:
        """From keyframes as ``SoftBody.prescribe`` takes them.

        Raises:
            InputError: One of the two is missing, wrong shapes, times that do not increase, or non-finite values.
        """
        if times is None or displacements is None:
            raise InputError("prescribe needs both times and displacements")
        t = checked_times(times)
        d = checked_numbers(displacements, "displacements", f"[{len(t)}, 3] or [{len(t)}, {len(nodes)}, 3]")
        if d.shape not in ((len(t), 3), (len(t), len(nodes), 3)) or not np.isfinite(d).all():
            raise InputError(
                f"displacements has shape {d.shape}; it must be finite, [{len(t)}, 3] or [{len(t)}, {len(nodes)}, 3]"
            )
        return cls(
            wp.array(nodes, dtype=wp.int32, device=device),
            wp.array(t, dtype=wp.float64, device=device),
            wp.array(d.reshape(len(t), -1, 3), dtype=wp.vec3, device=device),
            np.asarray(nodes, np.int32),
        )

    def in_place_of(self, former: Trajectory) -> Trajectory | None:
        """The same keyframes in the arrays of former ones; None unless those are of the same nodes and as many."""
        if self.displacements.shape != former.displacements.shape or len(self.times) != len(former.times):
            return None
        if not np.array_equal(self.host_nodes, former.host_nodes):
            return None
        wp.copy(former.times, self.times)
        wp.copy(former.displacements, self.displacements)
        return replace(former)

    def keys(self) -> tuple[np.ndarray, np.ndarray]:
        """Times and displacements as ``of_keys`` takes them."""
        d = self.displacements.numpy()
        return self.times.numpy(), d[:, 0] if d.shape[1] == 1 else d

    def without(self, chosen: np.ndarray) -> Trajectory | None:
        """The same for the nodes that are not among the chosen; None if all are."""
        stays = ~np.isin(self.host_nodes, chosen)
        if stays.all():
            return self
        nodes, d = self.host_nodes[stays], self.displacements.numpy()
        if d.shape[1] > 1:
            d = d[:, stays]
        if not len(nodes):
            return None
        kept = d[:, 0] if d.shape[1] == 1 else d
        return Trajectory.of_keys(nodes, self.times.numpy(), kept, self.nodes.device)
