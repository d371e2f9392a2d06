"""Checks that keyframes of nodes and of elements share."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from warp_corot.errors import InputError

from .checks import checked_numbers


def checked_times(times: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Times of keyframes [s], float64 [K].

    Raises:
        InputError: They are not at least two finite numbers that increase.
    """
    t = checked_numbers(times, "times", "at least two that increase")
    if t.ndim != 1 or len(t) < 2 or not np.isfinite(t).all() or (np.diff(t) <= 0).any():
        raise InputError(f"times of shape {t.shape} must be at least two finite, increasing numbers")
    return t
