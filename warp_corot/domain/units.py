"""Units of length, never guessed, and a word on bodies of unlikely size."""

from __future__ import annotations

import math

import numpy as np

from ..errors import InputError

#: Metres in a unit.
UNITS = {"m": 1.0, "cm": 1.0e-2, "mm": 1.0e-3}
#: Bodies outside this range [m] are probably given in another unit than is said.
SMALLEST, LARGEST = 1.0e-3, 100.0
#: Lengths [m], and distances from the origin in lengths, that float32 computes with.
FLOAT32_SIZES = 1.0e-6, 1.0e6
FLOAT32_DISTANCE = 1.0e4
#: The size [m] that the likely unit brings an unlikely body closest to: an organ's.
TYPICAL = 0.2


def metres_per_unit(unit: str) -> float:
    """Metres in a unit.

    Raises:
        InputError: It is not one of "m", "cm", "mm".
    """
    if not isinstance(unit, str) or unit not in UNITS:
        raise InputError(f"unit is {unit!r}; it must be one of {', '.join(map(repr, UNITS))}")
    return UNITS[unit]


def length(metres: float) -> str:
    """A length to three digits in the unit that suits it."""
    if metres == 0.0 or abs(metres) >= 1.0:
        return f"{metres:.3g} m"
    return f"{1e3 * metres:.3g} mm" if abs(metres) >= 1e-3 else f"{1e6 * metres:.3g} um"


def volume(cubic_metres: float) -> str:
    """A volume to three digits, in cubic metres, litres, millilitres or cubic millimetres."""
    for unit, factor in (("m^3", 1.0), ("l", 1e3), ("ml", 1e6)):
        if abs(cubic_metres) * factor >= 1.0:
            return f"{cubic_metres * factor:.3g} {unit}"
    return f"{cubic_metres * 1e9:.3g} mm^3"


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
            f"the body is {size:.3g} m long; float32, in which all is computed, wants {least:g} to {most:g} m"
        )
    if far > FLOAT32_DISTANCE * size:
        raise InputError(
            f"the body is {length(size)} long and reaches {length(far)} from the origin; float32, in which all is "
            f"computed, wants it within {FLOAT32_DISTANCE:g} times its length: move it nearer"
        )


def unlikely_size(size: float, metres: float) -> str | None:
    """What to say of a body of an unlikely size, None for a likely one.

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
        f"the body is {length(size)} long: if its coordinates are in {likely}, say unit={likely!r} "
        f"(a factor of {factor:g}: {length(becomes)})"
    )
