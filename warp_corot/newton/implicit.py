"""Implicit steps of a Newton model; see ``kernels.newton.implicit``."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import warp as wp

from warp_corot.errors import InputError
from warp_corot.kernels.implicit import conjugate_gradients
from warp_corot.kernels.implicit.tangent import add_vectors
from warp_corot.kernels.newton import implicit as kernels
from warp_corot.solvers.implicit.conjugate_gradients import ConjugateGradients
from warp_corot.solvers.implicit.line_search import LineSearch

from .arguments import Step
from .contact import KINEMATIC, Contacts
from .library import newton
from .links import LinkForces
from .others import Others
from .state import NAMESPACE
from .step_operator import StepOperator
from .steps import RUNAWAY, Steps
from .tetrahedra import Tetrahedra
from .turning import TurnedPieces
from .unknowns import Unknowns

#: Residual of the linear solve over its right side.
TOLERANCE = 1e-4
#: The most iterations of a linear solve.
ITERATIONS = 1000
#: The most linear solves of a step; from one to the next, contacts open, close and slide.
ROUNDS = 16
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
        self._unknowns = Unknowns(model)
        self._links = LinkForces(model, contacts, self._unknowns)
        self._turned = TurnedPieces(model, tetrahedra, self._unknowns)
        self._operator = StepOperator(model, tetrahedra, self._unknowns, self._links)
        count = len(self._unknowns)
        self._b, self._d, self._r, self._rest, self._product, self._change = (
            wp.zeros(count, dtype=wp.vec4, device=self.device) for _ in range(6)
        )
        self._still = wp.zeros(model.particle_count, dtype=wp.vec3, device=self.device)
        self._solver = ConjugateGradients(self._operator, count, most=ITERATIONS)
        self._solver.tolerance.fill_(TOLERANCE)
        self._search = LineSearch(self._unknowns.worlds, self._unknowns.count, self._links, self.device)
        self._rounds, self._going = (wp.zeros(1, dtype=wp.int32, device=self.device) for _ in range(2))
        self._iterations = wp.zeros(self._unknowns.worlds, dtype=wp.int32, device=self.device)

    def _launch_forces(self, substep: Step, given: newton.State, share: float, done: float) -> None:
        model, others, control = self.model, self.others, substep.control
        activation = model.tet_activations
        if control is not None and control.tet_activations is not None:
            activation = control.tet_activations
        now: Any = substep.state_in
        self._turned.launch(now, substep.dt)
        # Viscous forces are those of the velocities after the step, which the solve finds.
        at_rest: Any = SimpleNamespace(particle_q=self._turned.positions, particle_qd=self._still)
        setattr(at_rest, NAMESPACE, getattr(now, NAMESPACE, None))
        self.tetrahedra.add_forces(at_rest, activation, self._f)
        of_bodies = self._bodies_after(done, substep, given)
        self._links.begin(substep, of_bodies)
        self._launch_unknowns(substep, of_bodies, given)
        self._solve()
        self._links.report(substep.reported, self.contacts.reactions, share)
        if others.has_bodies:
            wp.copy(self._body_f, given.body_f)
            self._add_wrenches(1.0, self._body_f)
        elif model.body_count:
            self._add_wrenches(share, given.body_f)

    def _launch_unknowns(self, substep: Step, of_bodies: newton.State, given: newton.State) -> None:
        """Launch the right side, the inertia, the first motions and a guess of their change."""
        model, now, dt, operator = self.model, substep.state_in, substep.dt, self._operator
        outputs = [operator.free, operator.inertia, self._b, self._d, self._change]
        inputs = [dt, self.damping, model.gravity, model.particle_inv_mass, model.particle_flags]
        inputs += [model.particle_world, self._f, now.particle_qd, self.report.trouble, self._unknowns.particle]
        self._launch(kernels.begin_particles, model.particle_count, inputs, outputs)
        if model.body_count:
            inputs = [dt, KINEMATIC, model.body_flags, model.body_world, model.gravity, model.body_inv_mass]
            inputs += [model.body_inv_inertia, model.body_inertia, of_bodies.body_q, of_bodies.body_qd, given.body_f]
            inputs += [int(self.others.has_bodies), self.report.trouble, self._unknowns.body]
            self._launch(kernels.begin_bodies, model.body_count, inputs, outputs)
        operator.take(now.particle_q, self._turned.positions, dt)
        operator.add_product(self._turned.way, self._b)

    def _solve(self) -> None:
        """Launch linear solves until contacts no longer change."""
        self._iterations.zero_()
        self._rounds.zero_()
        if self._links.count:
            self._going.fill_(1)
            wp.capture_while(self._going, self._round)
        else:
            self._round()
        inputs = [self._iterations, self._rounds, self._solver.status, int(conjugate_gradients.CONVERGED)]
        wp.launch(kernels.count_solves, 1, inputs, [self.totals], device=self.device)

    def _round(self) -> None:
        """Launch a solve for a better d, with links as they are at d."""
        operator, links, count = self._operator, self._links, len(self._unknowns)
        links.update(self._d)
        operator.update()
        operator.apply(self._d, self._product, linked=False)
        self._rest.zero_()
        self._launch(kernels.find_residual, count, [operator.free, self._b, self._product], [self._rest])
        self._r.zero_()
        links.add_forces(self._r)
        self._launch(kernels.find_residual, count, [operator.free, self._b, self._product], [self._r])
        self._solver.launch(operator.preconditioner, self._r, self._change, guessed=True, like=self._b)
        if links.count:
            operator.apply(self._change, self._product, linked=False)
            self._search.launch(self._rest, self._product, self._change, self._d)
        else:
            self._launch(add_vectors, count, [self._change], [self._d])
        self._change.zero_()
        links.update(self._d)
        inputs = [self._solver.iterations, ROUNDS]
        outputs = [self._rounds, self._iterations, self._going]
        wp.launch(kernels.judge_round, 1, inputs, outputs, device=self.device)

    def _launch_motion(self, substep: Step, fastest: float) -> None:
        model, others = self.model, self.others
        now, out, dt = substep.state_in, substep.state_out, substep.dt
        inputs = [dt, model.particle_max_velocity, min(fastest, RUNAWAY), model.particle_inv_mass]
        inputs += [model.particle_flags, model.particle_world, self._unknowns.particle, self._d]
        outputs = [out.particle_q, out.particle_qd, self.report.trouble]
        self._launch(kernels.move_particles, model.particle_count, [*inputs, now.particle_q, now.particle_qd], outputs)
        if others.has_bodies:
            count = math.ceil(dt / RIGID_STEP) if others.is_own else 1
            part = substep._replace(dt=dt / count)
            for _ in range(count):
                others.step(part, self._body_f)
                part = part._replace(state_in=out)
            self._check_bodies(out)
