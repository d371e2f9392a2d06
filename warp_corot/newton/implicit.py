"""Implicit steps of a Newton model; see ``kernels.newton.implicit``."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import warp as wp

from warp_corot.errors import InputError
from warp_corot.kernels.implicit import conjugate_gradients
from warp_corot.kernels.implicit.tangent import add_vectors, find_rest
from warp_corot.kernels.newton import implicit as kernels
from warp_corot.solvers.implicit.block_system import BlockSystem
from warp_corot.solvers.implicit.contact_solve import ContactSolve
from warp_corot.solvers.implicit.line_search import LineSearch
from warp_corot.solvers.steps.repeated import Replays

from .arguments import Step
from .contact import KINEMATIC, Contacts
from .library import newton
from .links import RowForces
from .others import Others
from .state import NAMESPACE
from .step_operator import RowBlocks, StepOperator
from .steps import RUNAWAY, Steps
from .tetrahedra import Tetrahedra
from .turning import TurnedPieces
from .unknowns import Unknowns

#: Residual of the linear solves over their right side.
TOLERANCE = 1e-4
#: The most iterations of a linear solve.
ITERATIONS = 1000
#: The longest step of Newton's semi-implicit solver of rigid bodies [s].
RIGID_STEP = 5e-4


class ImplicitSteps(Steps):
    """Backward Euler for the tetrahedra of a model, with one linearisation of elastic forces a step.

    Contacts, attachments and the bodies that they act on are solved for together with the tetrahedra. In these solves
    only soft bodies, gravity and forces in the state act on rigid bodies; their own solver then moves them.

    Args:
        model: The model.
        tetrahedra, contacts, others: The parts of the model.
        damping: Rate of mass-proportional damping [1/s].

    Raises:
        InputError: The model has something that only explicit steps support.
    """

    def __init__(self, model: newton.Model, tetrahedra: Tetrahedra, contacts: Contacts, others: Others, damping: float):
        super().__init__(model, tetrahedra, contacts, others, damping)
        if others.has_particles:
            raise InputError(
                "the model has springs, cloth or bending edges with stiffness, or particle_contact is given; "
                "integrator='implicit' steps only tetrahedra: use integrator='explicit'"
            )
        self._unknowns = unknowns = Unknowns(model)
        count = len(unknowns)
        self._free = wp.zeros(count, dtype=wp.float32, device=self.device)
        self._rows = RowForces(model, contacts, unknowns, self._free)
        self._turned = TurnedPieces(model, tetrahedra, unknowns)
        self._operator = StepOperator(model, tetrahedra, unknowns, self._free, self._rows)
        operators: list[Any] = [self._operator]
        blocks = RowBlocks(operators[0])
        self._system = BlockSystem(operators, [blocks], contacts=[self._rows], most=ITERATIONS)
        self._system.solver.tolerance.fill_(TOLERANCE)
        self._solve = ContactSolve(self._system, [])
        self._change, self._product, self._rest, self._r = (
            wp.zeros(count, dtype=wp.vec4, device=self.device) for _ in range(4)
        )
        self._first = wp.zeros(unknowns.worlds, dtype=wp.int32, device=self.device)
        self._search = LineSearch(unknowns.worlds, unknowns.count, self._rows, self.device)
        self._still = wp.zeros(model.particle_count, dtype=wp.vec3, device=self.device)
        self._replays = Replays(self.device, loops=True)
        self._can_replay = False

    def _launch_forces(self, substep: Step, given: newton.State, share: float, done: float) -> None:
        model, others = self.model, self.others
        now: Any = substep.state_in
        self._turned.launch(now, substep.dt)
        # Viscous forces are those of the velocities after the step, which the solve finds.
        at_rest: Any = SimpleNamespace(particle_q=self._turned.positions, particle_qd=self._still)
        setattr(at_rest, NAMESPACE, getattr(now, NAMESPACE, None))
        self.tetrahedra.add_forces(at_rest, self._activation, self._f)
        of_bodies = self._bodies_after(done, substep, given)
        if self._rows.begin(substep, of_bodies):
            self._replays.forget()
        self._launch_unknowns(substep, of_bodies, given)
        self._replays.launch((substep.dt, self.contacts.law.adhesion, self._operator.damped), self._launch_solve)
        self._rows.report(substep, share)
        if others.has_bodies:
            wp.copy(self._body_f, given.body_f)
            self._add_wrenches(1.0, self._body_f)
        elif model.body_count:
            self._add_wrenches(share, given.body_f)

    def _launch_unknowns(self, substep: Step, of_bodies: newton.State, given: newton.State) -> None:
        """Launch the right side, the inertia, the first motions, and a guess of how gravity changes these."""
        model, now, dt, system = self.model, substep.state_in, substep.dt, self._system
        outputs = [self._free, self._operator.inertia, system.b, system.x, self._change]
        inputs = [dt, self.damping, model.gravity, model.particle_inv_mass, model.particle_flags]
        inputs += [model.particle_world, self._f, now.particle_qd, self.report.trouble, self._unknowns.particle]
        self._launch(kernels.begin_particles, model.particle_count, inputs, outputs)
        if model.body_count:
            inputs = [dt, KINEMATIC, model.body_flags, model.body_world, model.gravity, model.body_inv_mass]
            inputs += [model.body_inv_inertia, model.body_inertia, of_bodies.body_q, of_bodies.body_qd, given.body_f]
            inputs += [int(self.others.has_bodies), self.report.trouble, self._unknowns.body]
            self._launch(kernels.begin_bodies, model.body_count, inputs, outputs)
        self._operator.take(now.particle_q, self._turned.positions, dt)

    def _launch_solve(self) -> None:
        """Launch the solve for the motions: with the contacts that act, and then until these are the right ones."""
        operator, system, rows, x = self._operator, self._system, self._rows, self._system.x
        operator.take_diagonal()
        operator.add_product(self._turned.way, system.b)
        self._launch(kernels.clear_held, len(x), [self._free], [system.b])
        rows.launch_judgement(system.b, self._product, x)
        system.update()
        operator.apply(x, self._product)
        self._launch(find_rest, len(x), [system.b, self._product], [self._rest])
        wp.copy(self._r, self._rest)
        rows.launch_friction(x, self._r)
        system.solve(self._r, self._change, guessed=True, like=system.b)
        solver, iterations = system.solver, system.solver.iterations
        if rows.count:
            operator.apply(self._change, self._product)
            self._search.launch(self._rest, self._product, self._change, x)
            wp.copy(self._first, iterations)
            self._solve.launch()
            iterations = self._solve.iterations
            self._launch(kernels.add_counts, len(iterations), [self._first], [iterations])
            rows.launch_end(x)
        else:
            self._launch(add_vectors, len(x), [self._change], [x])
            rows.solves.zero_()
        inputs = [iterations, rows.solves, solver.status, int(conjugate_gradients.CONVERGED)]
        self._launch(kernels.count_solves, 1, inputs, [self.totals])

    def _launch_motion(self, substep: Step, fastest: float) -> None:
        model, others = self.model, self.others
        now, out, dt = substep.state_in, substep.state_out, substep.dt
        inputs = [dt, model.particle_max_velocity, min(fastest, RUNAWAY), model.particle_inv_mass]
        inputs += [model.particle_flags, model.particle_world, self._unknowns.particle, self._system.x]
        outputs = [out.particle_q, out.particle_qd, self.report.trouble]
        self._launch(kernels.move_particles, model.particle_count, [*inputs, now.particle_q, now.particle_qd], outputs)
        if others.has_bodies:
            count = math.ceil(dt / RIGID_STEP) if others.is_own else 1
            part = substep._replace(dt=dt / count)
            for _ in range(count):
                others.step(part, self._body_f)
                part = part._replace(state_in=out)
            self._check_bodies(out)
