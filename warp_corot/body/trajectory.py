"""Prescribed motion of nodes: keyframes of their displacements."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.errors import InputError
from warp_corot.inputs.checks import checked_numbers
from warp_corot.inputs.keys import checked_times


@dataclass(frozen=True, eq=False)
class NodeKeyframes:
    """Keyframed displacements on the host.

    Attributes:
        nodes: int [n].
        times: float64 [K] [s].
        displacements: float64 [K, n, 3], or [K, 1, 3] for all nodes [m].
    """

    nodes: npt.NDArray[np.integer]
    times: npt.NDArray[np.float64]
    displacements: npt.NDArray[np.float64]

    @classmethod
    def checked(
        cls, nodes: npt.NDArray[np.integer], times: npt.ArrayLike | None, displacements: npt.ArrayLike | None
    ) -> NodeKeyframes:
        """Make keyframes from the arguments of ``SoftBody.prescribe``.

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
        return cls(nodes, t, d.reshape(len(t), -1, 3))

    def on(self, device: wp.Device) -> Trajectory:
        """Copy the keyframes to a device."""
        return Trajectory(
            wp.array(self.nodes, dtype=wp.int32, device=device),
            wp.array(self.times, dtype=wp.float64, device=device),
            wp.array(self.displacements, dtype=wp.vec3, device=device),
            np.asarray(self.nodes, np.int32),
        )


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Keyframed displacements that a set of nodes follows, on the device.

    Attributes:
        nodes: int32 [n].
        times: float64 [K] [s].
        displacements: vec3 [K, n], or [K, 1] for all nodes [m].
        host_nodes: A copy of ``nodes`` on the host.
    """

    nodes: wp.array
    times: wp.array
    displacements: wp.array
    host_nodes: npt.NDArray[np.int32]

    def rewritten(self, keys: NodeKeyframes) -> Trajectory | None:
        """Write other keyframes into these arrays; None unless they have the same nodes and as many times."""
        if self.displacements.shape != keys.displacements.shape[:2] or len(self.times) != len(keys.times):
            return None
        if not np.array_equal(self.host_nodes, keys.nodes):
            return None
        self.times.assign(keys.times)
        self.displacements.assign(keys.displacements.astype(np.float32))
        return replace(self)

    def keys(self) -> tuple[np.ndarray, np.ndarray]:
        """Times and displacements as arguments for ``NodeKeyframes.checked``."""
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
        return NodeKeyframes.checked(nodes, self.times.numpy(), kept).on(self.nodes.device)
