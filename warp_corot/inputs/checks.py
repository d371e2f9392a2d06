"""Checks of users' input: numbers, lists, objects of a type, indices, keyframes, devices and arrays on these."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from os import PathLike
from pathlib import Path
from types import UnionType
from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.errors import InputError

FLOAT32 = np.finfo(np.float32)
#: Counts beyond this are mistakes.
MOST = 2**63 - 1


def checked_count(given: Any, name: str, least: int) -> int:
    """A whole number of at least ``least``.

    Raises:
        InputError: It is something else.
    """
    try:
        count = int(given)
        whole = bool(count == given) and not isinstance(given, bool)
    except (TypeError, ValueError, OverflowError):  # OverflowError: infinity
        count, whole = least - 1, False
    if not whole or not least <= count <= MOST:
        raise InputError(f"{name} is {shown(given)}; it must be a whole number, at least {least}")
    return count


def checked_numbers(given: npt.ArrayLike | wp.array, name: str, wanted: str) -> npt.NDArray[np.float64]:
    """An array of numbers of any shape, float64.

    Args:
        given: Numbers, nested lists of them, a NumPy array or a Warp array.
        name: The name for the message.
        wanted: What it must be, for the message: "[10, 3]".

    Raises:
        InputError: It contains something else, or its rows have different lengths.
    """
    try:
        return np.asarray(given.numpy() if isinstance(given, wp.array) else given, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):  # OverflowError: a whole number beyond float64
        raise InputError(f"{name} is {shown(given)}; it must be numbers, {wanted}") from None


def checked_vector(given: npt.ArrayLike, name: str, unit: str = "m") -> npt.NDArray[np.float64]:
    """Three finite numbers, float64 [3].

    Raises:
        InputError: They are something else.
    """
    try:
        vector = checked_numbers(given, name, "[3]").copy()
    except InputError:
        vector = np.empty(0)
    if vector.shape != (3,) or not np.isfinite(vector).all():
        raise InputError(f"{name} is {shown(given)}; it must be three finite numbers{f' [{unit}]' if unit else ''}")
    return vector


def checked_points(points: npt.ArrayLike | wp.array) -> npt.NDArray[np.float64]:
    """Finite points, float64 [n, 3].

    Raises:
        InputError: They have another shape, or are not finite.
    """
    points = checked_numbers(points, "points", "[n, 3]")
    if points.ndim != 2 or points.shape[1] != 3:
        raise InputError(f"points has shape {points.shape}; it must be [n, 3]")
    bad = np.flatnonzero(~np.isfinite(points).all(axis=1))
    if len(bad):
        raise InputError(f"point {bad[0]} is {points[bad[0]].tolist()}; its coordinates must be finite")
    return points


def checked_number(given: Any, name: str, unit: str = "") -> float:
    """One number, which may be infinite or NaN.

    Raises:
        InputError: It is something else.
    """
    try:
        number = np.asarray(given)
        if number.shape == () and (np.issubdtype(number.dtype, np.integer) or np.issubdtype(number.dtype, np.floating)):
            return float(number)
    except (TypeError, ValueError, OverflowError):
        pass
    raise InputError(f"{name} is {shown(given)}; it must be a number{f' [{unit}]' if unit else ''}")


def checked_length(given: Any, name: str) -> float:
    """A positive, finite length [m].

    Raises:
        InputError: It is something else.
    """
    if isinstance(given, bool) or not 0.0 < checked_number(given, name, "m") < np.inf:
        raise InputError(f"{name} is {shown(given)}; it must be a positive length [m]")
    return float(given)


def checked_choice(given: Any, name: str, choices: Collection[str]) -> str:
    """One of several words.

    Raises:
        InputError: It is something else.
    """
    if not isinstance(given, str) or given not in choices:  # an array is not compared with words
        *others, last = (repr(each) for each in choices)
        raise InputError(f"{name} is {shown(given)}; it must be {' or '.join(filter(None, [', '.join(others), last]))}")
    return given


def checked_axis(given: Any, name: str = "up_axis") -> str:
    """The name of an axis.

    Raises:
        InputError: It is something else.
    """
    return checked_choice(given, name, ("X", "Y", "Z"))


def checked_flag(given: Any, name: str) -> bool:
    """True or False.

    Raises:
        InputError: It is something else.
    """
    if not isinstance(given, bool | np.bool_):
        raise InputError(f"{name} is {shown(given)}; it must be True or False")
    return bool(given)


def checked_strings(given: Any, name: str) -> tuple[str, ...]:
    """Names as a tuple.

    Raises:
        InputError: They are something else.
    """
    names = tuple(given) if isinstance(given, Iterable) and not isinstance(given, str | bytes | wp.array) else None
    if names is None or not all(isinstance(each, str) for each in names):
        raise InputError(f"{name} is {shown(given)}; it must be a list of names")
    return names


def checked_path(given: Any, name: str) -> Path:
    """The path of a file.

    Raises:
        InputError: It is something else.
    """
    if not isinstance(given, str | PathLike):
        raise InputError(f"{name} is {shown(given)}; it must be the path of a file")
    return Path(given)


def shown(given: Any) -> str:
    """A user's value for a message: short, in one line."""
    text = " ".join(repr(given).split())
    return text if len(text) <= 60 else f"{text[:57]}..."


