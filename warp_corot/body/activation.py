"""Active stress: the pull of muscle fibres, which does not depend on their length."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.errors import InputError
from warp_corot.inputs.checks import checked_times

from .trajectory import Followed


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
