"""Sums over the steps of a run, and the derivatives that they give."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.elasticity import ForceField
from warp_corot.kernels.gradients import steps as kernels

from . import parameters
from .element_work import ElementWork

if TYPE_CHECKING:
    from warp_corot.body.soft_body import SoftBody

Array = npt.NDArray[np.float64]


class StepSums:
    """Sums of the work of forces in the adjoint motions of all steps.

    Args:
        body, field: The body and its elastic forces.
        names: Names of the requested derivatives.

    Attributes:
        loads: The loads of the run [N], vec4 [worlds * N].
        of_loads: The sum of adjoint motions, vec4 [worlds * N].
    """

    def __init__(self, body: SoftBody, field: ForceField, names: Sequence[str]):
        self.body, self.field, self.names = body, field, tuple(names)
        self.work = ElementWork(field, parameters.needed(names))
        like, count = body.state.displacements, body.sizes.nodes
        self.loads, self.of_loads, self._forces = (wp.zeros_like(like) for _ in range(3))
        if body.conditions.has_loads:
            self.loads[:count].assign(_four(body.conditions.loads.numpy()[:count, :3]))
        self._wants_mass = bool({"density", "rest"} & set(names))
        self._of_mass = wp.zeros(len(like), dtype=wp.float64, device=body.device)

    def add(self, u: wp.array, p: wp.array) -> None:
        """Launch the sums of one step, except those of loads, for the adjoint motion p and forces at displacements
        u.
        """
        self.work.add(u, p)
        if self._wants_mass:
            self._forces.zero_()
            self.field.add_forces(u, self._forces)
            inputs = [self.body.conditions.inverse_mass, self._forces, self.loads, p]
            wp.launch(kernels.add_of_mass, len(p), inputs, [self._of_mass], device=self.body.device)

    def clear(self) -> None:
        """Begin the sums again."""
        self.work.clear()
        self.of_loads.zero_()
        self._of_mass.zero_()

    def derivatives(self) -> dict[str, Any]:
        """The derivatives with respect to everything but the initial state; "rest" lacks the part of that state."""
        count = self.body.sizes.nodes
        moved = self.of_loads.numpy()[:count, :3].astype(np.float64)
        return derivatives(self.body, self.work, self.names, moved, self._of_mass.numpy()[:count])


class Work(Protocol):
    """Sums of elements; see ``ElementWork``."""

    def of_lame(self) -> tuple[Array, Array]: ...

    def of_activation(self) -> Array: ...

    def of_rest(self) -> Array: ...

    def of_weights(self, densities: Array) -> Array: ...


def derivatives(body: SoftBody, work: Work, names: Sequence[str], moved: Array, of_mass: Array) -> dict[str, Any]:
    """Derivatives of these names from sums.

    Args:
        body: The body.
        work: The sums of elements.
        names: Any except "boundary" and those of an initial state; "rest" is the derivative at constant positions.
        moved: The sum of adjoint motions, [worlds * N, 3].
        of_mass: The derivative with respect to the mass of each node, [worlds * N].
    """
    found: dict[str, Any] = {}
    for name in names:
        if name == "loads":
            found[name] = moved
        elif name == "gravity":
            found[name] = body.masses @ moved
        elif name == "young":
            found[name] = parameters.of_young(body, *work.of_lame())
        elif name == "poisson":
            found[name] = parameters.of_poisson(body, *work.of_lame())
        elif name == "density":
            found[name] = parameters.of_density(body, of_mass)
        elif name == "activation":
            found[name] = work.of_activation().reshape(body.worlds, -1)
        elif name == "rest":
            found[name] = work.of_rest() + work.of_weights(parameters.weight_densities(body, of_mass))
    return found


def _four(values: npt.NDArray[Any]) -> npt.NDArray[np.float32]:
    return np.pad(values.astype(np.float32), ((0, 0), (0, 1)))
