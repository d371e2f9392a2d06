"""A body at rest, and derivatives with respect to its input from those with respect to its positions."""

from __future__ import annotations

from collections.abc import Sequence
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
from warp_corot.simulation.parts import checked_gravity, checked_models
from warp_corot.simulation.resting import checked_obstacles
from warp_corot.simulation.static import static_answer

from . import parameters
from .adjoint import Adjoint
from .contact import RestingContact
from .element_work import ElementWork
from .sums import derivatives

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
        return self._derivatives(names, motion, boundary)

    def _derivatives(self, names: Sequence[str], motion: wp.array, boundary: Array) -> dict[str, Any]:
        """The derivatives from an adjoint motion, vec4, and the derivative with respect to the boundary."""
        body, gravity = self.body, self.gravity
        moved = motion.numpy()[: body.sizes.nodes, :3].astype(np.float64)
        work = ElementWork(self.field, parameters.needed(names))
        work.add(body.state.displacements, motion)
        found = derivatives(body, work, names, moved, moved @ gravity)
        if "rest" in names:
            # Held nodes keep their displacements, so their places follow the rest shape.
            found["rest"] = found["rest"] + boundary
        if "boundary" in names:
            found["boundary"] = boundary
        if "obstacles" in names:
            found["obstacles"] = np.zeros((len(self.obstacles), 3))
            if self.contact is not None and self._adjoint is not None:
                found["obstacles"] = self.contact.of_obstacles(moved, self._adjoint.multipliers)
        return found


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
