"""Nodal arrays of bodies that several ranks hold, brought together."""

from __future__ import annotations

import weakref
from collections.abc import Iterable
from typing import Any

import numpy.typing as npt
import warp as wp

from warp_corot.errors import InputError
from warp_corot.inputs.checks import shown

from .part_sync import PartSync

_all: weakref.WeakSet[PartSync] = weakref.WeakSet()


def register(following: Iterable[PartSync]) -> None:
    """Register bodies and their parts for ``gather``."""
    for each in following:
        _all.add(each)


def forget(following: Iterable[PartSync]) -> None:
    """Forget bodies and their former parts."""
    for each in following:
        _all.discard(each)


def gather(array: wp.array) -> npt.NDArray[Any] | None:
    """A nodal array of a body, such as ``body.positions``, with the values of all ranks. All ranks must call.

    Args:
        array: An array of a body in a ``Simulation`` of this package, [worlds * N] in the mesh's node order.

    Returns:
        On rank 0 a copy, float32 [worlds * N, 3] for vectors; None on other ranks.

    Raises:
        InputError: The array belongs to no such body.
    """
    if not isinstance(array, wp.array):
        raise InputError(f"array is {shown(array)}; it must be a nodal array of a body, such as body.positions")
    known = [each for each in _all if each.owns(array)]
    if not known:
        # Only the length of a copy, such as body.displacements, tells to which body it belongs.
        known = [each for each in _all if len(array) == each.whole.node_count]
    if len(known) != 1:
        raise InputError(
            f"the array [{len(array)}] is of {'no body' if not known else 'several bodies'} in a simulation on several "
            "ranks; it must be a nodal array of one, such as body.positions"
        )
    return known[0].gather(array)
