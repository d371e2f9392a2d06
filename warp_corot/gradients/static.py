"""Gradients of static answers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.body.soft_body import SoftBody
from warp_corot.contact.options import Contact
from warp_corot.contact.reading import acting_rows
from warp_corot.contact.shapes import Shape
from warp_corot.elasticity import Corotated, ForceField, Model
from warp_corot.errors import ConvergenceError, InputError
from warp_corot.inputs.checks import checked_number, shown
from warp_corot.inputs.simulation_lock import under_lock
from warp_corot.simulation.parts import checked_gravity, checked_models
from warp_corot.simulation.resting import checked_obstacles
from warp_corot.simulation.static import StaticReport, static_answer

from . import parameters
from .adjoint import Adjoint
from .contact import PreciseContact, RestingContact
from .objective import Objective, value_and_derivative
from .parameters import Derivatives, ElementWork, derivatives

Array = npt.NDArray[np.float64]


class RestState:
    """Moves a body to its state of rest, and gives gradients there as long as the body does not move.

    Args:
        body: The body; some nodes of each world must be held.
        model, gravity, preconditioner, obstacles, contact: As for ``solve_static``.
        names: Names of the possible derivatives, keys of ``parameters.NEEDS``.
        adjoint_tolerance: As for ``static_gradient``.
        options: Other arguments of ``solve_static``.

    Attributes:
        report: The report of the solve.
        law, field: The model, and its elastic forces.
        gravity: [m/s^2], float64 [3].
        obstacles: The obstacles.
        contact: What they push, or None.
        adjoint_iterations, adjoint_residual: Iterations and residual of the last adjoint solve.

    Raises:
        InputError, ConvergenceError: As ``static_gradient``.
    """

    def __init__(
        self,
        body: SoftBody,
        *,
        model: Model | None,
        gravity: npt.ArrayLike | None,
        names: Sequence[str],
        adjoint_tolerance: float = 1e-6,
        preconditioner: str | None = None,
        obstacles: Shape | Sequence[Shape] = (),
        contact: Contact | None = None,
        **options: Any,
    ):
        if not isinstance(body, SoftBody):
            raise InputError(f"body is {shown(body)}; it must be a SoftBody")
        check_held(body)
        friction = friction_of(checked_obstacles(obstacles), contact)
        if not 0.0 < checked_number(adjoint_tolerance, "adjoint_tolerance") < 1.0:
            raise InputError(f"adjoint_tolerance is {adjoint_tolerance}; it must be between 0 and 1")
        (law,) = checked_models(Corotated() if model is None else model, 1)
        self.body, self.gravity = body, np.array(checked_gravity(gravity, body.mesh.up_axis))
        self.field, needs = bound(body, law, names)
        self.field.relax_fully()
        ElementWork(self.field, needs)
        options |= {"preconditioner": preconditioner, "obstacles": obstacles, "contact": contact}
        self.report, touching = static_answer(body, model=law, gravity=gravity, **options)
        if not self.report.converged:
            raise ConvergenceError(f"there is no gradient: {self.report.message}")
        touched = None if touching is None else RestingContact(body, touching, list(acting_rows(touching)), friction)
        self.contact = touched if touched is not None and touched.pushes else None
        self.obstacles = checked_obstacles(obstacles)
        self.law, self._preconditioner, self._tolerance = law, preconditioner, adjoint_tolerance
        self._adjoint: Adjoint | None = None
        self.adjoint_iterations, self.adjoint_residual = 0, 0.0

    @property
    def positions(self) -> Array:
        """[m], float64 [worlds * N, 3]."""
        return self.body.rest_positions + self.body.state.displacements.numpy()[: self.body.sizes.nodes, :3]

    def pull_back(self, derivative: Array, names: Sequence[str]) -> dict[str, Any]:
        """Derivatives of J of these names, as in ``StaticGradient``.

        Args:
            derivative: The derivative of J with respect to positions [1/m], [worlds * N, 3].
            names: Some of the names that the state was made with.
        """
        if self._adjoint is None:
            options = (self._preconditioner, self._tolerance, self.contact)
            self._adjoint = Adjoint(self.body, self.field, *options)
            self._adjoint.take(self.body.state.displacements)
        adjoint, count = self._adjoint, self.body.sizes.nodes
        given = np.asarray(derivative, np.float64)
        if given.shape != (count, 3):
            raise InputError(f"the derivative has shape {given.shape}; it must be [{count}, 3]")
        held = self.body.conditions.held_mask()[:, None]
        motion, product = adjoint.solve(np.where(held, 0.0, given))
        boundary = np.where(held, given - product, 0.0)
        self.adjoint_iterations, self.adjoint_residual = adjoint.iterations, adjoint.residual
        moved = motion.numpy()[:count, :3].astype(np.float64)
        work = ElementWork(self.field, parameters.needed(names))
        work.add(self.body.state.displacements, motion)
        of_obstacles = np.zeros((len(self.obstacles), 3))
        if self.contact is not None:
            of_obstacles = self.contact.of_obstacles(moved, adjoint.multipliers)
        places = {"boundary": boundary, "obstacles": of_obstacles}
        return derivatives(self.body, work, names, moved, moved @ self.gravity, **places)


def bound(body: SoftBody, law: Model, names: Sequence[str]) -> tuple[ForceField, set[str]]:
    """A law's forces, and the parts of them that derivatives of these names need.

    Raises:
        InputError: The model shares rotations.
    """
    inner = law
    while isinstance(getattr(inner, "model", None), Model):
        inner = inner.model  # type: ignore[attr-defined]
    if getattr(inner, "rotation_level", None) is not None:
        raise InputError(
            "the model shares rotations, and has no exact stiffness; for gradients each element needs its own"
        )
    return law.bind(body), parameters.needed(names)


def friction_of(obstacles: Sequence[Shape], contact: Contact | None) -> list[float]:
    """The coefficient of friction of each obstacle.

    Raises:
        InputError: The body touches itself with friction.
    """
    contact = Contact() if contact is None else contact
    if not isinstance(contact, Contact):
        raise InputError(f"contact is {shown(contact)}; it must be a Contact")
    if contact.self_contact and contact.friction > 0.0:
        raise InputError(
            f"the body touches itself with friction {contact.friction:g}; gradients need that contact without: give "
            "friction=0.0"
        )
    return [contact.friction if shape.friction is None else shape.friction for shape in obstacles]


def check_held(body: SoftBody) -> None:
    """Check that each world has held nodes.

    Raises:
        InputError: A world has none.
    """
    free = np.logical_not(body.conditions.held_mask().reshape(body.worlds, -1).any(axis=1))
    if free.any():
        where = f" in world {int(np.argmax(free))}" if body.worlds > 1 else ""
        raise InputError(f"no node is held{where}; a body that may be anywhere has no gradient: fix some nodes")


FLOAT32, FLOAT64 = "float32", "float64"


def solved_state(body: SoftBody, *, precision: str = FLOAT32, model: Model | None = None, **options: Any) -> Any:
    """A ``RestState`` or a ``PreciseState`` of a body.

    Args:
        body: The body.
        precision: As for ``static_gradient``.
        model: As for ``solve_static``.
        options: Other arguments of ``RestState``.

    Raises:
        InputError, ConvergenceError: As ``static_gradient``.
    """
    if precision not in (FLOAT32, FLOAT64):
        raise InputError(f"precision is {shown(precision)}; it must be {FLOAT32!r} or {FLOAT64!r}")
    if precision == FLOAT64 and isinstance(body, SoftBody):
        from warp_corot.solvers.implicit.precise import checked_float64_law

        checked_float64_law(body, Corotated() if model is None else model)
    solved = RestState(body, model=model, **options)
    if precision == FLOAT32:
        return solved
    return PreciseState(solved)


@dataclass(frozen=True, kw_only=True)
class StaticGradient(Derivatives):
    """The result of ``static_gradient``. Derivatives are float64; those that were not requested are None.

    ``gradient["young"]`` is ``gradient.young``.

    Attributes:
        value: The objective J.
        report: The report on the state of rest.
        adjoint_iterations: Iterations of conjugate gradients in the adjoint solve; none in float64.
        adjoint_residual: Its residual over its right side.
        young: dJ/dE [1/Pa] in the shape of the material's values: a number, [T], [worlds, 1] or [worlds, T].
        poisson, density: The same of Poisson's ratio and of density [m^3/kg].
        loads: dJ/df of each node's load [1/N], [worlds * N, 3]; zero at held nodes.
        boundary: dJ/dx of the places where held nodes are held [1/m], [worlds * N, 3]; zero at free nodes.
        rest: dJ/dX of each node's rest position [1/m], [worlds * N, 3]. Displacements of held nodes, materials of
            elements and directions of fibres stay as they are.
        activation: dJ/ds of each element's active stress [1/Pa], [worlds, T].
        gravity: dJ/dg [s^2/m], [3].
        obstacles: dJ/dp of each obstacle's place [1/m], [obstacles, 3]: of the same motion in all worlds.
    """

    value: float
    report: StaticReport = field(repr=False)
    adjoint_iterations: int
    adjoint_residual: float
    boundary: Array | None = None


@under_lock
def static_gradient(
    body: SoftBody,
    objective: Objective,
    *,
    wrt: str | Sequence[str] = ("young",),
    model: Model | None = None,
    gravity: npt.ArrayLike | None = None,
    tolerance: float = 1e-6,
    iterations: int = 100,
    load_steps: int = 1,
    preconditioner: str | None = None,
    adjoint_tolerance: float = 1e-6,
    obstacles: Shape | Sequence[Shape] = (),
    contact: Contact | None = None,
    precision: str = FLOAT32,
) -> StaticGradient:
    """The derivatives of an objective of a body's positions at rest, by one adjoint solve for all of them.

    ``solve_static`` moves the body to its state of rest. With K the stiffness there and g the objective's derivative
    with respect to positions, K a = g gives an adjoint motion a, and each derivative is the work of the change of
    forces in it.

    Args:
        body: The body; some nodes of each world must be held.
        objective: A function of positions, vec3 [worlds * N] [m]. It returns a ``wp.array`` of one number, made with
            ``requires_grad=True`` and computed by kernels that it launches, which a tape differentiates; or a pair of a
            number and its derivative with respect to positions, [worlds * N, 3], for example from
            ``positions.numpy()``.
        wrt: Names of derivatives of ``StaticGradient``: "young", "poisson", "density", "loads", "boundary", "rest",
            "activation", "gravity", "obstacles".
        model, gravity, tolerance, iterations, load_steps, preconditioner: As for ``solve_static``.
        adjoint_tolerance: Tolerance of the adjoint solve, its residual over the right side.
        obstacles, contact: As for ``solve_static``. The gradient is that of the contacts at rest: it jumps where a
            contact begins or ends. Friction of obstacles must hold all places that have it; they count as held where
            they are. Self-contact must be without friction, and at places inside triangles and edges.
        precision: "float32": everything is computed on the body's device. "float64": the answer is refined on the host,
            by Newton's method with a sparse direct solver, and the adjoint is solved there; positions are vec3d. For
            the models ``Corotated``, ``Linear``, ``StVenantKirchhoff`` and ``NeoHookean`` with isotropic materials,
            bodies of some 10,000 nodes, and contact of nodes with ``Ground`` and ``Sphere``.

    Raises:
        InputError: As ``solve_static``, a name is none of these, the model or the material has no such derivative, a
            world has no held node, contacts slip or are where gradients jump, or the objective gives something else.
        ConvergenceError: The body does not come to rest, the state of rest is not stable, or the adjoint solve does not
            converge.
    """
    names = parameters.checked_names(wrt, parameters.NEEDS)
    options: dict[str, Any] = {"gravity": gravity, "adjoint_tolerance": adjoint_tolerance, "tolerance": tolerance}
    options |= {"iterations": iterations, "load_steps": load_steps, "preconditioner": preconditioner}
    options |= {"obstacles": obstacles, "contact": contact, "names": names}
    solved = solved_state(body, precision=precision, model=model, **options)
    dtype = wp.vec3d if precision == FLOAT64 else wp.vec3
    positions = wp.array(solved.positions, dtype=dtype, device=body.device)
    value, derivative = value_and_derivative(objective, positions)
    found = solved.pull_back(derivative, names)
    found |= {"adjoint_iterations": solved.adjoint_iterations, "adjoint_residual": solved.adjoint_residual}
    return StaticGradient(value=value, report=solved.report, **found)


class PreciseState:
    """A body at rest in float64, and gradients there; used like ``RestState``.

    Args:
        solved: The state in float32; its body moves to the answer.

    Attributes:
        body, report: The body and the report of ``solved``.
        adjoint_iterations, adjoint_residual: Zero, since there are no conjugate gradients.

    Raises:
        InputError: The model or the material does not exist in float64.
        ConvergenceError: Newton's method does not converge from the state in float32, or K is singular.
    """

    def __init__(self, solved: RestState):
        from warp_corot.solvers.implicit.precise import PreciseRest

        body, self._gravity = solved.body, solved.gravity
        self.body, self.report = body, solved.report
        loads = body.conditions.loads_and_weights(solved.gravity)
        self._contacts, shapes = [], solved.obstacles
        if solved.contact is not None:
            rest = body.mesh.points
            self._contacts = [PreciseContact(solved.contact, shapes, rest, world) for world in range(body.worlds)]
        self._obstacle_count = len(shapes)
        self._rest = PreciseRest(body, solved.field, solved.law, loads, self._contacts)
        self.adjoint_iterations, self.adjoint_residual = 0, 0.0

    @property
    def positions(self) -> Array:
        """[m], float64 [worlds * N, 3]."""
        return self.body.rest_positions + self._rest.u.reshape(-1, 3)

    def pull_back(self, derivative: Array, names: Sequence[str]) -> dict[str, Any]:
        """As ``RestState.pull_back``."""
        given = np.asarray(derivative, np.float64).reshape(self._rest.u.shape)
        moved, boundary = np.zeros_like(self._rest.u), np.zeros_like(self._rest.u)
        of_obstacles = np.zeros((self._obstacle_count, 3))
        for world, (stiffness, factors) in enumerate(self._rest.factors):
            free, held = self._rest.free[world], self._rest.held[world]
            motion = np.zeros(given[world].size)
            contact = self._contacts[world] if self._contacts and self._contacts[world].count else None
            right = given[world].ravel()[free]
            solution = factors.solve(np.pad(right, (0, 0 if contact is None else contact.count)))
            motion[free] = solution[: len(free)]
            moved[world] = motion.reshape(-1, 3)
            product = stiffness @ motion
            if contact is not None:
                u, multipliers = self._rest.u[world], solution[len(free) :]
                product = product + contact.normals(u) @ multipliers
                pushes = self._rest.pushes[world]
                of_obstacles += contact.of_obstacles(u, pushes, moved[world], multipliers)
            boundary[world] = np.where(held[:, None], given[world] - product.reshape(-1, 3), 0.0)
        elements, flat = self._rest.elements, moved.reshape(-1, 3)
        of_worlds = [each.work(*pair) for each, *pair in zip(elements, self._rest.u, moved, strict=True)]
        of_mu, of_lam, of_rest = (np.concatenate(values) for values in zip(*of_worlds, strict=True))

        def of_weights(densities: Array) -> Array:
            each = zip(elements, densities.reshape(len(elements), -1, 1, 1) * np.eye(3), strict=True)
            return np.concatenate([one.scatter(-density) for one, density in each])

        # As an ``ElementWork``.
        work = SimpleNamespace(of_lame=lambda: (of_mu, of_lam), of_rest=lambda: of_rest, of_weights=of_weights)
        places = {"boundary": boundary.reshape(-1, 3), "obstacles": of_obstacles}
        return derivatives(self.body, work, names, flat, flat @ self._gravity, **places)
