"""Implicit time steps of all bodies of a system, as launches that can be recorded."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import warp as wp

from warp_corot.inputs.loading import load
from warp_corot.kernels.implicit import conjugate_gradients
from warp_corot.kernels.implicit import newton as kernels_of_newton
from warp_corot.solvers.integrator import Stepper

from .assembled import AssembledSolve, suits
from .block_system import BlockSystem, VectorBlocks
from .body_steps import BodySteps, SharedSteps, StepCounts
from .chosen import ChosenSolve
from .lagged import Lagged
from .linearised_step import LinearisedStep

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
        coupled = [self._bodies] if self.shared.couples else [[body] for body in self._bodies]
        self._solves = [StepSolve(self.shared, bodies) for bodies in coupled]

    @property
    def kept(self) -> dict[str, wp.array]:
        arrays = enumerate(array for body in self._bodies for array in body.history)
        kept = {f"history.{number}": array for number, array in arrays}
        kept |= {f"velocities.{k}": body.before for k, body in enumerate(self._bodies)}
        kept |= {f"touched.{k}": body.touched for k, body in enumerate(self._bodies) if body.touched.size}
        states = [
            (k, body.preconditioner.state)
            for k, body in enumerate(self._bodies)
            if isinstance(body.preconditioner, Lagged)
        ]
        states += [(k, solve.choice.state) for k, solve in enumerate(self._solves) if solve.choice is not None]
        return kept | {f"setup.{k}.{name}": array for k, state in states for name, array in state.items()}

    def prepare(self) -> None:
        if self.shared.contact is not None:
            self.shared.contact.prepare()
        for solve in self._solves:
            solve.prepare()

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


class StepSolve:
    """The solve for a step of bodies whose unknowns are coupled: one body, or all of them if soft surfaces may touch.

    Args:
        shared: What the steps of all bodies share.
        bodies: The bodies.

    Attributes:
        choice: The choice between two ways of solving, or None.
    """

    def __init__(self, shared: SharedSteps, bodies: Sequence[BodySteps]):
        self._shared, self._bodies, self._versions = shared, list(bodies), [-1]
        self._touches = shared.contact is not None
        self.choice = self._made_choice()

    def _made_choice(self) -> ChosenSolve | None:
        bodies, options = self._bodies, self._shared.integrator
        operators = [body.operator for body in bodies]
        lagged = [body.preconditioner for body in bodies if isinstance(body.preconditioner, Lagged)]
        if options.preconditioner is not None or len(lagged) < len(bodies) or not all(map(suits, operators)):
            return None
        blocks = VectorBlocks([len(operator.inverse_mass) for operator in operators])
        assembled = AssembledSolve(operators, blocks, together=self._shared.couples, touches=self._touches)
        load((), assembled.device, assembled.kernels)
        shares = any(body.field.shares_dilatation for body in bodies)
        return ChosenSolve(assembled, operators, lagged, shares=shares, dt=options.dt)

    def prepare(self) -> None:
        """Make everything that launches use, so that they can be recorded."""
        bodies = self._bodies
        for body in bodies:
            body.prepare()
        if self.choice is not None:
            self.choice.prepare()
        versions = [body.body.version for body in bodies]
        if versions != self._versions:
            if self._versions != [-1]:
                for body in bodies:
                    body.forget()
            self._versions = versions
            self._make()
        if self.choice is not None:
            self.choice.is_open = all(suits(body.operator) for body in bodies)
        if self._linearised is not None:
            self._system.solver.tolerance.fill_(self._shared.integrator.linear_tolerance)

    def _make(self) -> None:
        """Make everything that depends on the meshes."""
        bodies, options = self._bodies, self._shared.integrator
        self._system = BlockSystem(
            [body.operator for body in bodies],
            [body.preconditioner for body in bodies],
            contact=self._shared.contact,
            couples=self._shared.couples,
            choice=self.choice,
            most=options.linear_iterations,
            ranks=self._shared.system.ranks,
        )
        for number, body in enumerate(bodies):
            body.take_system(self._system, number)
        newtons = [body.newton for body in bodies]
        self._linearised: LinearisedStep | None = None
        if self._touches or options.tolerance is None:
            self._linearised = LinearisedStep(
                self._system, newtons, tolerance=options.tolerance, most=options.iterations
            )
            solve, good = self._linearised, int(conjugate_gradients.CONVERGED)
            self._counts = StepCounts(solve.iterations, solve.linear_iterations, solve.status, good)
        else:
            (newton,) = newtons
            good = int(kernels_of_newton.CONVERGED)
            self._counts = StepCounts(newton.iterations, newton.solved, newton.status, good)

    def launch(self, offset: int, *, is_last: bool) -> None:
        """Launch the ``offset``-th step since the clock was last advanced; ``is_last`` as for ``BodySteps``."""
        bodies, shared = self._bodies, self._shared
        if shared.couples:
            wp.copy(shared.begins, shared.sturdy)
        for body in bodies:
            body.launch_changes(offset)
        # Velocities jump when bodies meet things, so schemes of second order begin again.
        touched, contact = [body.touched for body in bodies], shared.contact if shared.integrator.history else None
        if contact is not None:
            contact.launch_onsets(offset, touched, bodies[0].begins)
        if shared.integrator.history:
            shared.system.ranks.max(bodies[0].begins)
        for body in bodies:
            body.launch_begin()
        self._solve(offset)
        if contact is not None:
            contact.launch_touched(touched)
        for body in bodies:
            body.launch_end(offset, self._counts, is_last=is_last)

    def _solve(self, offset: int) -> None:
        if self._linearised is None:
            newton = self._bodies[0].newton
            newton.launch_begin()
            wp.capture_while(newton.running, newton.launch_iteration)
            return
        self._linearised.launch(offset)
        self._system.judge(self._counts.linear_iterations, self._counts.status)
