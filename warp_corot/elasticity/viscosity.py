"""Viscous forces of a body, which damp changes of shape and leave rigid motion unchanged."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import warp as wp

from warp_corot.kernels.elements.native_laws import VISCOUS
from warp_corot.kernels.elements.viscosity import ViscousMaterial, viscosity_stress

from .backends.elements import ByElements

if TYPE_CHECKING:
    from warp_corot.body.soft_body import SoftBody

    from .model import ForceField


class Viscosity:
    """Stresses proportional to the rate of strain, in every element.

    Args:
        body: The body.
        field: Its elastic forces; viscosity follows their elements if the mesh changes.
        seconds: Viscosities over Lamé's parameters [s].
        complete: A function that adds the velocities of nodes that other processes move; None if there are none.
    """

    #: Viscosity removes energy from the body and never adds any.
    is_dissipative = True

    def __init__(
        self,
        body: SoftBody,
        field: ForceField,
        seconds: float,
        complete: Callable[[wp.array], wp.array] | None = None,
    ):
        self.body, self.field, self.seconds, self._complete = body, field, seconds, complete
        law = ViscousMaterial, viscosity_stress, VISCOUS
        self._scatter = ByElements(body.discretization, field.plan, *law, slotted=field.deterministic)

    def add_forces(self) -> None:
        """Launch the kernel that adds the forces of the present displacements and velocities to the body's [N]."""
        state = self.body.state
        velocities = state.velocities if self._complete is None else self._complete(state.velocities)
        self.scatter(state.displacements, velocities, state.forces)

    def scatter(self, u: wp.array, v: wp.array, f: wp.array) -> None:
        """Launch the kernel that adds the forces of displacements u and velocities v, linear in v, to f [N]."""
        material = ViscousMaterial()
        material.isotropic, material.seconds, material.velocities = self.field.isotropic, self.seconds, v
        self._scatter(self.field.element_count, material, u, f)
