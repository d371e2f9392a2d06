"""Viscous forces of a body, which take energy out of what changes its shape and leave its motion as a whole alone."""

from __future__ import annotations

from typing import TYPE_CHECKING

import warp as wp

from warp_corot.kernels.elements.viscosity import scatter_viscous

if TYPE_CHECKING:
    from warp_corot.body.soft_body import SoftBody

    from .model import ForceField


class Viscosity:
    """Stresses proportional to the rate of strain, in every element.

    Args:
        body: The body.
        field: Its elastic forces, whose elements are followed where the mesh changes.
        seconds: Viscosities over Lamé's parameters [s].
    """

    #: It takes energy out of the body and never puts any in.
    is_dissipative = True

    def __init__(self, body: SoftBody, field: ForceField, seconds: float):
        self.body, self.field, self.seconds = body, field, seconds
        self._kernel = scatter_viscous(body.discretization.element_kind)
        #: Where sums must come out the same every time, the elements' own places for them.
        self._slotted = body.discretization.plan(subtrees=False, deterministic=True) if field.deterministic else None

    def add_forces(self) -> None:
        """Launch what adds the forces of the present displacements and velocities to the body's [N]."""
        state = self.body.state
        self.scatter(state.displacements, state.velocities, state.forces)

    def scatter(self, u: wp.array, v: wp.array, f: wp.array) -> None:
        """Launch what adds the forces of displacements u and velocities v, in which they are linear, to f [N]."""
        if self._slotted is None:
            self._launch(self.field.elements, u, v, f)
            return
        slots = self._slotted.slots
        assert slots is not None
        slots.values.zero_()
        self._launch(self._slotted.elements, u, v, slots.values)
        slots.gather(f)

    def _launch(self, elements: object, u: wp.array, v: wp.array, f: wp.array) -> None:
        inputs = [elements, self.seconds, self.field.isotropic, u, v]
        wp.launch(self._kernel, self.field.element_count, inputs, [f], device=self.body.device)
