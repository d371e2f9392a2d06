"""Gradients of runs of time steps, forwards and backwards."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.body.soft_body import SoftBody
from warp_corot.contact.options import Contact
from warp_corot.contact.shapes import Shape
from warp_corot.discretization.sizes import padded
from warp_corot.elasticity import Corotated, ForceField, Model
from warp_corot.errors import InputError, UnstableError
from warp_corot.inputs.checks import checked_count, refuse_tape, shown
from warp_corot.inputs.simulation_lock import under_lock
from warp_corot.kernels.gradients import steps as kernels
from warp_corot.kernels.implicit import steps as rows
from warp_corot.simulation.parts import checked_gravity, checked_models
from warp_corot.simulation.resting import checked_obstacles
from warp_corot.simulation.simulation import Simulation
from warp_corot.solvers import BackwardEuler, QuasiStatic, SymplecticEuler
from warp_corot.solvers.implicit.schemes import ImplicitIntegrator
from warp_corot.solvers.recorded import Replays
from warp_corot.solvers.system import Integrator

from . import parameters
from .adjoint import Adjoint
from .contact import RestingContact, rows_after
from .objective import Objective, value_and_derivative
from .parameters import StepSums
from .static import bound, friction_of


class ExplicitRun:
    """Steps of symplectic Euler of one body, from its present state.

    Only states at the beginnings of segments are kept. The other states of a segment are computed again when it is run
    backwards. So there are two runs forwards in all, and memory for the states of one segment and for one state of each
    segment.

    Args:
        body, field: The body and its elastic forces.
        integrator: The integrator, with a given step.
        gravity: [m/s^2].
        sums: The sums over steps.
        ends: The numbers of steps at which segments end, increasing; the last one is the end of the run.

    Attributes:
        displacements, velocities: At the beginning, and at each of the ends, vec4 each.
        of_displacements, of_velocities: The adjoint of the state that the run backwards has reached, vec4.
    """

    def __init__(
        self,
        body: SoftBody,
        field: ForceField,
        integrator: SymplecticEuler,
        gravity: Sequence[float],
        sums: StepSums,
        ends: Sequence[int],
    ):
        self.body, self.field, self.sums, self.device = body, field, sums, body.device
        self.lengths = np.diff([0, *ends]).tolist()
        assert integrator.dt is not None
        self._dt, self._damped = integrator.dt, 1.0 / (1.0 + integrator.dt * integrator.damping)
        self._gravity, self._tangent = wp.vec3(*gravity), field.tangent(exact=True)
        state = body.state
        self._u, self._v = wp.clone(state.displacements), wp.clone(state.velocities)
        self.of_displacements, self.of_velocities, self._p, self._product, self._f = (
            wp.zeros_like(self._u) for _ in range(5)
        )
        self._kept = [wp.zeros_like(self._u) for _ in range(max(self.lengths))]
        self.displacements, self.velocities = [wp.clone(self._u)], [wp.clone(self._v)]
        self._replays = Replays(self.device)
        self._tangent.prepare(self._u)

    def forward(self) -> None:
        """Run to the end, and leave the body in that state."""
        for length in self.lengths:
            self._replays.launch(("forward", length), partial(self._forward, length))
            self.displacements.append(wp.clone(self._u))
            self.velocities.append(wp.clone(self._v))
        state = self.body.state
        wp.copy(state.displacements, self._u)
        wp.copy(state.velocities, self._v)
        state.publish_positions()

    def backward(self, segment: int) -> None:
        """Run a segment backwards, after the segments that follow it."""
        length = self.lengths[segment]
        wp.copy(self._u, self.displacements[segment])
        wp.copy(self._v, self.velocities[segment])
        self._replays.launch(("forward", length), partial(self._forward, length))
        self._replays.launch(("backward", length), partial(self._backward, length))

    def _forward(self, length: int) -> None:
        conditions = self.body.conditions
        inputs = [self._dt, self._damped, self._gravity, conditions.inverse_mass, self.sums.loads]
        for step in range(length):
            wp.copy(self._kept[step], self._u)
            self.field.add_forces(self._u, self._f)
            self._launch(kernels.take_explicit_step, inputs, [self._f, self._u, self._v])

    def _backward(self, length: int) -> None:
        inputs = [self._dt, self._damped, self.body.conditions.inverse_mass, self.of_displacements]
        outputs = [self.of_velocities, self.sums.of_loads, self._p]
        for step in reversed(range(length)):
            u = self._kept[step]
            self._launch(kernels.begin_explicit_adjoint, inputs, outputs)
            self.sums.add(u, self._p)
            self._product.zero_()
            self._tangent.take(u)
            self._tangent.add_product(self._p, self._product)
            self._launch(kernels.subtract, [self._product], [self.of_displacements])

    def _launch(self, kernel: wp.Kernel, inputs: list, outputs: list) -> None:
        wp.launch(kernel, self.body.sizes.launch_nodes, inputs, outputs, device=self.device)


Array = npt.NDArray[np.float64]


class ImplicitRun:
    """The adjoints of implicit steps of one body.

    A step finds its increment d at the stage u + d from M (A0 d + A1 v + A2 h1 + A3 h2) + damping M (R0 d + R1 v + …) =
    f(u + d) + loads, and leaves u + d / share and sums of d, v, h1 and h2; see ``kernels.implicit.steps``.

    Args:
        body, field: The body and its elastic forces.
        integrator: The integrator of the steps.
        sums: The sums over steps.
        displacements: The displacements before the first step and after each step, vec4.
        tolerance: Tolerance of the adjoint solves.
        contacts: What obstacles have pushed in each step, if there are any obstacles.

    Attributes:
        of_obstacles: The derivative with respect to the places of the obstacles, or 0.
        of_displacements, of_velocities: The adjoint of the state that the run backwards has reached, float64
            [worlds * N, 3].
    """

    def __init__(
        self,
        body: SoftBody,
        field: ForceField,
        integrator: ImplicitIntegrator,
        sums: StepSums,
        displacements: list[wp.array],
        tolerance: float,
        contacts: Sequence[RestingContact] = (),
    ):
        self._contacts, self.of_obstacles = contacts, np.zeros(1)
        self.body, self.sums, self.displacements = body, sums, displacements
        self._adjoint = Adjoint(body, field, integrator.preconditioner, tolerance)
        self._dt, self._damping = integrator.dt, integrator.damping
        self._tables = [np.asarray(table(integrator.dt), np.float64) for table in (integrator.start, integrator.scheme)]
        self._held = body.conditions.held_mask()[:, None]
        self._masses = body.masses[:, None]
        self.of_displacements, self.of_velocities, self._of_first, self._of_second = (
            np.zeros((body.sizes.nodes, 3)) for _ in range(4)
        )

    def backward(self, step: int) -> None:
        """Run a step backwards, 0 for the first one, after the steps that follow it."""
        table = self._tables[min(step, 1)]
        stage_share = table[int(rows.STAGE), 0]
        before, after = (self.displacements[k].numpy()[:, :3].astype(np.float64) for k in (step, step + 1))
        stage = wp.array(padded(before + stage_share * (after - before)), dtype=wp.vec4, device=self.body.device)
        inertia = table[int(rows.ACCELERATION)] + self._damping * table[int(rows.RATE)]
        made = [table[int(row)] for row in (rows.VELOCITY, rows.FIRST, rows.SECOND)]
        of_made = (self.of_velocities, self._of_first, self._of_second)
        right = self.of_displacements / stage_share + sum(row[0] * of for row, of in zip(made, of_made, strict=True))
        contact = self._contacts[step] if self._contacts and self._contacts[step].pushes else None
        self._adjoint.keep_to(contact)
        self._adjoint.take(stage, inertia[0])
        motion, product = self._adjoint.solve(np.where(self._held, 0.0, right))
        p = motion.numpy()[:, :3].astype(np.float64)
        if contact is not None:
            self.of_obstacles = self.of_obstacles + contact.of_obstacles(p, self._adjoint.multipliers)
        of_u = self.of_displacements - product
        # Held nodes keep their velocity and move with it; at the stage they have made the stage's fraction of that
        # motion.
        moved = self._dt * (self.of_displacements - stage_share * product)
        of_v = np.where(self._held, self.of_velocities + moved, 0.0)
        parts = []
        for column in (1, 2, 3):
            part = sum(row[column] * of for row, of in zip(made, of_made, strict=True))
            parts.append(np.where(self._held, 0.0, part - inertia[column] * self._masses * p))
        self.of_displacements, self.of_velocities = of_u, of_v + parts[0]
        self._of_first, self._of_second = parts[1], parts[2]
        self.sums.add(stage, motion)
        added = wp.array(padded(self.sums.of_loads.numpy()[:, :3] + p), dtype=wp.vec4, device=self.body.device)
        wp.copy(self.sums.of_loads, added)


#: Names of the derivatives of runs.
NAMES = (
    *("young", "poisson", "density", "loads", "gravity", "rest", "activation"),
    *("displacements", "velocities", "obstacles"),
)


@dataclass(frozen=True)
class RunGradient:
    """The result of ``run_gradient``. Derivatives are float64; those that were not requested are None.

    ``gradient["young"]`` is ``gradient.young``.

    Attributes:
        value: The objective J, or the sum of its values.
        kept: The largest number of states of the body in memory at the same time.
        young, poisson, density, activation, gravity: As ``StaticGradient`` has them.
        loads: dJ/df of each node's load, which is the same in all steps [1/N], [worlds * N, 3].
        rest: dJ/dX of each node's rest position [1/m], [worlds * N, 3]. Displacements at the beginning, elements'
            materials and the directions of fibres stay as they are.
        displacements, velocities: dJ/du [1/m] and dJ/dv [s/m] of the state at the beginning, [worlds * N, 3].
        obstacles: dJ/dp of each obstacle's place, the same in all steps [1/m], [obstacles, 3].
    """

    value: float
    kept: int
    young: Array | float | None = None
    poisson: Array | float | None = None
    density: Array | float | None = None
    loads: Array | None = None
    gravity: Array | None = None
    rest: Array | None = None
    activation: Array | None = None
    displacements: Array | None = None
    velocities: Array | None = None
    obstacles: Array | None = None

    def __getitem__(self, name: str) -> Any:
        return parameters.requested(self, name, NAMES)


@under_lock
def run_gradient(
    body: SoftBody,
    objective: Objective,
    *,
    integrator: Integrator,
    steps: int,
    wrt: str | Sequence[str] = ("young",),
    model: Model | None = None,
    gravity: npt.ArrayLike | None = None,
    every: int | None = None,
    adjoint_tolerance: float = 1e-6,
    obstacles: Shape | Sequence[Shape] = (),
    contact: Contact | None = None,
) -> RunGradient:
    """The derivatives of an objective of a body's positions after time steps, by running the adjoint of the steps
    backwards.

    The body makes ``steps`` steps from its present state, as in a ``Simulation`` of this body alone. Explicit runs keep
    about sqrt(steps) states and compute those between again; implicit ones keep all displacements.

    Args:
        body: The body. Its held nodes keep their velocities.
        objective: As for ``static_gradient``, a function of the positions at the end.
        integrator: ``SymplecticEuler(dt)`` with a given step, or an implicit one with a tolerance of Newton's method,
            which then is the accuracy of gradients; without viscosity.
        steps: The number of steps.
        wrt: Names of derivatives of ``RunGradient``.
        model, gravity: As for ``Simulation``.
        every: J is the sum of the objective's values after each of this number of steps; None: the value at the end.
        adjoint_tolerance: Tolerance of the linear solve of each implicit step backwards.
        obstacles, contact: Shapes at rest that the body touches at its nodes without friction, in steps of
            ``BackwardEuler``. The gradient is that of the nodes that are touched in each step: it jumps where one more
            or less is.

    Raises:
        InputError: As ``static_gradient``, or the integrator is not one of these, the body is remeshed, nodes or active
            stress follow keyframes, or obstacles touch something else than nodes.
        UnstableError: The run does not stay finite.
        ConvergenceError: An adjoint solve does not converge.
    """
    refuse_tape()
    names = _checked(body, integrator, steps, wrt)
    things = _checked_contact(integrator, obstacles, contact)
    (law,) = checked_models(Corotated() if model is None else model, 1)
    field, _needs = bound(body, law, [name for name in names if name in parameters.NEEDS])
    if field.elapsed is not None:
        raise InputError(
            f"forces of {type(law).__name__} depend on what happened before; runs with gradients have none"
        )
    down = checked_gravity(gravity, body.mesh.up_axis)
    body.state.adopt_positions()
    sums = StepSums(body, field, names)
    marks = {steps} if every is None else {*range(checked_count(every, "every", least=1), steps + 1, every)}
    if not marks:
        raise InputError(f"every is {every}; the run has {steps} steps")
    given = _Run(sums, steps, marks, down, _Values(body, objective))
    of_obstacles = np.zeros((len(things), 3))
    if isinstance(integrator, SymplecticEuler):
        kept, of_u, of_v = _explicit(given, integrator)
    else:
        assert isinstance(integrator, ImplicitIntegrator)
        sim = Simulation(body, model=law, integrator=integrator, gravity=down, obstacles=things, contact=contact)
        run = _implicit(given, integrator, sim, len(things), adjoint_tolerance)
        kept, of_u, of_v = steps + 1, run.of_displacements, run.of_velocities
        of_obstacles = of_obstacles + run.of_obstacles
    found = sums.derivatives() | {"displacements": of_u, "velocities": of_v, "obstacles": of_obstacles}
    if "rest" in names:
        found["rest"] = found["rest"] + of_u
    return RunGradient(given.seen.value, kept, **{name: found[name] for name in names})


class _Run(NamedTuple):
    """What both kinds of steps need: the sums, the number of steps, the steps after which the objective is seen,
    gravity, and the objective's values."""

    sums: StepSums
    steps: int
    marks: set[int]
    gravity: tuple[float, float, float]
    seen: _Values


