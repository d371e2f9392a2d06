"""Implicit time steps of all bodies of a system, as launches that can be recorded."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, cast

import numpy as np
import warp as wp

from warp_corot.inputs.loading import load
from warp_corot.kernels.implicit import conjugate_gradients
from warp_corot.kernels.implicit import increments as kernels
from warp_corot.kernels.implicit import newton as kernels_of_newton
from warp_corot.kernels.stepping.stability import add_scaled
from warp_corot.solvers.system import Stepper

from .assembled import AssembledSolve, suits
from .block_system import BlockSystem, VectorBlocks
from .body_steps import BodySteps
from .contact_solve import ContactSolve
from .operator import Contact, Hold, Touching
from .preconditioners import ChosenSolve, Lagged

if TYPE_CHECKING:
    from warp_corot.solvers.system import System

    from .schemes import ImplicitIntegrator


#: The search for soft surfaces leaves room for this many times what a body that is let go falls in a step.
FALLS = 0.25


class ImplicitStepper(Stepper):
    """Steps of an implicit integrator.

    Args:
        system: The bodies; velocities are at the time of displacements.
        integrator: The integrator.

    Attributes:
        totals: Steps, iterations of Newton's method and of linear solves, and steps that did not come within the
            tolerance, of all bodies, int64 [4].
        touching: The constraints that implicit steps resolve.
        holds: The constraints that are springs in implicit steps.
        contact: The contact of all bodies, or None.
        couples: Whether all bodies are solved for together, because they may touch one another.
        begins: Nonzero if all bodies that are solved for together begin again with a first step, int32 [1].
        sturdy: Nonzero while each step is a first step, of backward Euler, int32 [1].
    """

    graph_steps = 8
    resolves_constraints = True

    def __init__(self, system: System, integrator: ImplicitIntegrator):
        system.lag, system.is_implicit = 0.0, True
        self.system, self.integrator = system, integrator
        self.totals = wp.zeros(4, dtype=wp.int64, device=system.device)
        self.touching = cast("list[Touching]", [each for each in system.constraints if hasattr(each, "implicit")])
        found = (each.implicit() for each in self.touching)
        self.contact: Contact | None = next((each for each in found if each is not None), None)
        self.couples = self.contact is not None and self.contact.couples
        if self.contact is not None:
            self.contact.reserve(FALLS * float(np.linalg.norm(system.gravity)) * integrator.dt**2)
        self.begins, self.sturdy = (wp.zeros(1, dtype=wp.int32, device=system.device) for _ in range(2))
        self._is_sturdy = False
        self._bodies = [BodySteps(self, k) for k in range(len(system.bodies))]
        coupled = [self._bodies] if self.couples else [[body] for body in self._bodies]
        self._solves = [StepSolve(self, bodies) for bodies in coupled]

    @property
    def holds(self) -> list[Hold]:
        return cast("list[Hold]", [each for each in self.system.constraints if hasattr(each, "add_stiffness")])

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
        if self.contact is not None:
            self.contact.prepare()
        for solve in self._solves:
            solve.prepare()

    def continue_from(self, other: Stepper) -> None:
        assert isinstance(other, ImplicitStepper)
        wp.copy(self.totals, other.totals)

    def fall_back(self) -> bool:
        falls = bool(self.integrator.history) and not self._is_sturdy
        if falls:
            self.sturdy.fill_(1)
            self._is_sturdy = True
        return falls

    def recover(self) -> None:
        if self._is_sturdy:
            self.sturdy.zero_()
            self._is_sturdy = False

    def forces(self, offset: int = 0) -> None:
        for k in range(len(self._bodies)):
            self.system.add_elastic_forces(k, offset)

    def steps(self, count: int, *, forces_known: bool = False) -> None:
        for offset in range(count):
            self.system.offset = offset
            if forces_known and offset == 0:
                self.forget_forces()
            for each in self.touching:
                each.launch_motion(offset)
            for hold in self.holds:
                hold.launch_begin()
            for solve in self._solves:
                solve.launch(offset, is_last=offset == count - 1)

    def add_other_forces(self) -> None:
        """Launch all forces except elastic ones in the present state to ``state.forces`` of the bodies."""
        self._add([*self.system.forces, *self.holds])

    def add_counted_forces(self) -> None:
        """The same for forces whose work is counted separately."""
        self._add(self.system.counted)

    def _add(self, forces: Sequence) -> None:
        self.forget_forces()
        for each in forces:
            each.add_forces()

    def forget_forces(self) -> None:
        """Launch the reset of all forces."""
        for body in self.system.bodies:
            body.state.forces.zero_()


class StepSolve:
    """The solve for a step of bodies whose unknowns are coupled: one body, or all of them if soft surfaces may touch.

    Bodies that touch nothing have Newton's method. Else increments begin with zero at free nodes, and the unknown of
    each linear problem is the whole motion d of the step: A d = r(d0) + A d0 + contact, with the residual r and its
    derivative -A at the motion d0 so far. So contact has the same unknowns in each of them. Where a scheme balances
    forces at a stage before the end of the step, increments are those of the stage, a share of d. Contact is that of
    the end of the step, with its whole force in the balance. The iteration ends once no increment changes by more than
    the integrator's tolerance as a share of the largest displacement.

    Args:
        stepper: The steps of all bodies.
        bodies: The bodies.

    Attributes:
        choice: The choice between two ways of solving, or None.
    """

    def __init__(self, stepper: ImplicitStepper, bodies: Sequence[BodySteps]):
        self._stepper, self._bodies, self._versions = stepper, list(bodies), [-1]
        self._touches = stepper.contact is not None
        self.choice = self._made_choice()

    def _made_choice(self) -> ChosenSolve | None:
        bodies, options = self._bodies, self._stepper.integrator
        operators = [body.operator for body in bodies]
        lagged = [body.preconditioner for body in bodies if isinstance(body.preconditioner, Lagged)]
        if options.preconditioner is not None or len(lagged) < len(bodies) or not all(map(suits, operators)):
            return None
        blocks = VectorBlocks([len(operator.inverse_mass) for operator in operators])
        assembled = AssembledSolve(operators, blocks, together=self._stepper.couples, touches=self._touches)
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
        self._linear_tolerance.fill_(self._stepper.integrator.linear_tolerance)
        if self._touches:
            wp.copy(self._system.solver.tolerance, self._linear_tolerance)

    def _make(self) -> None:
        """Make everything that depends on the meshes."""
        bodies, options = self._bodies, self._stepper.integrator
        self._system = BlockSystem(
            [body.operator for body in bodies],
            [body.preconditioner for body in bodies],
            contact=self._stepper.contact,
            couples=self._stepper.couples,
            choice=self.choice,
            most=options.linear_iterations,
            ranks=self._stepper.system.ranks,
        )
        for number, body in enumerate(bodies):
            body.take_system(self._system, number)
        self._newtons = [body.newton for body in bodies]
        self._linear_tolerance = wp.zeros_like(self._system.solver.tolerance)
        if not self._touches:
            (newton,) = self._newtons
            self._counts = [newton.iterations, newton.solved, newton.status, int(kernels_of_newton.CONVERGED)]
            return
        system, device = self._system, self._system.device
        self._contact = ContactSolve(system, self._newtons)
        self._repeats = options.tolerance is not None and options.iterations > 1
        self._sizes = wp.zeros((system.worlds * self._repeats, kernels.COLUMNS), dtype=wp.float32, device=device)
        counts = [wp.ones(system.worlds, dtype=wp.int32, device=device), self._contact.iterations, system.solver.status]
        if self._repeats:
            self._product, counts = wp.zeros_like(system.x), [wp.zeros_like(counts[0]) for _ in counts]
            self._going = wp.zeros(1, dtype=wp.int32, device=device)
        self._counts = [*counts, int(conjugate_gradients.CONVERGED)]

    def launch(self, offset: int, *, is_last: bool) -> None:
        """Launch the ``offset``-th step since the clock was last advanced; ``is_last`` as for ``BodySteps``."""
        bodies, stepper = self._bodies, self._stepper
        if stepper.couples:
            wp.copy(stepper.begins, stepper.sturdy)
        for body in bodies:
            body.launch_changes(offset)
        # Velocities jump when bodies meet things, so schemes of second order begin again.
        touched, contact = [body.touched for body in bodies], stepper.contact if stepper.integrator.history else None
        if contact is not None:
            contact.launch_onsets(offset, touched, bodies[0].begins)
        if stepper.integrator.history:
            stepper.system.ranks.max(bodies[0].begins)
        for body in bodies:
            body.launch_begin()
        self._solve(offset)
        if contact is not None:
            contact.launch_touched(touched)
        for body in bodies:
            body.launch_end(offset, self._counts, is_last=is_last)

    def _solve(self, offset: int) -> None:
        if self._touches:
            self._solve_contact(offset)
        elif self._stepper.integrator.tolerance is None:
            self._newtons[0].launch_only(self._linear_tolerance)
        else:
            (newton,) = self._newtons
            newton.launch_begin()
            wp.capture_while(newton.running, newton.launch_iteration)
            return
        self._system.judge(*self._counts[1:3])

    # --- increments of bodies that may touch something ---------------------------------------------------------------

    def _solve_contact(self, offset: int) -> None:
        """Launch the increments and displacements of the ``offset``-th step, from a guess of the unknowns."""
        self._linearise()
        self._contact.launch_begin(offset)
        self._contact.launch()
        self._take_increments()
        if self._repeats:
            for counts in self._counts[:2]:
                counts.zero_()
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
        self._launch(add_scaled, [1.0, self._product], [system.b])
        self._contact.launch()
        self._take_increments()
        self._judge()

    def _take_increments(self) -> None:
        self._sizes.zero_()
        for newton in self._newtons:
            body = newton.body
            inputs = [newton.operator.node_count, body.conditions.inverse_mass]
            inputs += [newton.base, newton.share, newton.step]
            self._launch(kernels.take_increments, inputs, [newton.increment, body.state.displacements, self._sizes])
            self._system.ranks.exchange(newton.operator.number, body.state.displacements)

    def _judge(self) -> None:
        """Launch the decision whether another linearisation follows."""
        system, options, counts = self._system, self._stepper.integrator, self._counts[:3]
        system.ranks.max(self._sizes.flatten())
        self._going.zero_()
        inputs = [self._sizes, self._contact.iterations, system.solver.status, options.tolerance, options.iterations]
        wp.launch(kernels.judge_increments, system.worlds, inputs, [*counts, self._going], device=system.device)

    def _launch(self, kernel: wp.Kernel, inputs: list, outputs: list) -> None:
        wp.launch(kernel, len(outputs[0]), inputs, outputs, device=self._system.device)
