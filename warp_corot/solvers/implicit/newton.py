"""Newton's method with a line search on the energy, as launches that can be recorded."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.kernels.implicit import newton as kernels
from warp_corot.kernels.implicit.increments import move_held
from warp_corot.kernels.implicit.residual import find_residual
from warp_corot.solvers.system import dynamics_of

from .block_system import BlockSystem
from .conjugate_gradients import WorldSums
from .tangent import TurnedState

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence


@dataclass(frozen=True)
class NewtonReport:
    """How Newton's method ended in each world.

    Attributes:
        iterations: Iterations of Newton's method, int32 [worlds].
        linear_iterations: Iterations of all its linear solves together, int32 [worlds].
        residual: Norm of the unbalanced forces over that of external and reaction forces, float64 [worlds].
        correction: The largest displacement of the last step over the largest displacement, float64 [worlds].
        status: As in ``kernels.implicit.newton``, int32 [worlds].
    """

    iterations: npt.NDArray[np.int32]
    linear_iterations: npt.NDArray[np.int32]
    residual: npt.NDArray[np.float64]
    correction: npt.NDArray[np.float64]
    status: npt.NDArray[np.int32]

    @property
    def converged(self) -> npt.NDArray[np.bool_]:
        return self.status == int(kernels.CONVERGED)

    @property
    def broken(self) -> npt.NDArray[np.bool_]:
        """Whether something was not finite at the beginning."""
        return self.status == int(kernels.BROKEN)


class Newton:
    """Minimises the energy of one body, separately in each world; see ``kernels.implicit.newton``.

    The unknown is ``increment``; ``body.state.displacements`` follow it as base + increment.

    Args:
        system: The linear system of the body, or of several ones, whose steps are solved for elsewhere. The scale a of
            an operator is that of the inertia, or larger, to shorten steps.
        number: The number of the body there.
        gravity: [m/s^2].
        tolerance: Tolerance of the residual, and of the last step; see ``NewtonReport``.
        most: Maximum number of iterations.
        others: A function that launches other forces than elastic ones to ``body.state.forces``.

    Attributes:
        operator: The body's operator.
        residual: Unbalanced forces, the body's right side in the system [N], vec4.
        forces: Room for elastic forces, zero between launches [N], vec4.
        step: The last step, the body's solution in the system [m], vec4.
        iterations, solved, status: Results of each world, as in ``NewtonReport``, int32 [worlds].
        base, increment: The two parts of displacements [m], vec4.
        inertia: The scale a of the inertia [1/s^2], float32 [1].
        share: The increment over the unknown of the operator and of ``step``, for steps with contact, float32 [1].
        is_at_stage: Whether the increment ends before the step does, so that the share is less than one.
        pull: a h, the acceleration in the inertia of a time step [m/s^2], vec4.
        external_share: The factor of loads and gravity, float32 [1].
        running: The number of worlds that are still iterated, int32 [1].
        turned: The state at which the only iteration is linearised, if that is another one than the present.
    """

    def __init__(
        self,
        system: BlockSystem,
        gravity: Sequence[float],
        *,
        number: int = 0,
        tolerance: float = 1e-6,
        most: int = 100,
        others: Callable[[], None] | None = None,
    ):
        operator = self.operator = system.operators[number]
        self.system, self.solver, self.gravity = system, system.solver, wp.vec3(*gravity)
        self.tolerance, self.most, self._others = tolerance, most, others
        self.body, self.field, self.device, self.worlds, self.ranks = (
            operator.body,
            operator.field,
            operator.device,
            operator.worlds,
            operator.ranks,
        )
        self.residual, self.step = (system.blocks.of(vector)[number] for vector in (system.b, system.x))
        self.forces, self._outer, self.base, self.increment, self.pull = (
            wp.zeros_like(self.body.state.displacements) for _ in range(5)
        )
        self._count = operator.node_count
        self._sums = WorldSums(self.worlds, self._count, kernels.COLUMNS, self.device, self.ranks)
        self._energies = wp.zeros(self.field.energy_count, dtype=wp.float64, device=self.device)
        self._scalars = wp.zeros((self.worlds, kernels.SCALARS), dtype=wp.float64, device=self.device)
        self.inertia = wp.zeros(1, dtype=wp.float32, device=self.device)
        self.share, self.is_at_stage = wp.ones(1, dtype=wp.float32, device=self.device), False
        self.turned: TurnedState | None = None
        self.external_share = wp.ones(1, dtype=wp.float32, device=self.device)
        self.iterations, self.solved, self.status, self._accepted = (
            wp.zeros(self.worlds, dtype=wp.int32, device=self.device) for _ in range(4)
        )
        self.running, self._searching = (wp.zeros(1, dtype=wp.int32, device=self.device) for _ in range(2))

    # --- launches ----------------------------------------------------------------------------------------------------

    def launch_begin(self) -> None:
        """Launch the beginning of the method in all worlds, from ``base`` and ``increment``."""
        self.running.zero_()
        outputs = [self._scalars, self.iterations, self.solved, self.status, self.running]
        wp.launch(kernels.begin_worlds, self.worlds, [], outputs, device=self.device)
        self._try_step(commits=False)

    def launch_iteration(self) -> None:
        """Launch one iteration of all worlds that run."""
        sums = self._sums
        self._launch_energies()
        self.launch_residual()
        outputs = [self._scalars, self.iterations, self.status, self.running, self.solver.tolerance]
        sums.launch_scalars(kernels.judge_residual, [wp.float64(self.tolerance), self.most], outputs)
        self.linearise()
        self.system.update()
        self.system.solve()
        self._begin_search()
        wp.capture_while(self._searching, self._launch_trial)
        self._try_step(commits=True)
        inputs = [wp.float64(self.tolerance), self.solver.status]
        sums.launch_scalars(kernels.judge_step, inputs, [self._scalars, self.status, self.running])

    def launch_only(self, linear_tolerance: wp.array) -> None:
        """Launch a single iteration in all worlds, from a guess of ``step``. If the matrix may be indefinite, worlds
        whose step goes too far begin again and iterate.

        Args:
            linear_tolerance: Tolerance of the only linear solve in each world, float64 [worlds].
        """
        self.launch_begin()
        self.launch_residual()
        self.linearise()
        self.system.update()
        wp.copy(self.solver.tolerance, linear_tolerance)
        self.system.solve(guessed=True)
        self._begin_search()
        if self.operator.tension is None:
            self._judge_only()
        self._try_step(commits=True)
        if self.operator.tension is None:
            turned, self.turned = self.turned, None
            wp.capture_while(self.running, self.launch_iteration)
            self.turned = turned
        inputs = [self._scalars, self.iterations, self.solver.status]
        wp.launch(kernels.end_only, self.worlds, inputs, [self.status], device=self.device)

    def _judge_only(self) -> None:
        """Launch the decision of which worlds begin again, since their only step goes too far."""
        self._try_step(commits=False)
        self.field.add_forces(self.body.state.displacements, self.forces)
        self.ranks.owned(self.body).clear_ghosts(self.forces)
        self._measure_step(self.forces)
        outputs = [self._scalars, self.status, self.running]
        self._sums.launch_scalars(kernels.judge_only, [self.inertia], outputs)
        self.forces.zero_()

    def _begin_search(self) -> None:
        """Launch the trial of the whole step in all worlds that run."""
        self._measure_step(self.residual)
        self._sums.take_in(int(kernels.STEP), int(kernels.REACH), most=True)
        self._searching.zero_()
        self._accepted.zero_()
        outputs = [self._scalars, self.iterations, self.solved, self.status, self.running, self._searching]
        self._sums.launch_scalars(kernels.begin_search, [self.solver.iterations], outputs)

    def _measure_step(self, forces: wp.array) -> None:
        """Launch the sums of a step, and of its product with forces."""
        inputs = [self.body.conditions.mass, forces, self._outer, self.step, self.body.state.displacements]
        columns = int(kernels.SLOPE), int(kernels.OUTER), int(kernels.INERTIA)
        self._sums.launch(kernels.measure_step, inputs, *columns)

    def launch_residual(self) -> None:
        """Launch the unbalanced forces in the present state."""
        body, sums, conditions = self.body, self._sums, self.body.conditions
        if self.turned is None:
            self.field.add_forces(body.state.displacements, self.forces)
        else:
            self.turned.launch_forces(self.forces)
        self.ranks.owned(self.body).clear_ghosts(self.forces)
        if self._others is not None:
            self._others()
        inputs = [dynamics_of(body, self.gravity, 0.0), conditions.mass, self.external_share, self.inertia, self.pull]
        inputs += [self.increment, self.forces, self.residual, self._outer]
        sums.launch(find_residual, inputs, int(kernels.SQUARE), int(kernels.REFERENCE))

    def linearise(self) -> None:
        """Launch the linearisation at the present displacements, or at ``turned``; the residual must be known."""
        if self.turned is None:
            self.operator.take(self.body.state.displacements)

    def _launch_trial(self) -> None:
        self._try_step(commits=False)
        self._launch_energies()
        inputs = [self.inertia, self.status]
        self._sums.launch_scalars(kernels.judge_trial, inputs, [self._scalars, self._accepted, self._searching])

    def _launch_energies(self) -> None:
        self._energies.zero_()
        self.field.write_potentials(self.body.state.displacements, self._energies)
        self.ranks.owned(self.body).clear_copies(self._energies)
        inputs = [self._energies, len(self._energies) // self.worlds]
        self._sums.launch(kernels.sum_energies, inputs, int(kernels.ENERGY))

    def _try_step(self, *, commits: bool) -> None:
        inputs = [self._scalars, self.base, self.step, self._count, int(commits)]
        outputs = [self.increment, self.body.state.displacements]
        wp.launch(kernels.try_step, self.worlds * self._count, inputs, outputs, device=self.device)
        self.ranks.exchange(self.operator.number, self.body.state.displacements)

    def move_held(self, *, to_end: bool) -> None:
        """Launch the motion of held nodes from the stage to the end of the step, or back, if these are not the same."""
        if not self.is_at_stage:
            return
        inputs = [self.body.conditions.inverse_mass, self.base, self.share, int(to_end)]
        outputs = [self.increment, self.body.state.displacements]
        wp.launch(move_held, len(self.step), inputs, outputs, device=self.device)

    # --- on the host -------------------------------------------------------------------------------------------------

    def report(self) -> NewtonReport:
        """The report on all worlds; waits for the device."""
        scalars = self._scalars.numpy()
        compared = scalars[:, int(kernels.COMPARED)]
        return NewtonReport(
            iterations=self.iterations.numpy(),
            linear_iterations=self.solved.numpy(),
            residual=scalars[:, int(kernels.RESIDUAL)] / np.where(compared > 0.0, compared, 1.0),
            correction=scalars[:, int(kernels.CORRECTION)],
            status=self.status.numpy(),
        )
