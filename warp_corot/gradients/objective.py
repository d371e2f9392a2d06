"""A user's objective: its value and its derivative with respect to positions."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.errors import InputError
from warp_corot.inputs.checks import shown

#: Positions [m] to a value that a tape differentiates, or to value and derivative.
Objective = Callable[[wp.array], Any]

WANTED = "a wp.array of one number, computed by Warp kernels, or a pair (value, gradient)"


def value_and_derivative(objective: Objective, positions: wp.array) -> tuple[float, npt.NDArray[np.float64]]:
    """The value of an objective, and its derivative with respect to positions, float64 [n, 3].

    Args:
        objective: A function of positions. It returns a ``wp.array`` of one number, computed by kernels that it
            launches, or a pair of a number and its derivative, [n, 3].
        positions: vec3 or vec3d [n].

    Raises:
        InputError: The objective returns something else, or a value that is not finite.
    """
    if not callable(objective):
        raise InputError(f"objective is {shown(objective)}; it must be a function of positions that gives {WANTED}")
    positions.requires_grad = True
    with wp.Tape() as tape:
        found = objective(positions)
    if isinstance(found, wp.array):
        value, derivative = _by_tape(found, tape, positions)
    else:
        value, derivative = _given(found, len(positions))
    if not (np.isfinite(value) and np.isfinite(derivative).all()):
        raise InputError("objective gives a value or a gradient that is not finite")
    return value, derivative


def _by_tape(loss: wp.array, tape: wp.Tape, positions: wp.array) -> tuple[float, npt.NDArray[np.float64]]:
    if loss.size != 1 or not loss.requires_grad:
        raise InputError(
            f"objective gives an array of {loss.size} numbers with requires_grad={loss.requires_grad}; it must be one "
            "number, for instance in wp.zeros(1, dtype=float, requires_grad=True)"
        )
    tape.backward(loss)
    return float(loss.numpy().ravel()[0]), positions.grad.numpy().astype(np.float64)


def _given(found: Any, count: int) -> tuple[float, npt.NDArray[np.float64]]:
    try:
        value, gradient = found
        value = float(value)
        derivative = np.asarray(gradient.numpy() if isinstance(gradient, wp.array) else gradient, np.float64)
    except (TypeError, ValueError):
        raise InputError(f"objective gives {shown(found)}; it must give {WANTED}") from None
    if derivative.size != 3 * count:
        raise InputError(f"the gradient that objective gives has shape {derivative.shape}; it must be [{count}, 3]")
    return value, derivative.reshape(count, 3)