def _explicit(given: _Run, integrator: SymplecticEuler) -> tuple[int, Array, Array]:
    """The number of kept states, and the adjoint of the beginning."""
    sums, steps, marks, gravity, seen = given
    body, length = sums.body, math.isqrt(steps - 1) + 1
    ends = sorted({*range(length, steps, length), *marks, steps})
    run = ExplicitRun(body, sums.field, integrator, gravity, sums, ends)
    run.forward()
    sums.clear()
    check_finite(body)
    count = body.sizes.nodes
    for segment in reversed(range(len(ends))):
        if ends[segment] in marks:
            added = run.of_displacements.numpy()[:count, :3] + seen.derivative(run.displacements[segment + 1])
            run.of_displacements[:count].assign(padded(added))
        run.backward(segment)
    of_u, of_v = (a.numpy()[:count, :3].astype(np.float64) for a in (run.of_displacements, run.of_velocities))
    return len(run.displacements) + max(run.lengths), of_u, of_v


def _implicit(
    given: _Run, integrator: ImplicitIntegrator, sim: Simulation, obstacles: int, tolerance: float
) -> ImplicitRun:
    """The run backwards of implicit steps, at the beginning."""
    sums, body = given.sums, given.sums.body
    states, contacts, friction = [wp.clone(body.state.displacements)], [], [0.0] * obstacles
    for _ in range(given.steps):
        sim.step()
        states.append(wp.clone(body.state.displacements))
        if sim.contact is not None:
            contacts.append(RestingContact(body, sim.contact, rows_after(body, sim.contact), friction))
    check_finite(body)
    run = ImplicitRun(body, sums.field, integrator, sums, states, tolerance, contacts)
    for step in reversed(range(given.steps)):
        if step + 1 in given.marks:
            run.of_displacements = run.of_displacements + given.seen.derivative(states[step + 1])
        run.backward(step)
    return run


