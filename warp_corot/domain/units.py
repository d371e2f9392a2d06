"""Quantities with units, a guess at a unit that is not named, and warnings about bodies of unlikely size."""

from __future__ import annotations

import functools
import math
import re
from collections.abc import Sequence
from typing import Any

import numpy as np

from warp_corot.errors import InputError
from warp_corot.inputs.arguments import meant
from warp_corot.inputs.checks import checked_number, shown

#: Units that a user may have meant.
USUAL = (
    "Pa",
    "kPa",
    "MPa",
    "GPa",
    "mmHg",
    "kg/m^3",
    "g/cm^3",
    "s",
    "ms",
    "min",
    "mm",
    "cm",
    "m",
    "inch",
    "m/s^2",
    "1/s",
)
#: Metres in a unit, at least and at most.
LEAST_UNIT, MOST_UNIT = 1.0e-18, 1.0e18
#: Metres in common units.
UNITS = {"m": 1.0, "cm": 1.0e-2, "mm": 1.0e-3}
#: The pattern of a number at the beginning of a quantity.
_NUMBER = re.compile(r"\s*[-+]?(?:(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?|inf(?![a-z])|nan(?![a-z]))")
#: Bodies outside this range [m] are probably given in a different unit: organs, limbs and people lie in it.
SMALLEST, LARGEST = 1.0e-3, 3.0
#: Bodies shorter than this [m] if their coordinates are in mm are taken to be in cm, scans are not.
SMALLEST_IN_MM = 0.01
#: Lengths [m], and distances from the origin in lengths, that float32 computes with.
FLOAT32_SIZES = 1.0e-6, 1.0e6
FLOAT32_DISTANCE = 1.0e4
#: The size [m] that the likely unit brings an unlikely body closest to: an organ's.
TYPICAL = 0.2


def metres_per_unit(unit: str | float) -> float:
    """Metres in a unit of length.

    Args:
        unit: "m", "cm", "mm" or any length that Pint knows, with or without a number: "inch", "3.2cm"; or metres as a
            number.

    Raises:
        InputError: It is not a positive length.
    """
    if isinstance(unit, str) and unit in UNITS:
        return UNITS[unit]
    try:
        metres = in_units(f"1 {unit}" if isinstance(unit, str) and unit and not _NUMBER.match(unit) else unit, "m")
    except InputError:
        metres = math.nan
    if not LEAST_UNIT <= metres <= MOST_UNIT:
        raise InputError(f"unit is {shown(unit)}; it must be a length such as 'mm', 'cm', 'm', 'inch' or '3.2cm'")
    return metres


def in_units(given: str | float, unit: str) -> float:
    """A quantity as a number in a unit.

    Args:
        given: A number, in that unit already; or a text such as "5kPa", "1.06 g/cm3" or "500".
        unit: A unit in Pint's notation, such as "Pa" or "kg/m^3".

    Raises:
        InputError: The text has no number, or its unit is not known or of another kind.
    """
    if isinstance(given, int | float | np.number) and not isinstance(given, bool):
        return checked_number(given, "the quantity", unit)
    if not isinstance(given, str):
        raise InputError(f"{given!r} is not a number, with or without a unit")
    match = _NUMBER.match(given)
    if not match:
        raise InputError(f"{given.strip()!r} is not a number, with or without a unit")
    number, words = float(match[0]), given[match.end() :].strip()
    return number * _factor(words, unit, given) if words else number


@functools.cache
def _factor(words: str, unit: str, given: str) -> float:
    import pint

    text = words.replace("³", "^3").replace("²", "^2").replace("·", "*")
    text = f"1{text}" if text.startswith("/") else text
    text = re.sub(r"(?<=[A-Za-zµ])([23])(?![\w.])", r"^\1", text)
    # Pint evaluates formulas; names, powers, products and quotients are enough.
    if not re.fullmatch(r"(?:1|[A-Za-zµΩ_]+)(?:\^-?[1-4])?(?:\s*[*/ ]\s*[A-Za-zµΩ_]+(?:\^-?[1-4])?)*", text):
        raise InputError(f"{given.strip()!r}: {words!r} is not a unit")
    try:
        return float(_registry().Quantity(1.0, text).to(unit).magnitude)
    except pint.DimensionalityError:
        raise InputError(f"{given.strip()!r}: {words!r} is not a unit like {unit}") from None
    except Exception:
        raise InputError(f"{given.strip()!r}: the unit {words!r} is not known{meant(words, USUAL)}") from None


