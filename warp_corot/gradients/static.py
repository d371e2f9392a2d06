"""Gradients of static answers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.body.soft_body import SoftBody
from warp_corot.elasticity import Corotated, ForceField, Model
from warp_corot.errors import ConvergenceError, InputError
from warp_corot.inputs.checks import checked_number, shown
from warp_corot.simulation.parts import checked_gravity, checked_models
from warp_corot.simulation.static import StaticReport, solve_static

from . import parameters
from .adjoint import StaticAdjoint
from .element_work import ElementWork, add_weight_to_rest
from .objective import Objective, value_and_derivative

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class StaticGradient:
    """What ``static_gradient`` found. Derivatives are float64; those that were not asked for are None.

    ``gradient["young"]`` is ``gradient.young``.

    Attributes:
        value: The objective J.
        report: Of the state of rest.
        adjoint_iterations: Iterations of conjugate gradients in the adjoint solve.
        adjoint_residual: What that leaves of its right side, as a share.
        young: dJ/dE [1/Pa] in the shape of the material's values: a number, [T], [worlds, 1] or [worlds, T].
        poisson, density: The same of Poisson's ratio and of density [m^3/kg].
        loads: dJ/df of each node's load [1/N], [worlds * N, 3]; zero at held nodes.
        boundary: dJ/dx of the places where held nodes are held [1/m], [worlds * N, 3]; zero at free nodes.
        rest: dJ/dX of each node's rest position [1/m], [worlds * N, 3]. Displacements of held nodes, materials of
            elements and directions of fibres stay as they are.
        activation: dJ/ds of each element's active stress [1/Pa], [worlds, T].
        gravity: dJ/dg [s^2/m], [3].
    """

    value: float
    report: StaticReport = field(repr=False)
    adjoint_iterations: int
    adjoint_residual: float
    young: Array | float | None = None
    poisson: Array | float | None = None
    density: Array | float | None = None
    loads: Array | None = None
    boundary: Array | None = None
    rest: Array | None = None
    activation: Array | None = None
    gravity: Array | None = None

    def __getitem__(self, name: str) -> Any:
        if name not in parameters.NEEDS or getattr(self, name) is None:
            raise InputError(f"{shown(name)} is not among what the gradient was asked for")
        return getattr(self, name)


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
) -> StaticGradient:
    """The derivatives of an objective of where a body is at rest, by one adjoint solve for all of them together.

    ``solve_static`` moves the body to where it is at rest. With K the stiffness there and g the objective's derivative
    with respect to positions, K a = g gives an adjoint motion a, and each derivative is what the change of forces does
    in it.

    Args:
        body: The body; some nodes of each world must be held.
        objective: A function of positions, vec3 [worlds * N] [m]. It gives a ``wp.array`` of one number, made with
            ``requires_grad=True``, that kernels which it launches compute and a tape differentiates; or a pair of a
            number and its derivative with respect to positions, [worlds * N, 3]; ``positions.numpy()`` are NumPy's.
        wrt: Names of derivatives of ``StaticGradient``: "young", "poisson", "density", "loads", "boundary", "rest",
            "activation", "gravity".
        model, gravity, tolerance, iterations, load_steps, preconditioner: As for ``solve_static``.
        adjoint_tolerance: Of the adjoint solve, the residual over the right side.

    Raises:
        InputError: As ``solve_static``, a name is none of these, the model or the material has no such derivative, a
            world has no held node, or the objective gives something else.
        ConvergenceError: The body does not come to rest, the state of rest is not stable, or the adjoint solve does not
            converge.
    """
    names = checked_names(wrt)
    if not isinstance(body, SoftBody):
        raise InputError(f"body is {shown(body)}; it must be a SoftBody")
    check_held(body)
    if not 0.0 < checked_number(adjoint_tolerance, "adjoint_tolerance") < 1.0:
        raise InputError(f"adjoint_tolerance is {adjoint_tolerance}; it must be between 0 and 1")
    (law,) = checked_models(Corotated() if model is None else model, 1)
    forces, work = bound(body, law, names)
    report = solve_static(
        body,
        model=law,
        gravity=gravity,
        tolerance=tolerance,
        iterations=iterations,
        load_steps=load_steps,
        preconditioner=preconditioner,
    )
    if not report.converged:
        raise ConvergenceError(f"there is no gradient: {report.message}")
    value, derivative = value_and_derivative(objective, wp.clone(body.positions))
    adjoint = StaticAdjoint(body, forces, preconditioner, adjoint_tolerance)
    motion, boundary = adjoint.solve(derivative)
    down = np.array(checked_gravity(gravity, body.mesh.up_axis))
    return StaticGradient(
        value,
        report,
        adjoint.iterations,
        adjoint.residual,
        **static_derivatives(body, forces, work, names, motion, boundary, down),
    )


def static_derivatives(
    body: SoftBody,
    forces: ForceField,
    work: ElementWork,
    names: Sequence[str],
    motion: wp.array,
    boundary: Array,
    gravity: Array,
) -> dict[str, Any]:
    """The derivatives of these names from an adjoint motion, vec4, and the derivative with respect to the boundary."""
    moved = motion.numpy()[: body.sizes.nodes, :3].astype(np.float64)
    work.add(body.state.displacements, motion)
    found: dict[str, Any] = {}
    for name in names:
        if name == "loads":
            found[name] = moved
        elif name == "boundary":
            found[name] = boundary
        elif name == "gravity":
            found[name] = body.masses @ moved
        elif name == "young":
            found[name] = parameters.of_young(body, *work.of_lame())
        elif name == "poisson":
            found[name] = parameters.of_poisson(body, *work.of_lame())
        elif name == "density":
            found[name] = parameters.of_density(body, moved @ gravity)
        elif name == "activation":
            found[name] = work.of_activation().reshape(body.worlds, -1)
        elif name == "rest":
            weights = wp.zeros_like(motion)
            add_weight_to_rest(forces, parameters.weight_densities(body, moved @ gravity), weights)
            # Held nodes keep their displacements, so that their places follow the rest shape.
            found[name] = work.of_rest() + weights.numpy()[:, :3] + boundary
    return found


def bound(body: SoftBody, law: Model, names: Sequence[str]) -> tuple[ForceField, ElementWork]:
    """A law's forces, and what sums their derivatives.

    Raises:
        InputError: The law or the material has no such derivative.
    """
    if getattr(law, "rotation_level", None) is not None:
        raise InputError(
            "the model shares rotations, and has no exact stiffness; for gradients each element needs its own"
        )
    forces = law.bind(body)
    needs = {need for name in names if (need := parameters.NEEDS[name]) is not None}
    return forces, ElementWork(forces, needs)


def checked_names(wrt: str | Sequence[str]) -> tuple[str, ...]:
    """Names of derivatives.

    Raises:
        InputError: One is none.
    """
    names = (wrt,) if isinstance(wrt, str) else tuple(wrt)
    wanted = ", ".join(map(repr, parameters.NEEDS))
    for name in names:
        if name not in parameters.NEEDS:
            raise InputError(f"wrt has {shown(name)}; it must be one or several of {wanted}")
    if not names:
        raise InputError(f"wrt is empty; it must be one or several of {wanted}")
    return names


def check_held(body: SoftBody) -> None:
    """See that some nodes of each world are held.

    Raises:
        InputError: None are.
    """
    free = np.logical_not(body.conditions.held_mask().reshape(body.worlds, -1).any(axis=1))
    if free.any():
        where = f" in world {int(np.argmax(free))}" if body.worlds > 1 else ""
        raise InputError(f"no node is held{where}; a body that may be anywhere has no gradient: fix some nodes")
