"""Gradients of static answers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.body.soft_body import SoftBody
from warp_corot.contact.options import Contact
from warp_corot.contact.shapes import Shape
from warp_corot.elasticity import Model
from warp_corot.inputs.simulation_lock import under_lock
from warp_corot.simulation.static import StaticReport

from . import parameters
from .objective import Objective, value_and_derivative
from .solved import FLOAT32, FLOAT64, solved_state

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class StaticGradient:
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
    young: Array | float | None = None
    poisson: Array | float | None = None
    density: Array | float | None = None
    loads: Array | None = None
    boundary: Array | None = None
    rest: Array | None = None
    activation: Array | None = None
    gravity: Array | None = None
    obstacles: Array | None = None

    def __getitem__(self, name: str) -> Any:
        return parameters.requested(self, name, parameters.NEEDS)


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
    solved = solved_state(
        body,
        model=model,
        gravity=gravity,
        names=names,
        precision=precision,
        adjoint_tolerance=adjoint_tolerance,
        preconditioner=preconditioner,
        obstacles=obstacles,
        contact=contact,
        tolerance=tolerance,
        iterations=iterations,
        load_steps=load_steps,
    )
    dtype = wp.vec3d if precision == FLOAT64 else wp.vec3
    positions = wp.array(solved.positions, dtype=dtype, device=body.device)
    value, derivative = value_and_derivative(objective, positions)
    found = solved.pull_back(derivative, names)
    return StaticGradient(value, solved.report, solved.adjoint_iterations, solved.adjoint_residual, **found)
