"""Gradients of runs of time steps, forwards and backwards."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.body.soft_body import SoftBody
from warp_corot.contact.options import Contact
from warp_corot.contact.shapes import Shape
from warp_corot.discretization.sizes import padded
from warp_corot.elasticity import Corotated, Model
from warp_corot.errors import InputError, UnstableError
from warp_corot.inputs.checks import checked_count, refuse_tape, shown
from warp_corot.inputs.simulation_lock import under_lock
from warp_corot.kernels.gradients import steps as kernels
from warp_corot.kernels.implicit import steps as rows
from warp_corot.kernels.stepping.stability import add_scaled
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
from .parameters import Derivatives, StepSums
from .static import bound, friction_of

Array = npt.NDArray[np.float64]


class Seen:
    """The sum of an objective's values after some of the steps of a run.

    Args:
        body, objective: The body, and the function of its positions.
        steps: Number of steps.
        every: The objective is seen after each of this number of steps; None: at the end.

    Attributes:
        marks: The numbers of the steps after which it is seen.
        value: The sum so far.
    """

    def __init__(self, body: SoftBody, objective: Objective, steps: int, every: int | None):
        self.body, self._objective, self.steps, self.value = body, objective, steps, 0.0
        self.marks = {steps} if every is None else {*range(checked_count(every, "every", least=1), steps + 1, every)}
        if not self.marks:
            raise InputError(f"every is {every}; the run has {steps} steps")

    def derivative(self, step: int, u: wp.array) -> Array:
        """The derivative at displacements u after a step, [worlds * N, 3], whose value is added to the sum; zero if it
        is not seen there."""
        if step not in self.marks:
            return np.zeros((self.body.sizes.nodes, 3))
        positions = self.body.rest_positions + u.numpy()[: self.body.sizes.nodes, :3]
        on_device = wp.array(positions, dtype=wp.vec3, device=self.body.device)
        value, derivative = value_and_derivative(self._objective, on_device)
        self.value += value
        return derivative


class ExplicitRun:
    """Steps of symplectic Euler of one body, from its present state.

    Only states at the beginnings of segments are kept. The other states of a segment are computed again when it is run
    backwards. So there are two runs forwards in all, and memory for the states of one segment and for one state of each
    segment: about sqrt(steps) each.

    Args:
        sums: The sums over steps, of a body and its elastic forces.
        seen: The objective.
        integrator: The integrator, with a given step.
        gravity: [m/s^2].

    Attributes:
        kept: The largest number of states in memory.
    """

    def __init__(self, sums: StepSums, seen: Seen, integrator: SymplecticEuler, gravity: Sequence[float]):
        self.body, self.field, self.sums, self._seen = sums.body, sums.field, sums, seen
        length = math.isqrt(seen.steps - 1) + 1
        self._ends = sorted({*range(length, seen.steps, length), *seen.marks, seen.steps})
        self._lengths = np.diff([0, *self._ends]).tolist()
        self.kept = len(self._ends) + 1 + max(self._lengths)
        assert integrator.dt is not None
        self._dt, self._damped = integrator.dt, 1.0 / (1.0 + integrator.dt * integrator.damping)
        self._gravity, self._tangent = wp.vec3(*gravity), self.field.tangent(exact=True)
        state = self.body.state
        self._u, self._v = wp.clone(state.displacements), wp.clone(state.velocities)
        self._of_u, self._of_v, self._p, self._product, self._f = (wp.zeros_like(self._u) for _ in range(5))
        self._states = [wp.zeros_like(self._u) for _ in range(max(self._lengths))]
        self._replays = Replays(self.body.device)
        self._tangent.prepare(self._u)

    def adjoint(self) -> tuple[Array, Array]:
        """The adjoints of displacements and velocities at the beginning, [worlds * N, 3]; the body is left at the end
        of the run."""
        begins = []
        for length in self._lengths:
            begins.append((wp.clone(self._u), wp.clone(self._v)))
            self._replays.launch(("forward", length), partial(self._forward, length))
        state, count = self.body.state, self.body.sizes.nodes
        wp.copy(state.displacements, self._u)
        wp.copy(state.velocities, self._v)
        state.publish_positions()
        self.sums.clear()
        check_finite(self.body)
        ends = [*(u for u, _ in begins[1:]), wp.clone(self._u)]
        for end, length, begin, after in reversed(list(zip(self._ends, self._lengths, begins, ends, strict=True))):
            added = self._of_u.numpy()[:count, :3] + self._seen.derivative(end, after)
            self._of_u[:count].assign(padded(added))
            wp.copy(self._u, begin[0])
            wp.copy(self._v, begin[1])
            self._replays.launch(("forward", length), partial(self._forward, length))
            self._replays.launch(("backward", length), partial(self._backward, length))
        of_u, of_v = (a.numpy()[:count, :3].astype(np.float64) for a in (self._of_u, self._of_v))
        return of_u, of_v

    def _forward(self, length: int) -> None:
        conditions = self.body.conditions
        inputs = [self._dt, self._damped, self._gravity, conditions.inverse_mass, self.sums.loads]
        for step in range(length):
            wp.copy(self._states[step], self._u)
            self.field.add_forces(self._u, self._f)
            self._launch(kernels.take_explicit_step, inputs, [self._f, self._u, self._v])

    def _backward(self, length: int) -> None:
        inputs = [self._dt, self._damped, self.body.conditions.inverse_mass, self._of_u]
        for step in reversed(range(length)):
            u = self._states[step]
            self._launch(kernels.begin_explicit_adjoint, inputs, [self._of_v, self.sums.of_loads, self._p])
            self.sums.add(u, self._p)
            self._product.zero_()
            self._tangent.take(u)
            self._tangent.add_product(self._p, self._product)
            self._launch(add_scaled, [-1.0, self._product], [self._of_u])

    def _launch(self, kernel: wp.Kernel, inputs: list, outputs: list) -> None:
        wp.launch(kernel, self.body.sizes.launch_nodes, inputs, outputs, device=self.body.device)


class ImplicitRun:
    """Implicit steps of one body, of which all displacements are kept.

    A step finds its increment d at the stage u + d from M (A0 d + A1 v + A2 h1 + A3 h2) + damping M (R0 d + R1 v + …) =
    f(u + d) + loads, and leaves u + d / share and sums of d, v, h1 and h2; see ``kernels.implicit.steps``.

    Args:
        sums: The sums over steps, of a body and its elastic forces.
        seen: The objective.
        sim: The simulation that makes the steps.
        obstacles: Number of obstacles.
        tolerance: Tolerance of the adjoint solves.

    Attributes:
        kept: The largest number of states in memory.
        of_obstacles: The derivative with respect to the places of the obstacles, [obstacles, 3].
    """

    def __init__(self, sums: StepSums, seen: Seen, sim: Simulation, obstacles: int, tolerance: float):
        self.body, self.sums, self._seen, self._sim, self.kept = sums.body, sums, seen, sim, seen.steps + 1
        self.of_obstacles = np.zeros((obstacles, 3))
        scheme = sim.integrator
        assert isinstance(scheme, ImplicitIntegrator)
        self._adjoint = Adjoint(self.body, sums.field, scheme.preconditioner, tolerance)
        self._dt, self._damping = scheme.dt, scheme.damping
        self._tables = [np.asarray(table(scheme.dt), np.float64) for table in (scheme.start, scheme.scheme)]
        self._held = self.body.conditions.held_mask()[:, None]
        self._masses = self.body.masses[:, None]
        self._of_u, *self._of_made = (np.zeros((self.body.sizes.nodes, 3)) for _ in range(4))

    def adjoint(self) -> tuple[Array, Array]:
        """As ``ExplicitRun.adjoint``."""
        body, sim, steps = self.body, self._sim, self._seen.steps
        states, contacts, friction = [wp.clone(body.state.displacements)], [], [0.0] * len(self.of_obstacles)
        for _ in range(steps):
            sim.step()
            states.append(wp.clone(body.state.displacements))
            if sim.contact is not None:
                contacts.append(RestingContact(body, sim.contact, rows_after(body, sim.contact), friction))
        check_finite(body)
        for step in reversed(range(steps)):
            self._of_u = self._of_u + self._seen.derivative(step + 1, states[step + 1])
            contact = contacts[step] if contacts and contacts[step].pushes else None
            self._backward(self._tables[min(step, 1)], states[step], states[step + 1], contact)
        return self._of_u, self._of_made[0]

    def _backward(self, table: Array, begin: wp.array, end: wp.array, contact: RestingContact | None) -> None:
        """Run a step of this scheme backwards."""
        stage_share = table[int(rows.STAGE), 0]
        before, after = (u.numpy()[:, :3].astype(np.float64) for u in (begin, end))
        stage = wp.array(padded(before + stage_share * (after - before)), dtype=wp.vec4, device=self.body.device)
        inertia = table[int(rows.ACCELERATION)] + self._damping * table[int(rows.RATE)]
        # The parts of d, v, h1 and h2 in the adjoints of v, h1 and h2 after the step.
        made = np.array([table[int(row)] for row in (rows.VELOCITY, rows.FIRST, rows.SECOND)])
        parts = np.einsum("rc,rni->cni", made, np.array(self._of_made))
        self._adjoint.contact = contact
        self._adjoint.take(stage, inertia[0])
        motion, product = self._adjoint.solve(np.where(self._held, 0.0, self._of_u / stage_share + parts[0]))
        p = motion.numpy()[:, :3].astype(np.float64)
        if contact is not None:
            self.of_obstacles = self.of_obstacles + contact.of_obstacles(p, self._adjoint.multipliers)
        parts = np.where(self._held, 0.0, parts - inertia[: len(parts), None, None] * self._masses * p)
        # Held nodes keep their velocity and move with it; at the stage they have made the stage's fraction of that
        # motion.
        moved = self._of_made[0] + self._dt * (self._of_u - stage_share * product)
        self._of_made = [parts[1] + np.where(self._held, moved, 0.0), parts[2], parts[3]]
        self._of_u = self._of_u - product
        self.sums.add(stage, motion)
        added = wp.array(padded(self.sums.of_loads.numpy()[:, :3] + p), dtype=wp.vec4, device=self.body.device)
        wp.copy(self.sums.of_loads, added)


#: Names of the derivatives of runs.
NAMES = (
    *("young", "poisson", "density", "loads", "gravity", "rest", "activation"),
    *("displacements", "velocities", "obstacles"),
)


@dataclass(frozen=True, kw_only=True)
class RunGradient(Derivatives):
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
    displacements: Array | None = None
    velocities: Array | None = None


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
    sums, seen = StepSums(body, field, names), Seen(body, objective, steps, every)
    run: ExplicitRun | ImplicitRun
    if isinstance(integrator, SymplecticEuler):
        run = ExplicitRun(sums, seen, integrator, down)
    else:
        sim = Simulation(body, model=law, integrator=integrator, gravity=down, obstacles=things, contact=contact)
        run = ImplicitRun(sums, seen, sim, len(things), adjoint_tolerance)
    of_u, of_v = run.adjoint()
    of_obstacles = run.of_obstacles if isinstance(run, ImplicitRun) else np.zeros((len(things), 3))
    found = sums.derivatives(boundary=of_u, displacements=of_u, velocities=of_v, obstacles=of_obstacles)
    return RunGradient(value=seen.value, kept=run.kept, **{name: found[name] for name in names})


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