def refuse_tape() -> None:
    """Check that no ``wp.Tape`` is recording: kernels here have no adjoint, and gradients would be zero.

    Raises:
        InputError: A tape is recording.
    """
    try:
        with wp.Tape():  # Warp refuses a second tape
            pass
    except RuntimeError:
        raise InputError(
            "a wp.Tape is recording, and steps have no adjoint: gradients through them would be zero; "
            "step outside of it"
        ) from None


def checked_things(given: Any, kind: type | UnionType, name: str, wanted: str) -> tuple:
    """One object of a type or several of them, as a tuple.

    Raises:
        InputError: One of them has another type.
    """
    things = tuple(given) if isinstance(given, Iterable) and not isinstance(given, str) else (given,)
    for thing in things:
        if not isinstance(thing, kind):
            raise InputError(f"{name} is {shown(thing)}; it must be {wanted}, or a list of them")
    return things


def check_float32(values: npt.ArrayLike, what: str, unit: str) -> None:
    """Check that float32 holds positive values with all their digits.

    Raises:
        InputError: It does not.
    """
    numbers = np.atleast_1d(values)
    bad = numbers[~((numbers >= FLOAT32.tiny) & (numbers <= FLOAT32.max))]
    if len(bad):
        limits = f"{FLOAT32.tiny:.2g} to {FLOAT32.max:.2g}"
        raise InputError(f"{what} is {bad[0]:.3g} {unit}; it must be within the range of float32, {limits}")


def checked_indices(given: npt.ArrayLike, count: int, thing: str) -> npt.NDArray[np.intp]:
    """The indices that a mask or a list gives, in the given order, negative ones counted from the end.

    Args:
        given: Mask bool [count], or indices from -count to count - 1.
        count: Number of things that can be indexed.
        thing: Their name for the message: "node", "leaf".

    Raises:
        InputError: A mask of the wrong shape, an index out of range, or neither a mask nor whole numbers.
    """
    try:
        chosen = np.asarray(given)
    except ValueError:
        wanted = f"a mask [{count}] or a list of whole numbers"
        raise InputError(f"{thing} indices have rows of different lengths; they must be {wanted}") from None
    if chosen.dtype == bool:
        if chosen.shape != (count,):
            raise InputError(f"the {thing} mask has shape {chosen.shape}; it must be [{count}]")
        return np.flatnonzero(chosen)
    if not chosen.size:
        return np.zeros(0, np.intp)
    if not np.issubdtype(chosen.dtype, np.integer) or chosen.ndim > 1:
        raise InputError(
            f"{thing} indices have dtype {chosen.dtype} and shape {chosen.shape}; "
            f"they must be a mask [{count}] or a list of whole numbers"
        )
    chosen = np.atleast_1d(chosen)
    bad = chosen[(chosen < -count) | (chosen >= count)]
    if len(bad):
        raise InputError(f"{thing} {bad[0]} is out of range: there are {count}")
    return (chosen % count).astype(np.intp)


def checked_times(times: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Times of keyframes [s], float64 [K].

    Raises:
        InputError: They are not at least two finite numbers that increase.
    """
    t = checked_numbers(times, "times", "at least two that increase")
    if t.ndim != 1 or len(t) < 2 or not np.isfinite(t).all() or (np.diff(t) <= 0).any():
        raise InputError(f"times of shape {t.shape} must be at least two finite, increasing numbers")
    return t


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
