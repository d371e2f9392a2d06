"""Checks of users' input: numbers, lists and objects of a type."""

from __future__ import annotations

from collections.abc import Iterable
from os import PathLike
from pathlib import Path
from types import UnionType
from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.errors import InputError

FLOAT32 = np.finfo(np.float32)


def checked_count(given: Any, name: str, least: int) -> int:
    """A whole number of at least ``least``.

    Raises:
        InputError: It is something else.
    """
    try:
        count = int(given)
    except (TypeError, ValueError, OverflowError):
        count = least - 1
    if count < least or count != given or isinstance(given, bool):
        raise InputError(f"{name} is {given!r}; it must be a whole number, at least {least}")
    return count


def checked_numbers(given: npt.ArrayLike | wp.array, name: str, wanted: str) -> npt.NDArray[np.float64]:
    """An array of numbers of any shape, float64.

    Args:
        given: Numbers, nested lists of them, a NumPy array or a Warp array.
        name: The name for the message.
        wanted: What it must be, for the message: "[10, 3]".

    Raises:
        InputError: It holds something else, or its rows have different lengths.
    """
    try:
        return np.asarray(given.numpy() if isinstance(given, wp.array) else given, dtype=np.float64)
    except (TypeError, ValueError):
        raise InputError(f"{name} is {shown(given)}; it must be numbers, {wanted}") from None


def checked_number(given: Any, name: str, unit: str = "") -> float:
    """One number, which may be infinite or NaN.

    Raises:
        InputError: It is something else.
    """
    try:
        number = np.asarray(given)
        if number.shape == () and (np.issubdtype(number.dtype, np.integer) or np.issubdtype(number.dtype, np.floating)):
            return float(number)
    except (TypeError, ValueError):
        pass
    raise InputError(f"{name} is {shown(given)}; it must be a number{f' [{unit}]' if unit else ''}")


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
