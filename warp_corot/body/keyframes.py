"""Keyframes that nodes and active stress follow."""

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


@dataclass(frozen=True, eq=False)
class Activation:
    """Active stress over time: keyframes, linear in between, constant before and after.

    Attributes:
        times: Increasing times [s], [K], at least two, in simulation time since the world's last reset.
        stress: Active stress at these times [Pa], [K] for all elements or [K, n] for n of them; positive
            contracts.

    Raises:
        InputError: Wrong shapes, times that do not increase, or values that are not finite.
    """

    times: npt.ArrayLike
    stress: npt.ArrayLike

    def __post_init__(self) -> None:
        try:
            t, s = np.asarray(self.times, dtype=np.float64), np.asarray(self.stress, dtype=np.float64)
        except (TypeError, ValueError):
            raise InputError("times and stress of an Activation must be numbers") from None
        checked_times(t)
        if s.ndim not in (1, 2) or len(s) != len(t) or not np.isfinite(s).all():
            raise InputError(f"stress has shape {s.shape}; it must be finite, [{len(t)}] or [{len(t)}, n]")
        object.__setattr__(self, "times", t)
        object.__setattr__(self, "stress", s)

    def repeated(self, worlds: int, count: int) -> Activation:
        """The same for ``count`` elements in each world; keyframes for all elements do not change."""
        stress = np.asarray(self.stress)
        if stress.ndim == 2 and stress.shape[1] == count:
            return Activation(self.times, np.tile(stress, (1, worlds)))
        return self


def followed_stress(elements: np.ndarray, activation: Activation, device: wp.Device) -> Followed:
    """Keyframes for these elements, on a device.

    Raises:
        InputError: The number of columns differs from the number of elements.
    """
    stress = np.asarray(activation.stress)
    if stress.ndim == 2 and stress.shape[1] not in (1, len(elements)):
        raise InputError(f"stress of an Activation has shape {stress.shape}; there are {len(elements)} elements")
    values = stress.reshape(len(stress), -1)
    return Followed.made(elements, np.asarray(activation.times), values, wp.float32, device)


def constant_stress(stress: float | npt.ArrayLike, worlds: int, count: int) -> npt.NDArray[np.float64]:
    """Active stress [Pa], float64 [worlds, count], from a number or an array that broadcasts to that.

    Raises:
        InputError: It does not broadcast, or is not finite.
    """
    try:
        values = np.asarray(stress, dtype=np.float64)
        spread = np.broadcast_to(values, (worlds, count))
    except (TypeError, ValueError):
        shape = f"an array of shape {np.shape(stress)}" if np.ndim(stress) else repr(stress)
        raise InputError(
            f"stress is {shape}; it must be a number, [{count}], [{worlds}, {count}] or an Activation"
        ) from None
    if not np.isfinite(values).all():
        raise InputError("stress of an activation is not finite; it must be finite")
    return spread
