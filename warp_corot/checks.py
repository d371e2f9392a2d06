"""What users give, checked: numbers, lists and things of a kind."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
import numpy.typing as npt

from .errors import InputError

FLOAT32 = np.finfo(np.float32)


def checked_count(given: Any, name: str, least: int) -> int:
    """A whole number of at least ``least``.

    Raises:
        InputError: It is not.
    """
    try:
        count = int(given)
    except (TypeError, ValueError, OverflowError):
        count = least - 1
    if count < least or count != given or isinstance(given, bool):
        raise InputError(f"{name} is {given!r}; it must be a whole number, at least {least}")
    return count


def checked_things(given: Any, kind: type, name: str, wanted: str) -> tuple:
    """One thing of a kind or several of them, as a tuple.

    Raises:
        InputError: Something in it is of another kind.
    """
    things = tuple(given) if isinstance(given, Iterable) and not isinstance(given, str) else (given,)
    for thing in things:
        if not isinstance(thing, kind):
            raise InputError(f"{name} is {thing!r}; it must be {wanted}, or a list of them")
    return things


def check_float32(values: npt.ArrayLike, what: str, unit: str) -> None:
    """See that float32 holds positive values with all its digits.

    Raises:
        InputError: It does not.
    """
    numbers = np.atleast_1d(values)
    bad = numbers[~((numbers >= FLOAT32.tiny) & (numbers <= FLOAT32.max))]
    if len(bad):
        limits = f"{FLOAT32.tiny:.2g} to {FLOAT32.max:.2g}"
        raise InputError(f"{what} is {bad[0]:.3g} {unit}; float32, in which all is computed, holds {limits}")