class _Values:
    """The sum of an objective's values."""

    def __init__(self, body: SoftBody, objective: Objective):
        self.body, self.objective, self.value = body, objective, 0.0

    def derivative(self, u: wp.array) -> Array:
        """The derivative at displacements u, [worlds * N, 3]; the value is added to the sum."""
        positions = self.body.rest_positions + u.numpy()[: self.body.sizes.nodes, :3]
        on_device = wp.array(positions, dtype=wp.vec3, device=self.body.device)
        value, derivative = value_and_derivative(self.objective, on_device)
        self.value += value
        return derivative


def check_finite(body: SoftBody) -> None:
    """Check that a run has stayed finite.

    Raises:
        UnstableError: It has not.
    """
    if not np.isfinite(body.state.displacements.numpy()[: body.sizes.nodes]).all():
        raise UnstableError("the run does not stay finite; take shorter steps")


def _checked_contact(
    integrator: Integrator, obstacles: Shape | Sequence[Shape], contact: Contact | None
) -> tuple[Shape, ...]:
    """The obstacles of a run.

    Raises:
        InputError: Their contact has no gradient.
    """
    things = checked_obstacles(obstacles)
    if contact is not None or things:
        if not isinstance(integrator, BackwardEuler):
            raise InputError(f"integrator is {shown(integrator)}; runs with contact need BackwardEuler for gradients")
        if contact is not None and contact.self_contact:
            raise InputError("the body may touch itself; gradients of runs are of contact with obstacles only")
        if any(friction_of(things, contact)):
            raise InputError("obstacles have friction; runs with gradients need contact without: give friction=0.0")
    return things


