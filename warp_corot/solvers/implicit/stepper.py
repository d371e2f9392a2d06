"""Implicit time steps of all bodies of a system, as launches that can be recorded."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import warp as wp

from warp_corot.inputs.loading import load
from warp_corot.kernels.implicit import conjugate_gradients
from warp_corot.kernels.implicit import increments as kernels
from warp_corot.kernels.implicit import newton as kernels_of_newton
from warp_corot.solvers.system import Stepper

from .assembled import AssembledSolve, suits
from .block_system import BlockSystem, VectorBlocks
from .body_steps import BodySteps, SharedSteps
from .contact_solve import ContactSolve
from .preconditioners import ChosenSolve, Lagged

if TYPE_CHECKING:
    from warp_corot.solvers.system import System

    from .newton import Newton
    from .schemes import ImplicitIntegrator


class LinearisedStep:
    """Solves for the increments of all bodies of a system that may touch something.

    Increments begin with zero at free nodes, and the unknown of each linear problem is the whole motion d of the step:
    A d = r(d0) + A d0 + contact, with the residual r and its derivative -A at the motion d0 so far. So contact has the
    same unknowns in each of them. Where a scheme balances forces at a stage before the end of the step, increments are
    those of the stage, a share of d. Contact is that of the end of the step, with its whole force in the balance.

    Args:
        system: The linear system.
        newtons: Newton's method of each body, whose residuals are used.
        tolerance: The iteration ends once no increment changes by more than this share of the largest displacement.
        most: Maximum number of linearisations.

    Attributes:
        iterations, linear_iterations, status: Of the step, as in ``kernels.implicit.conjugate_gradients``, int32
            [worlds].
    """

    def __init__(self, system: BlockSystem, newtons: list[Newton], *, tolerance: float | None, most: int):
        self._system, self._newtons, self.device = system, newtons, system.device
        self._tolerance, self._most = math.inf if tolerance is None else tolerance, 1 if tolerance is None else most
        self._contact = ContactSolve(system, newtons)
        self.iterations = wp.ones(system.worlds, dtype=wp.int32, device=self.device)
        self.linear_iterations, self.status = self._contact.iterations, system.solver.status
        repeats = self._most > 1
        self._sizes = wp.zeros((system.worlds * repeats, kernels.COLUMNS), dtype=wp.float32, device=self.device)
        if repeats:
            self._product = wp.zeros_like(system.x)
            self.iterations, self.linear_iterations, self.status = (
                wp.zeros(system.worlds, dtype=wp.int32, device=self.device) for _ in range(3)
            )
            self._going = wp.zeros(1, dtype=wp.int32, device=self.device)

    def launch(self, offset: int) -> None:
        """Launch the increments and displacements of the ``offset``-th step, from a guess of the unknowns."""
        self._linearise()
        self._contact.launch_begin(offset)
        self._contact.launch()
        self._take_increments()
        if self._most > 1:
            self.iterations.zero_()
            self.linear_iterations.zero_()
            self._judge()
            wp.capture_while(self._going, self._go_on)
        self._contact.launch_end()

    def _linearise(self) -> None:
        for newton in self._newtons:
            newton.launch_residual()
        for newton in self._newtons:
            newton.linearise()
        self._system.update()

    def _go_on(self) -> None:
        self._linearise()
        system = self._system
        for newton in self._newtons:
            inputs = [newton.body.conditions.inverse_mass, newton.share, newton.increment]
            self._launch(kernels.take_free, inputs, [newton.step])
        system.apply_bodies(system.x, self._product)
        self._launch(kernels.add_product, [self._product], [system.b])
        self._contact.launch()
        self._take_increments()
        self._judge()

    def _take_increments(self) -> None:
        self._sizes.zero_()
        ranks = self._system.ranks
        for newton in self._newtons:
            body = newton.body
            inputs = [newton.operator.node_count, body.conditions.inverse_mass]
            inputs += [newton.base, newton.share, newton.step]
            self._launch(kernels.take_increments, inputs, [newton.increment, body.state.displacements, self._sizes])
            ranks.exchange(newton.operator.number, body.state.displacements)

    def _judge(self) -> None:
        """Launch the decision whether another linearisation follows."""
        self._system.ranks.max(self._sizes.flatten())
        self._going.zero_()
        inputs = [self._sizes, self._contact.iterations, self._system.solver.status, self._tolerance, self._most]
        outputs = [self.iterations, self.linear_iterations, self.status, self._going]
        wp.launch(kernels.judge_increments, len(self.status), inputs, outputs, device=self.device)

    def _launch(self, kernel: wp.Kernel, inputs: list, outputs: list) -> None:
        wp.launch(kernel, len(outputs[0]), inputs, outputs, device=self.device)


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
        self._linear_tolerance.fill_(self._shared.integrator.linear_tolerance)
        if self._linearised is not None:
            wp.copy(self._system.solver.tolerance, self._linear_tolerance)

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
        self._linear_tolerance = wp.zeros_like(self._system.solver.tolerance)
        if self._touches:
            solve = self._linearised = LinearisedStep(
                self._system, newtons, tolerance=options.tolerance, most=options.iterations
            )
            good = int(conjugate_gradients.CONVERGED)
            self._counts = [solve.iterations, solve.linear_iterations, solve.status, good]
        else:
            (newton,) = newtons
            self._counts = [newton.iterations, newton.solved, newton.status, int(kernels_of_newton.CONVERGED)]

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
            if self._shared.integrator.tolerance is None:
                newton.launch_only(self._linear_tolerance)
                self._system.judge(*self._counts[1:3])
                return
            newton.launch_begin()
            wp.capture_while(newton.running, newton.launch_iteration)
            return
        self._linearised.launch(offset)
        self._system.judge(*self._counts[1:3])
