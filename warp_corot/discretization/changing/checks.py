"""Checks of the options of remeshing: thresholds, levels, capacity, criterion and its numbers.

All messages have one form, NAME is VALUE; it must be …, with Python's names. ``cli.bodies`` puts the options' names in
their place.
"""

from __future__ import annotations

import inspect
import math
from typing import Any

import warp as wp

from warp_corot.errors import InputError
from warp_corot.inputs.checks import checked_number, shown
from warp_corot.kernels.remesh.criteria import PARAMETER_COUNTS


def checked_thresholds(refine_above: Any, simplify_below: Any) -> tuple[float, float]:
    """Both thresholds, in the criterion's unit.

    Raises:
        InputError: One of them is not a finite number, or the second is not below the first.
    """
    above, below = (
        _finite(given, name) for name, given in (("refine_above", refine_above), ("simplify_below", simplify_below))
    )
    if below >= above:
        raise InputError(
            f"simplify_below is {below:g}; it must be below refine_above, which is {above:g}, "
            "or an element could be refined and simplified at once"
        )
    return above, below


def checked_capacity(capacity: int, count: int) -> int:
    """The largest number of elements, for a mesh that begins with ``count``.

    Raises:
        InputError: Fewer than that.
    """
    if capacity < count:
        raise InputError(f"capacity is {capacity}; it must be at least {count}, as many elements as the mesh has")
    return capacity


def checked_criterion(criterion: Any) -> Any:
    """A criterion: a Warp function of an ``ElementState`` and an array of numbers.

    Raises:
        InputError: It is something else, or takes another number of arguments.
    """
    if not isinstance(criterion, wp.Function) or criterion.func is None:
        raise InputError(f"criterion is {shown(criterion)}; it must be a Warp function (@wp.func) of an ElementState")
    count = len(inspect.signature(criterion.func).parameters)
    if count != 2:
        raise InputError(
            f"criterion is {criterion.func.__name__!r}, which takes {count} arguments; "
            "it must take two, an ElementState and an array of float32"
        )
    return criterion


def checked_parameters(parameters: Any, criterion: Any) -> wp.array | None:
    """The numbers that a criterion reads, float32 [n], or None.

    Args:
        parameters: The numbers.
        criterion: The criterion; the length is checked for the package's own criteria.

    Raises:
        InputError: They are something else, or too few.
    """
    is_array = isinstance(parameters, wp.array) and parameters.dtype == wp.float32 and parameters.ndim == 1
    if parameters is not None and not (is_array and len(parameters) > 0):
        raise InputError(f"parameters is {shown(parameters)}; it must be a Warp array of float32, [n], not empty")
    given, needed = 0 if parameters is None else len(parameters), PARAMETER_COUNTS.get(criterion, 0)
    if given < needed:
        name = criterion.func.__name__
        raise InputError(f"parameters has {given} numbers; it must have {needed}, which the criterion {name!r} reads")
    return parameters


def _finite(given: Any, name: str) -> float:
    number = checked_number(given, name)
    if not math.isfinite(number):
        raise InputError(f"{name} is {number:g}; it must be a finite number")
    return number
