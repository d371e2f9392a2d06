"""Symplectic Euler: explicit, first order, without energy drift."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warp_corot.elasticity.added_stress import Viscosity
from warp_corot.errors import InputError
from warp_corot.inputs.checks import checked_number
from warp_corot.inputs.cpu_threads import Regions
from warp_corot.kernels.stepping.integrate import STEP_SYMPLECTIC_EULER, take_in_work
from warp_corot.solvers.system import Integrator, Stepper

from .block import BlockSteps
from .patches import PatchSteps

if TYPE_CHECKING:
    from warp_corot.solvers.system import System


#: The shortest step that float32 holds with all its digits [s].
SHORTEST = float(np.finfo(np.float32).tiny)


@dataclass(frozen=True)
class SymplecticEuler(Integrator):
    """v <- (v + dt (f/m + g)) / (1 + dt damping); x <- x + dt v, with lumped masses.

    Attributes:
        dt: Time step [s]; None: one that is stable, found again during the run.
        damping: Rate of mass-proportional damping >= 0 [1/s], integrated implicitly, so that it never limits the step.
        viscosity: Stiffness-proportional damping >= 0 [s], which does not act on rigid motions: the viscous stress is
            the elastic stress of viscosity times the strain rate. A vibration of angular frequency w decays at the rate
            viscosity * w^2 / 2. It is integrated explicitly: the stable step becomes
            sqrt(viscosity^2 + 4 / w^2) - viscosity for the largest w.

    Raises:
        InputError: A value is out of its range.
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

        if not 0 <= checked_number(self.viscosity, "viscosity", "s") < math.inf:
            raise InputError(f"viscosity is {self.viscosity}; it must be zero or a positive time in seconds")

    def stable_step(self, frequency: float) -> float:
        """See ``Integrator``. With damping c = viscosity w^2 at the velocities before the step, central differences are
        stable while dt^2 w^2 + 2 dt c < 4."""
        elastic = super().stable_step(frequency)
        # The positive root without cancellation.
        return elastic**2 / (self.viscosity + math.hypot(self.viscosity, elastic)) if frequency > 0.0 else elastic

    def bind(self, system: System) -> Stepper:
        return SymplecticEulerStepper(system, self.damping, self.viscosity)


class SymplecticEulerStepper(Stepper):
    resolves_constraints = True

    def __init__(self, system: System, damping: float, viscosity: float = 0.0):
        self.system = system
        self.damping = damping
        if viscosity:
            bound = enumerate(zip(system.bodies, system.fields, strict=True))
            system.forces += [
                Viscosity(body, field, viscosity, partial(system.ranks.exchange, k, copies=True))
                for k, (body, field) in bound
            ]
        self._many = [_steps_in_one_launch(system, k) for k in range(len(system.bodies))]
        shapes = [(body.discretization.team.parts, 2) for body in system.bodies]
        self._work = [wp.zeros(shape, dtype=wp.float64, device=system.device) for shape in shapes]
        self._regions = [Regions(body.discretization.team, system.device) for body in system.bodies]

    @property
    def many_a_launch(self) -> bool:
        return all(self._launched(k) is not None for k in range(len(self._many)))

    def _launched(self, k: int) -> BlockSteps | PatchSteps | None:
        """The launches that make many steps of a body, or None."""
        many = self._many[k]
        follows = isinstance(many, BlockSteps) and self.system.bodies[k].conditions.trajectories
        others = self.system.forces or self.system.constraints or not self.system.ranks.is_alone
        return None if follows or others else many

    def prepare(self) -> None:
        for many in self._many:
            if isinstance(many, PatchSteps):
                many.prepare()

    def forces(self, offset: int = 0) -> None:
        for k in range(len(self._many)):
            self.system.add_elastic_forces(k, offset)

    def steps(self, count: int, *, forces_known: bool = False) -> None:
        one_by_one = []
        for k, body in enumerate(self.system.bodies):
            many = self._launched(k)
            if many is None or not many.is_prepared:
                one_by_one.append(k)
                continue
            if forces_known:
                body.state.forces.zero_()  # a block finds its own
            many.launch(count, self.damping, self.system)
        if not one_by_one:
            return
        for offset in range(count):
            if offset > 0 or not forces_known:
                for k in one_by_one:
                    self.system.add_elastic_forces(k, offset)
                self.system.ranks.wait()
            self.system.add_other_forces(offset, self.damping, one_by_one)
            for k in one_by_one:
                body = self.system.bodies[k]
                self._move(k, offset)
                self.system.ranks.exchange(k, body.state.displacements, overlaps=True)
                self.system.fields[k].complete_step(body.state.displacements, self.system.pace.arrays)
        self.system.ranks.wait()

    def _move(self, k: int, offset: int) -> None:
        """Launch the motion of a body in the ``offset``-th step since the clock was last advanced."""
        system, body = self.system, self.system.bodies[k]
        regions, state, given = self._regions[k], body.state, body.conditions
        # Work of supports is added up part by part, so that its sum does not depend on the threads.
        is_one = regions.team.parts == 1
        work = [system.support_work_of(body)] if is_one else self._work[k]

        def arguments(part: int, own: Callable) -> tuple[list, list]:
            inputs = [self.damping, system.gravity, own(given.mass), own(given.inverse_mass), int(given.has_loads)]
            inputs += [own(given.loads) if given.has_loads else given.loads, system.pace.arrays, offset]
            inputs += [own(state.forces), own(state.displacements), own(state.velocities)]
            return inputs, [own(state.reactions), work[part], system.bad_step]

        kernel = STEP_SYMPLECTIC_EULER[given.loads.dtype]
        regions.launch_over(kernel, body.sizes.launch_nodes, arguments, offset)
        if not is_one:
            wp.launch(take_in_work, 1, [work], [system.support_work], device=body.device)


def _steps_in_one_launch(system: System, k: int) -> BlockSteps | PatchSteps | None:
    """The steps of a body in one launch, None if there are none: a few worlds are faster on all multiprocessors
    together, many small worlds are faster on one each."""
    body, field = system.bodies[k], system.fields[k]
    return PatchSteps.of(body, field) or BlockSteps.of(body, field)
