"""Masks and lists of indices, as users give them."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from warp_corot.errors import InputError


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
