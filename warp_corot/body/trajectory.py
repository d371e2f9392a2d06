"""Prescribed motion of nodes: keyframes of their displacements."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.errors import InputError
from warp_corot.inputs.checks import checked_numbers, checked_times


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

    def on(self, device: wp.Device) -> Followed:
        """Copy the keyframes to a device."""
        return Followed.made(self.nodes, self.times, self.displacements, wp.vec3, device)


@dataclass(frozen=True, eq=False)
class Followed:
    """Keyframes that nodes or elements follow, on the device.

    Attributes:
        numbers: The nodes or elements of all worlds, int32 [n].
        times: float64 [K] [s].
        values: A column for each, or one for all, [K, n] or [K, 1]: displacements [m], vec3, or active stress [Pa],
            float32.
        host_numbers: A copy of ``numbers`` on the host.
    """

    numbers: wp.array
    times: wp.array
    values: wp.array
    host_numbers: npt.NDArray[np.int32]

    @classmethod
    def made(
        cls, numbers: npt.NDArray[np.integer], times: np.ndarray, values: np.ndarray, dtype: type, device: wp.Device
    ) -> Followed:
        return cls(
            wp.array(numbers, dtype=wp.int32, device=device),
            wp.array(times, dtype=wp.float64, device=device),
            wp.array(values, dtype=dtype, device=device),
            np.asarray(numbers, np.int32),
        )

    def rewritten(self, keys: NodeKeyframes) -> Followed | None:
        """Write other keyframes into these arrays; None unless they have the same nodes and as many times."""
        if self.values.shape != keys.displacements.shape[:2] or len(self.times) != len(keys.times):
            return None
        if not np.array_equal(self.host_numbers, keys.nodes):
            return None
        self.times.assign(keys.times)
        self.values.assign(keys.displacements.astype(np.float32))
        return replace(self)

    def keys(self) -> tuple[np.ndarray, np.ndarray]:
        """Times and displacements as arguments for ``NodeKeyframes.checked``."""
        d = self.values.numpy()
        return self.times.numpy(), d[:, 0] if d.shape[1] == 1 else d

    def of(self, chosen: npt.NDArray[np.bool_], numbers: npt.NDArray[np.integer], device: wp.Device) -> Followed | None:
        """The same for some of those that follow, bool [n], with other numbers on a device; None if there are none."""
        if not chosen.any():
            return None
        values = self.values.numpy()
        of_each = values[:, chosen] if values.shape[1] > 1 else values
        return Followed.made(numbers[chosen], self.times.numpy(), of_each, self.values.dtype, device)

    def without(self, left: npt.NDArray[np.integer]) -> Followed | None:
        """The same for those that do not leave; None if all do."""
        stays = ~np.isin(self.host_numbers, left)
        return self if stays.all() else self.of(stays, self.host_numbers, self.times.device)
