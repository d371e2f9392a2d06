"""Devices by name, and vectors in device arrays of Warp, PyTorch or JAX, used without a copy to the host."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from warp_corot.errors import InputError

from .checks import shown


def checked_device(device: str | wp.Device | None) -> wp.Device:
    """The device with this name; Warp's default for None.

    Raises:
        InputError: There is no device with this name; the message lists the devices that exist.
    """
    wp.init()
    try:
        found = wp.get_device(device)
    except Exception:
        found = None
    if found is None:
        there = ", ".join(str(d) for d in wp.get_devices())
        raise InputError(f"there is no device {shown(str(device))} here; there is: {there}")
    return found


def vectors_on_device(given: Any, name: str, counts: tuple[int, ...], device: wp.Device) -> wp.array | None:
    """Vectors in a device array, one for all nodes or one for each; None for any other input.

    The host does not wait for the device, so values are not checked.

    Args:
        given: A ``wp.array`` of vec3 [n] or float32 [n, 3], or an array of float32 [n, 3] that supports DLPack, as
            those of PyTorch and JAX do. float32 [3] is one vector.
        name: The name for the message.
        counts: Allowed numbers of vectors, besides one.
        device: The device of the result; arrays on other devices are copied to it.

    Returns:
        vec3 [n].

    Raises:
        InputError: Another dtype, or another number of vectors.
    """
    array = _as_warp(given)
    if array is None:
        return None
    if array.dtype == wp.float32 and array.shape == (3,):
        array = array.reshape((1, 3))
    if array.dtype == wp.float32 and array.ndim == 2 and array.shape[1] == 3:
        rows = array if array.strides[1] == wp.types.type_size_in_bytes(wp.float32) else array.contiguous()
        array = rows.view(wp.vec3)
    if array.dtype != wp.vec3 or array.ndim != 1 or len(array) not in (1, *counts):
        allowed = " or ".join(f"[{count}, 3]" for count in dict.fromkeys(counts))
        found = f"{wp.types.type_repr(array.dtype)} {list(array.shape)}"
        raise InputError(f"{name} is {found}; it must be float32 [3] or {allowed}, or vec3 of as many")
    return array if array.device == device else array.to(device)


def _as_warp(given: Any) -> wp.array | None:
    if isinstance(given, wp.array):
        return given if given.dtype in (wp.float32, wp.vec3) else None
    if isinstance(given, np.ndarray | np.generic) or not hasattr(given, "__dlpack__"):
        return None
    try:
        array = wp.from_dlpack(given)
    except Exception as error:  # any error of the other program
        raise InputError(f"{shown(given)} cannot be read through DLPack: {error}") from None
    return array if array.dtype == wp.float32 else None
