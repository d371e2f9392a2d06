"""Implicit time steps of all bodies of a system, as launches that can be recorded."""

from __future__ import annotations

from typing import TYPE_CHECKING

import warp as wp

from warp_corot.solvers.integrator import Stepper

from .body_steps import BodySteps, SharedSteps
from .lagged import Lagged
from .step_solve import StepSolve

if TYPE_CHECKING:
    from warp_corot.solvers.system import System

    from .schemes import ImplicitIntegrator


class ImplicitStepper(Stepper):
    """Steps of an implicit integrator.

    Args:
        system: The bodies; velocities are at the time of displacements.
        integrator: The integrator.

    Attributes:
        totals: Steps, iterations of Newton's method and of linear solves, and steps that did not come within the
            tolerance, of all bodies, int64 [4].
        shared: What the steps of all bodies share.
    """

    graph_steps = 8
    resolves_constraints = True

    def __init__(self, system: System, integrator: ImplicitIntegrator):
        system.lag, system.is_implicit = 0.0, True
        self.system, self.integrator, self.shared = system, integrator, SharedSteps(system, integrator)
        self.totals = self.shared.totals
        self._is_sturdy = False
        self._bodies = [BodySteps(self.shared, k) for k in range(len(system.bodies))]
        coupled = [[body] for body in self._bodies] if self.shared.rows is None else [self._bodies]
        self._solves = [StepSolve(self.shared, bodies) for bodies in coupled]

    @property
    def kept(self) -> dict[str, wp.array]:
        arrays = enumerate(array for body in self._bodies for array in body.history)
        kept = {f"history.{number}": array for number, array in arrays}
        kept |= {f"velocities.{k}": body.before for k, body in enumerate(self._bodies)}
        kept |= {f"meetings.{k}": body.met for k, body in enumerate(self._bodies) if body.met.size}
        kept |= {f"touched.{k}": body.touched for k, body in enumerate(self._bodies) if body.touched.size}
        states = [
            (k, body.preconditioner.state)
            for k, body in enumerate(self._bodies)
            if isinstance(body.preconditioner, Lagged)
        ]
        states += [(k, solve.choice.state) for k, solve in enumerate(self._solves) if solve.choice is not None]
        return kept | {f"setup.{k}.{name}": array for k, state in states for name, array in state.items()}

    def prepare(self) -> None:
        for solve in self._solves:
            solve.prepare()
        if self.shared.rows is not None:
            self.shared.rows.prepare()

    def continue_from(self, other: Stepper) -> None:
        assert isinstance(other, ImplicitStepper)
        wp.copy(self.totals, other.totals)

    def fall_back(self) -> bool:
        falls = bool(self.integrator.history) and not self._is_sturdy
        if falls:
            self.shared.sturdy.fill_(1)
            self._is_sturdy = True
        return falls

    def recover(self) -> None:
        if self._is_sturdy:
            self.shared.sturdy.zero_()
            self._is_sturdy = False

    def forces(self, offset: int = 0) -> None:
        for k in range(len(self._bodies)):
            self.system.add_elastic_forces(k, offset)

    def steps(self, count: int, *, forces_known: bool = False) -> None:
        for offset in range(count):
            self.system.offset = offset
            if forces_known and offset == 0:
                self.shared.forget_forces()
            for each in self.shared.touching:
                each.launch_motion(offset)
            for hold in self.shared.holds:
                hold.launch_begin()
            for solve in self._solves:
                solve.launch(offset, is_last=offset == count - 1)
