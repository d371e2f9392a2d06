"""Implicit time steps of all bodies of a system, as launches that can be recorded."""

from __future__ import annotations

from typing import TYPE_CHECKING

import warp as wp

from warp_corot.solvers.integrator import Stepper

from .body_steps import BodySteps, SharedSteps
from .joined import JoinedSolve
from .joined_newton import JoinedNewton

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
        self._joined: JoinedSolve | None = None
        self._joined_newton: JoinedNewton | None = None
        self._is_sturdy = False
        self._bodies = [BodySteps(self.shared, k) for k in range(len(system.bodies))]

    @property
    def kept(self) -> dict[str, wp.array]:
        arrays = enumerate(array for body in self._bodies for array in body.history)
        kept = {f"history.{number}": array for number, array in arrays}
        kept |= {f"velocities.{k}": body.before for k, body in enumerate(self._bodies)}
        kept |= {f"meetings.{k}": body.met for k, body in enumerate(self._bodies) if body.met.size}
        kept |= {f"touched.{k}": body.touched for k, body in enumerate(self._bodies) if body.touched.size}
        lagged = [(k, body.lagged) for k, body in enumerate(self._bodies) if body.lagged is not None]
        return kept | {f"setup.{k}.{name}": array for k, each in lagged for name, array in each.state.items()}

    def prepare(self) -> None:
        before = [body.newton for body in self._bodies]
        for body in self._bodies:
            body.prepare()
        if self.shared.rows is not None:
            self.shared.rows.prepare()
            if self._joined is None or before != [body.newton for body in self._bodies]:
                self._join()

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
            if self._joined is not None:
                self._launch_joined(offset, self._joined)
                continue
            for body in self._bodies:
                body.launch_changes(offset)
                body.launch_begin()
                body.launch_residual()
                body.launch_solve()
                body.launch_end(offset, is_last=offset == count - 1)

    def _launch_joined(self, offset: int, joined: JoinedSolve) -> None:
        """Launch a step of all bodies together."""
        assert self.shared.rows is not None
        wp.copy(self.shared.begins, self.shared.sturdy)
        for body in self._bodies:
            body.launch_changes(offset)
        touched = [body.touched for body in self._bodies]
        if self.integrator.history:
            self.shared.rows.launch_meetings(offset, touched, self.shared.begins)
        for body in self._bodies:
            body.launch_begin()
        solve: JoinedSolve | JoinedNewton = joined
        if self._joined_newton is None:
            for body in self._bodies:
                body.launch_residual()
        else:
            solve = self._joined_newton
        solve.launch(offset)
        if self.integrator.history:
            self.shared.rows.launch_touched(touched)
        for body in self._bodies:
            body.take_solved(solve)
            body.launch_end(offset, is_last=True)

    def _join(self) -> None:
        assert self.shared.rows is not None
        options, newtons = self.integrator, [body.newton for body in self._bodies]
        self._joined = JoinedSolve(
            newtons,
            [body.held for body in self._bodies],
            self.shared.rows,
            worlds=self.system.bodies[0].worlds,
            tolerance=options.linear_tolerance,
            most=options.linear_iterations,
        )
        if not self.shared.in_one_solve:
            self._joined_newton = JoinedNewton(self._joined, newtons, **options.newton_with_contact)