def _checked(body: SoftBody, integrator: Integrator, steps: int, wrt: str | Sequence[str]) -> tuple[str, ...]:
    """The names of derivatives, after a check of all arguments."""
    if not isinstance(body, SoftBody):
        raise InputError(f"body is {shown(body)}; it must be a SoftBody")
    if body.changing is not None:
        raise InputError("the body is remeshed; gradients need a mesh that stays as it is")
    if body.conditions.trajectories or body.conditions.activations:
        raise InputError("nodes or active stress follow keyframes; runs with gradients have none")
    checked_count(steps, "steps", least=1)
    if isinstance(integrator, SymplecticEuler):
        if integrator.dt is None:
            raise InputError("dt of SymplecticEuler is None; for a gradient it must be a number of seconds")
    elif not isinstance(integrator, ImplicitIntegrator) or isinstance(integrator, QuasiStatic):
        raise InputError(
            f"integrator is {shown(integrator)}; it must be SymplecticEuler or an implicit one with inertia"
        )
    elif integrator.tolerance is None:
        raise InputError(
            "tolerance of the integrator is None: one iteration of Newton's method does not solve a step; give a number"
        )
    if integrator.viscosity:
        raise InputError(f"viscosity is {integrator.viscosity}; steps with gradients have none")
    return parameters.checked_names(wrt, NAMES)
