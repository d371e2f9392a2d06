"""Values of options: numbers in SI units or with a unit, for example 5kPa, ranges and levels."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from typing import NamedTuple

from warp_corot.errors import InputError

#: The height of the ground that lies just below the bodies.
AUTO = "auto"


def quantity(unit: str) -> Callable[[str], float]:
    """A function that converts an option's text to a number in a unit, for ``add_argument(type=...)``."""

    def parse(text: str) -> float:
        from warp_corot.domain.units import in_units

        try:
            return in_units(text, unit)
        except InputError as error:
            raise argparse.ArgumentTypeError(str(error)) from None

    return parse


def number(text: str) -> float:
    """A number."""
    try:
        return float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} must be a number, for example 0.45") from None


def whole_number(text: str) -> int:
    """A whole number: 20000 or 2e4."""
    try:
        value = float(text)
        if value == int(value):
            return int(text) if text.strip().lstrip("+-").isdecimal() else int(value)
    except (ValueError, OverflowError):
        pass
    raise argparse.ArgumentTypeError(f"{text!r} must be a whole number, for example 20000 or 2e4")


def rotation_level(text: str) -> int | float | str:
    """A level of the tree, a tolerance [rad], or "auto"."""
    if text == "auto":
        return text
    try:
        return int(text)
    except ValueError:
        return number(text)


metres = quantity("m")


class Interval(NamedTuple):
    """A range of numbers with both ends."""

    low: float
    high: float

    def __str__(self) -> str:
        return f"{self.low!r}:{self.high!r}"


def value_range(text: str) -> Interval:
    """Two numbers LOW:HIGH, or one without an upper limit."""
    words = text.split(":")
    try:
        low, high = [float(word) for word in words] if len(words) == 2 else (float(text), float("inf"))
    except ValueError:
        low, high = float("nan"), float("nan")
    if not low <= high:
        raise argparse.ArgumentTypeError(f"{text!r} must be a number or LOW:HIGH, for example 200 or -200:300")
    return Interval(low, high)


def unit_of_length(text: str) -> str:
    """A unit, or a length used as a unit: mm or 3.2cm."""
    from warp_corot.domain.units import metres_per_unit

    try:
        metres_per_unit(text)
    except InputError as error:
        raise argparse.ArgumentTypeError(str(error).removeprefix("unit is ")) from None
    return text


def ground_height(text: str) -> float | str:
    """A height [m] or "auto", for ``add_argument(type=...)``."""
    if text == AUTO:
        return text
    try:
        return metres(text)
    except argparse.ArgumentTypeError as error:
        raise argparse.ArgumentTypeError(f"{error}; it must be a height or {AUTO} (INPUT stands before it)") from None
