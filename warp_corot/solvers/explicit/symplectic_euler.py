"""Symplectic Euler: explicit, first order, without drift of energy."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warp_corot.elasticity import ForceField
from warp_corot.elasticity.viscosity import Viscosity
from warp_corot.errors import InputError
from warp_corot.inputs.checks import checked_number
from warp_corot.kernels.stepping.integrate import STEP_SYMPLECTIC_EULER, follow_trajectory
from warp_corot.solvers.integrator import Integrator, StepContext, Stepper

from .block import BlockSteps
from .patches import PatchSteps

if TYPE_CHECKING:
    from warp_corot.body.soft_body import SoftBody


#: The shortest step that float32 holds with all its digits [s].
SHORTEST = float(np.finfo(np.float32).tiny)


@dataclass(frozen=True)
class SymplecticEuler(Integrator):
    """v <- (v + dt (f/m + g)) / (1 + dt damping); x <- x + dt v, with lumped masses.

    Attributes:
        dt: Time step [s]; None: one that is stable, found again during the run.
        damping: Rate of mass-proportional damping >= 0 [1/s], taken implicitly, so that it never limits the step.
        viscosity: Viscous over elastic stress at one strain >= 0 [s], stiffness-proportional damping that leaves the
            motion of a body as a whole alone: a vibration of angular frequency w decays by viscosity * w^2 / 2. Taken
            explicitly: the stable step becomes sqrt(viscosity^2 + 4 / w^2) - viscosity for the largest w.

    Raises:
        InputError: A value out of its range.
    """

    dt: float | None = None
    damping: float = 0.0
    viscosity: float = 0.0

    def __post_init__(self) -> None:
        if self.dt is not None and not SHORTEST <= checked_number(self.dt, "dt", "s, or None") < math.inf:
            raise InputError(
                f"dt is {self.dt}; it must be a positive number of seconds, at least {SHORTEST:.2g}, or None"
            )
        if not 0 <= checked_number(self.damping, "damping", "1/s") < math.inf:
            raise InputError(f"damping is {self.damping}; it must be zero or a positive rate in 1/s")

        if not (math.isfinite(self.viscosity) and self.viscosity >= 0):
            raise InputError(f"viscosity is {self.viscosity}; it must be zero or a positive time in seconds")

    def stable_step(self, frequency: float) -> float:
        """As ``Integrator``. With damping c = viscosity w^2, taken from the velocities before the step, central
        differences are stable while dt^2 w^2 + 2 dt c < 4."""
        elastic = super().stable_step(frequency)
        # The positive root without cancellation.
        return elastic**2 / (self.viscosity + math.hypot(self.viscosity, elastic)) if frequency > 0.0 else elastic

    def bind(self, body: SoftBody, field: ForceField, context: StepContext) -> Stepper:
        return SymplecticEulerStepper(body, field, context, self.damping, self.viscosity)


class SymplecticEulerStepper(Stepper):
    def __init__(self, body: SoftBody, field: ForceField, context: StepContext, damping: float, viscosity: float = 0.0):
        self.body = body
        self.field = field
        self.context = context
        self.damping = damping
        self.viscosity = Viscosity(body, field, viscosity) if viscosity else None
        # One body is sooner done by all multiprocessors, many small ones by one each.
        self.patches = PatchSteps.of(body, field) if self.viscosity is None else None
        self.block = BlockSteps.of(body, field) if self.patches is None and self.viscosity is None else None

    @property
    def many_a_launch(self) -> bool:
        return self._launched is not None

    @property
    def _launched(self) -> BlockSteps | PatchSteps | None:
        """What makes many steps in one launch, if anything does."""
        if self.block is not None:
            return None if self.body.conditions.trajectories else self.block
        return self.patches

    def prepare(self) -> None:
        if self.patches is not None:
            self.patches.prepare()

    def forces(self, offset: int = 0) -> None:
        self.field.begin_step(self.context.pace, offset)
        self.field.add_forces(self.body.state.displacements, self.body.state.forces)

    def steps(self, count: int, *, forces_known: bool = False) -> None:
        many = self._launched
        if many is not None and many.is_prepared:
            if forces_known:
                self.body.state.forces.zero_()  # a block finds its own
            many.launch(count, self.damping, self.context)
            return
        for offset in range(count):
            if offset > 0 or not forces_known:
                self.forces(offset)
            if self.viscosity is not None:
                self.viscosity.add_forces(self.body.state.forces)
            self._move(offset)

    def _move(self, offset: int) -> None:
        """Launch the motion of the ``offset``-th step since the clock was last advanced."""
        body, context = self.body, self.context
        for trajectory in body.conditions.trajectories:
            wp.launch(
                follow_trajectory,
                dim=len(trajectory.nodes),
                inputs=[
                    trajectory.nodes,
                    trajectory.times,
                    trajectory.displacements,
                    context.pace.arrays,
                    body.conditions.world_starts,
                    body.world_node_count,
                    offset,
                    body.state.forces,
                    body.state.displacements,
                ],
                outputs=[body.state.velocities, context.support_work],
                device=body.device,
            )
        wp.launch(
            STEP_SYMPLECTIC_EULER[body.conditions.loads.dtype],
            dim=body.sizes.launch_nodes,
            inputs=[
                self.damping,
                context.gravity,
                body.conditions.mass,
                body.conditions.inverse_mass,
                int(body.conditions.has_loads),
                body.conditions.loads,
                context.pace.arrays,
                offset,
                body.state.forces,
                body.state.displacements,
                body.state.velocities,
            ],
            outputs=[body.state.reactions, context.support_work, context.bad_step],
            device=body.device,
        )
