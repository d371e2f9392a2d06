"""A static answer as a function of arrays, with its vector-Jacobian product; both frameworks wrap it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from warp_corot.body.soft_body import SoftBody
from warp_corot.errors import InputError
from warp_corot.gradients.objective import REPLACED, with_values
from warp_corot.gradients.static import solved_state
from warp_corot.inputs.checks import shown

Array = npt.NDArray[np.floating]


class StaticOperation:
    """Positions at rest of a body as a function of some of its input.

    Args:
        body: The body; it is copied and does not change.
        names: Names of the arguments, in order.
        options: Options of ``static_gradient``.

    Raises:
        InputError: A name is not in ``REPLACED``, or there are no names.
    """

    def __init__(self, body: SoftBody, names: tuple[str, ...], options: Mapping[str, Any]):
        if not isinstance(body, SoftBody):
            raise InputError(f"body is {shown(body)}; it must be a SoftBody")
        wanted = ", ".join(REPLACED)
        for name in names:
            if name not in REPLACED:
                raise InputError(f"{name} is not an argument; they are {wanted}")
        if not names:
            raise InputError(f"nothing is given to differentiate by; give one or several of {wanted}")
        self.body, self.names, self._options = body, names, dict(options)
        if "gravity" in names and self._options.pop("gravity", None) is not None:
            raise InputError("gravity is given twice")

    def solve(self, values: Mapping[str, Array], start: Array | None = None) -> Any:
        """The body at rest with these values of the arguments; the search begins at ``start`` [m], [worlds * N, 3]."""
        body = with_values(self.body, {name: value for name, value in values.items() if name != "gravity"})
        if start is not None:
            body.displacements = start - body.rest_positions
        options = {"model": None, "gravity": values.get("gravity"), **self._options}
        return solved_state(body, names=self.names, **options)

    def pull_back(self, solved: Any, derivative: Array, values: Mapping[str, Array]) -> dict[str, Array]:
        """Derivatives with respect to these arguments, each of its argument's shape.

        Args:
            solved: The state of rest.
            derivative: The derivative with respect to positions, [worlds * N, 3].
            values: The arguments for which derivatives are wanted.
        """
        places_are_given = "rest" in values and "boundary" in self.names
        names = {*values, "boundary"} if places_are_given else {*values}
        found = solved.pull_back(np.asarray(derivative, np.float64), tuple(names))
        if places_are_given:
            found["rest"] = found["rest"] - found["boundary"]  # held nodes stay where they are
        if "rest" in values:
            found["rest"] = found["rest"].reshape(self.body.worlds, -1, 3).sum(axis=0)
        return {name: reduced(np.asarray(found[name], np.float64), np.shape(value)) for name, value in values.items()}


def reduced(values: Array, shape: tuple[int, ...]) -> Array:
    """Derivatives summed over the repetitions of an argument of this shape."""
    if values.shape == shape:
        return values
    if values.size == int(np.prod(shape)):
        return values.reshape(shape)
    while values.ndim > len(shape):
        values = values.sum(axis=0)
    for axis, count in enumerate(shape):
        if count == 1 and values.shape[axis] != 1:
            values = values.sum(axis=axis, keepdims=True)
    return values.reshape(shape)
