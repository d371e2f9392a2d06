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


def staying(
    followers: npt.NDArray[np.integer], chosen: npt.NDArray[np.integer], values: npt.NDArray[np.floating]
) -> tuple[npt.NDArray[np.integer], npt.NDArray[np.floating]] | None:
    """The followers of keyframes that are not among the chosen, with their values; None if all stay.

    Args:
        followers: [n].
        chosen: Those that stop following.
        values: A column for each follower, or one for all, [K, n, …] or [K, 1, …].
    """
    stays = ~np.isin(followers, chosen)
    if stays.all():
        return None
    return followers[stays], values[:, stays] if values.shape[1] > 1 else values