@functools.cache
def _registry() -> Any:
    import pint

    return pint.UnitRegistry(cache_folder=None)


def likely_unit(size: float, scan: bool = False) -> str:
    """The most likely unit of a body's coordinates: metres if that is no unlikely size, else cm or mm.

    Args:
        size: Its longest side in that unit.
        scan: Whether the body comes from a scan, whose unit is usually mm.
    """
    if size <= LARGEST:
        return "m"
    return "mm" if scan or size * UNITS["mm"] >= SMALLEST_IN_MM else "cm"


#: Units of lengths [m], volumes [m^3] and pressures [Pa], from the largest to the smallest, each with its size.
LENGTHS = (("m", 1.0), ("mm", 1e-3), ("um", 1e-6))
VOLUMES = (("m^3", 1.0), ("l", 1e-3), ("ml", 1e-6), ("mm^3", 1e-9))
PRESSURES = (("GPa", 1e9), ("MPa", 1e6), ("kPa", 1e3), ("Pa", 1.0))


def _suited(value: float, units: Sequence[tuple[str, float]], digits: int = 3) -> str:
    """A value in the first unit that makes it at least one, or in the last; zero in the SI unit."""
    value = float(f"{value:.{digits}g}")
    unit, size = next((each for each in units if abs(value or 1.0) >= each[1]), units[-1])
    return f"{float(f'{value / size:.{digits}g}'):g} {unit}"


def length(metres: float) -> str:
    """A length to three digits in the unit that suits it; in micrometres only below a tenth of a millimetre."""
    return _suited(metres, LENGTHS if abs(metres) < 1e-4 else LENGTHS[:2])


def volume(cubic_metres: float) -> str:
    """A volume to three digits, in cubic metres, litres, millilitres or cubic millimetres."""
    return _suited(cubic_metres, VOLUMES)


def check_float32(bounds: np.ndarray) -> None:
    """See that float32 can tell the points of a body from one another.

    Args:
        bounds: Its box [2, 3] [m].

    Raises:
        InputError: It is too large, too small, or too far from the origin.
    """
    size, far = float(np.ptp(bounds, axis=0).max()), float(np.abs(bounds).max())
    least, most = FLOAT32_SIZES
    if not least <= size <= most:
        raise InputError(
            f"the body is {size:.3g} m long; it must be {least:g} to {most:g} m long, since it is computed in float32"
        )
    if far > FLOAT32_DISTANCE * size:
        raise InputError(
            f"the body is {length(size)} long and reaches {length(far)} from the origin; it must be within "
            f"{FLOAT32_DISTANCE:g} times its length, since it is computed in float32: move it nearer"
        )


def unlikely_size(size: float, metres: float) -> str | None:
    """A message about a body of an unlikely size; None for a likely one.

    Args:
        size: Its longest side [m].
        metres: Metres in the unit in which it was read.
    """
    if SMALLEST <= size <= LARGEST:
        return None
    likely = min(UNITS, key=lambda unit: abs(math.log(size / metres * UNITS[unit] / TYPICAL)))
    factor, becomes = UNITS[likely] / metres, size / metres * UNITS[likely]
    if math.isclose(factor, 1.0) or not SMALLEST <= becomes <= LARGEST:
        return f"the body is {length(size)} long: is its unit right?"
    return (
        f"the body is {length(size)} long: if its coordinates are in {likely}, give unit={likely!r} "
        f"(a factor of {factor:g}: {length(becomes)})"
    )


def pressure(pascals: float) -> str:
    """A pressure in Pa, kPa, MPa or GPa."""
    return _suited(pascals, PRESSURES, 6)
