"""Steps of one body."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from warp_corot.elasticity.added_stress import Viscosity
from warp_corot.errors import InputError
from warp_corot.inputs.loading import load
from warp_corot.kernels.elements.added import set_elapsed
from warp_corot.kernels.implicit import steps as kernels
from warp_corot.solvers.halo import ALONE

from .block_system import BlockSystem
from .multigrid import Multigrid
from .newton import Newton
from .preconditioners import Lagged, preconditioner_of
from .tangent import TangentOperator, TurnedState

if TYPE_CHECKING:
    from .stepper import ImplicitStepper


#: The tolerance of steps of one iteration that have to be repeated, since the whole step raises the energy.
REPEATED = 1e-3


class BodySteps:
    """Steps of one body.

    Args:
        stepper: The steps of all bodies.
        k: The number of the body in the system.

    Attributes:
        history: The vectors that a step keeps for the next one, and the body's state after it, vec4 each.
        before: Velocities before the last step, for the guess of the next one, vec4; NaN before the first.
        begins: Nonzero if this is a first step, int32 [1].
        touched: What each node has touched, in schemes of second order, else empty, int32; see
            ``kernels.contact.bearing``.
        preconditioner: That of its own matrix.
        newton: Newton's method, or the residual of a linearisation.
    """

    def __init__(self, stepper: ImplicitStepper, k: int):
        self.stepper, self.k = stepper, k
        system, options = stepper.system, stepper.integrator
        self.body, self.field, self.system = system.bodies[k], system.fields[k], system
        self.device = self.body.device
        self.viscosity = Viscosity(self.body, self.field, options.viscosity) if options.viscosity else None
        touches = stepper.contact is not None
        # Contact needs a matrix that is positive definite.
        exact = options.tolerance is not None and not touches
        self.operator = TangentOperator(
            self.body, self.field, viscosity=self.viscosity, exact=exact, ranks=system.ranks, number=k
        )
        self.preconditioner = preconditioner_of(
            options.preconditioner, self.operator, short_cycles=not exact, few_digits=True
        )
        if not exact and isinstance(self.preconditioner, Multigrid):
            self.preconditioner = Lagged(self.preconditioner, self.operator, system.ranks)
        load((), self.device, self.operator.tangent.kernels)
        self.newton: Newton
        like = self.body.state.displacements
        self._none = wp.zeros(1, dtype=wp.vec4, device=self.device)
        wanted = options.history
        self._h = [wp.zeros_like(like) if number < wanted else self._none for number in range(2)]
        self._left = [wp.full_like(like, np.nan) if wanted else self._none for _ in range(2)]
        self.history = [*self._h[:wanted], *(self._left if wanted else [])]
        self.before = wp.full_like(like, np.nan)
        self.touched = wp.zeros(len(like) if wanted and touches else 0, dtype=wp.int32, device=self.device)
        self._drift, self._rates = (self._none if self.viscosity is None else wp.zeros_like(like) for _ in range(2))
        if self.viscosity is not None and options.turns:
            # Halfway through a turn, where the motion of the step has no strain.
            self.operator.frame = wp.zeros_like(like)
        self._moves = wp.zeros(1, dtype=wp.int32, device=self.device)
        self.begins = stepper.begins if stepper.couples else wp.zeros(1, dtype=wp.int32, device=self.device)
        tables = np.stack([options.scheme(options.dt), options.start(options.dt)])
        if touches:
            # The increments of a step with contact begin with zero.
            tables[:, int(kernels.STAGE), 1] = 0.0
        # Contact is that of the end of the step, so whole motions are the unknowns there.
        tables[:, int(kernels.STAGE), 2] = tables[:, int(kernels.STAGE), 0] if touches else 1.0
        self._table = wp.array(tables, dtype=wp.float32, device=self.device)

    def take_system(self, system: BlockSystem, number: int) -> None:
        """Take the linear system in which the body has this number, made for its present mesh."""
        options = self.stepper.integrator
        self.newton = Newton(
            system,
            self.system.gravity,
            number=number,
            tolerance=options.tolerance or REPEATED,
            most=options.iterations,
            others=self._add_others,
        )
        self.newton.is_at_stage = options.is_at_stage
        if options.turns and options.tolerance is None:
            # Steps are linearised where bodies will be turned.
            self.newton.turned = TurnedState(self.operator, options.dt)

    def forget(self) -> None:
        """Forget the motion before the last step, since the mesh has changed."""
        self.before.fill_(np.nan)

    def prepare(self) -> None:
        """Make everything that launches use, so that they can be recorded, before the linear system is prepared."""
        self.operator.prepare()
        if isinstance(self.preconditioner, Lagged):
            self.preconditioner.prepare()
        elif isinstance(self.preconditioner, Multigrid):
            self.preconditioner.follow()
        contact, alone = self.stepper.contact, self.system.ranks.is_alone
        if contact is not None and alone and hasattr(self.preconditioner, "follow_springs"):
            self.preconditioner.follow_springs(contact.springs(self.k))
        if self.stepper.holds and self.stepper.integrator.is_at_stage:
            raise InputError("GeneralizedAlpha supports grasps only with spectral_radius=0")
        self.operator.stiff_forces = (
            *(each for each in self.system.forces if hasattr(each, "add_stiffness")),
            *self.stepper.holds,
        )
        u = self.body.state.displacements
        self.field.elastic_forces(u)
        self.field.potentials(u)

    def launch_changes(self, offset: int) -> None:
        """Launch what is given for the ``offset``-th step since the clock was last advanced, and the test whether it is
        a first step."""
        self.body.conditions.follow_activations(self.system.pace, offset + 1)
        body, system = self.body, self.system
        body.conditions.follow_trajectories(system.pace, offset, system.support_work_of(body))
        if not self.stepper.couples:
            wp.copy(self.begins, self.stepper.sturdy)
        if not self.history:
            return
        state = self.body.state
        inputs = [self.body.conditions.inverse_mass, state.displacements, state.velocities, *self._left]
        self._launch(kernels.find_changes, inputs, [self.begins])

    def launch_end(self, offset: int, counts: list[Any], *, is_last: bool) -> None:
        """Launch the state after the step, and the count of its iterations.

        Args:
            offset: As for ``launch_changes``.
            counts: How the step's solve ended in each world or in all of them together: iterations, linear iterations
                and status, int32 [worlds] or [1], and the status of a step that is within the tolerance.
            is_last: Whether this may be the last step of a run, whose reactions a user may read.
        """
        self._end(offset, counts[2])
        if is_last or not self._can_leave_out_reactions:
            self._find_reactions()
        else:
            wp.capture_if(self._moves, self._find_reactions)
        wp.launch(kernels.count_solves, 1, counts, [self.stepper.totals], device=self.device)

    # --- pieces ------------------------------------------------------------------------------------------------------

    def launch_begin(self) -> None:
        """Launch the input of the step's solve."""
        system = self.system
        state, conditions, newton, options = (
            self.body.state,
            self.body.conditions,
            self.newton,
            self.stepper.integrator,
        )
        inputs = [self.begins, self._table, options.damping]
        outputs = [self.operator.scales, newton.inertia, newton.share]
        wp.launch(kernels.choose_scales, 1, inputs, outputs, device=self.device)
        if self.field.elapsed is not None:
            inputs = [self.begins, self._table, int(kernels.STAGE), options.dt]
            wp.launch(set_elapsed, 1, inputs, [self.field.elapsed], device=self.device)
        inputs = [self.begins, self._table, options.dt, options.damping, conditions.inverse_mass]
        inputs += [state.velocities, *self._h]
        outputs = [state.displacements, self.before, newton.base, newton.increment, newton.pull]
        outputs += [newton.step, self._drift]
        self._launch(kernels.begin_step, inputs, outputs)
        system.ranks.exchange(self.k, state.displacements)

    def _add_others(self) -> None:
        """Launch forces other than elastic ones at the stage."""
        self.stepper.add_other_forces()
        if self.viscosity is not None:
            inputs = [self.operator.scales, self.newton.increment, self._drift]
            self._launch(kernels.find_rates, inputs, [self._rates])
            self.system.ranks.exchange(self.k, self._rates)
            state, turned, frame = self.body.state, self.newton.turned, self.operator.frame
            there = state.displacements if turned is None else turned.displacements
            if frame is not None:
                self._launch(kernels.find_middle, [self.newton.base, there], [frame])
            self.viscosity.scatter(there if frame is None else frame, self._rates, state.forces)

    def _end(self, offset: int, status: wp.array) -> None:
        """Launch the state after the step, and the work of forces."""
        body, system, newton = self.body, self.system, self.newton
        state, conditions = body.state, body.conditions
        inputs = [self.begins, self._table, self.operator.node_count, status, conditions.inverse_mass]
        rests = self.stepper.integrator.settles_contact and self.stepper.contact is not None
        inputs += [newton.base, newton.increment, state.contact_forces if rests else self._none]
        inputs += [system.pace.arrays, offset]
        outputs = [state.velocities, *self._h, state.displacements, *self._left, system.bad_step, self._moves]
        self._moves.zero_()
        self._launch(kernels.end_step, inputs, outputs)
        system.ranks.exchange(self.k, state.displacements)
        self.field.complete_step(state.displacements, system.pace.arrays)
        if system.counted:
            self.stepper.add_counted_forces()
            account = system.accounts[self.k]
            self._launch(kernels.count_work, [conditions.inverse_mass, state.forces, newton.increment], [account])
        if self.stepper.holds:
            self.stepper.add_other_forces()
            for hold in self.stepper.holds:
                hold.launch_held(body)
        for account in system.constraint_accounts(self.k):
            inputs = [conditions.inverse_mass, state.contact_forces, newton.increment]
            self._launch(kernels.count_work, inputs, [account])

    @property
    def _can_leave_out_reactions(self) -> bool:
        """Whether reactions matter only at the end of a run, or if held nodes move: evaluating the forces changes
        nothing else. On CUDA the condition costs more than the forces."""
        system = self.system
        others = system.forces or system.constraints or system.counted
        return self.device.is_cpu and system.ranks is ALONE and not others and not self.field.state

    def _find_reactions(self) -> None:
        """Launch the reactions after the step, and the work of supports."""
        body, system, newton = self.body, self.system, self.newton
        state, conditions = body.state, body.conditions
        self.field.add_forces(state.displacements, newton.forces)
        self.stepper.add_other_forces()
        inputs = [system.dynamics(body, 0.0), conditions.mass, newton.forces, newton.increment]
        self._launch(kernels.count_supports, inputs, [state.reactions, system.support_work_of(body)])
        newton.forces.zero_()
        self.stepper.forget_forces()

    def _launch(self, kernel: wp.Kernel, inputs: list, outputs: list) -> None:
        wp.launch(kernel, self.body.sizes.launch_nodes, inputs, outputs, device=self.device)
