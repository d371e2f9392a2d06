"""A state of rest and its adjoint in float64, on the host: Newton's method with a direct solver."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.sparse.linalg import SuperLU, splu

from warp_corot.body.soft_body import SoftBody
from warp_corot.elasticity import Corotated, Model
from warp_corot.elasticity.dilatation.field import DilatationField
from warp_corot.elasticity.dilatation.on_host import HostDilatation
from warp_corot.elasticity.host_laws import HostLaw, host_law
from warp_corot.errors import ConvergenceError, InputError
from warp_corot.inputs.checks import shown
from warp_corot.materials.isotropic import Isotropic

from .precise_elements import PreciseElements
from .rest_state import RestState
from .sums import derivatives

Array = npt.NDArray[np.float64]

FLOAT32, FLOAT64 = "float32", "float64"
#: Maximum number of Newton's iterations, and the tolerance of the last one: its largest displacement over the largest
#: displacement.
ITERATIONS, SMALL = 20, 1e-13


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
        checked_host_law(body, Corotated() if model is None else model)
    solved = RestState(body, model=model, **options)
    return solved if precision == FLOAT32 else PreciseState(solved)


class PreciseState:
    """A body at rest in float64, and gradients there; as ``RestState``.

    Args:
        solved: The state in float32; its body moves to the answer.

    Attributes:
        body, report: Those of ``solved``.
        adjoint_iterations, adjoint_residual: Zero, since there are no conjugate gradients.

    Raises:
        InputError: The model or the material does not exist in float64.
        ConvergenceError: Newton's method does not converge from the state in float32, or K is singular.
    """

    def __init__(self, solved: RestState):
        body, gravity = solved.body, solved.gravity
        self.body, self.report, self._gravity = body, solved.report, gravity
        law = checked_host_law(body, solved.law)
        shared = HostDilatation(solved.field) if isinstance(solved.field, DilatationField) else None
        worlds, count = body.worlds, body.sizes.nodes
        self._elements = [PreciseElements(body, law, shared, world) for world in range(worlds)]
        loads = body.masses[:, None] * gravity
        if body.conditions.has_loads:
            loads = loads + body.conditions.loads.numpy()[:count, :3]
        self._loads = loads.reshape(worlds, -1, 3)
        self._held = body.conditions.held_mask().reshape(worlds, -1)
        # Free nodes of no element stay where they are.
        self._free = [
            np.flatnonzero(np.repeat(~held & (masses > 0.0), 3))
            for held, masses in zip(self._held, body.masses.reshape(worlds, -1), strict=True)
        ]
        start = body.state.displacements.numpy()[:count, :3].astype(np.float64).reshape(worlds, -1, 3)
        self._u = np.empty_like(start)
        self._factors: list[tuple[Any, SuperLU]] = []
        for world in range(worlds):
            self._u[world] = self._solved(world, start[world])
        body.displacements = self._u.reshape(-1, 3)
        self.adjoint_iterations, self.adjoint_residual = 0, 0.0

    @property
    def positions(self) -> Array:
        """[m], float64 [worlds * N, 3]."""
        return self.body.rest_positions + self._u.reshape(-1, 3)

    def _solved(self, world: int, u: Array) -> Array:
        elements, free = self._elements[world], self._free[world]
        for _ in range(ITERATIONS):
            step = np.zeros(u.size)
            left = (elements.forces(u) + self._loads[world]).ravel()[free]
            factors = self._factored(world, u)
            step[free] = factors.solve(left)
            u = u + step.reshape(u.shape)
            if not np.abs(step).max() > SMALL * np.abs(u).max():
                self._factors.append((elements.stiffness(u), self._factored(world, u)))
                return u
        raise ConvergenceError("Newton's method in float64 does not converge from the answer of float32")

    def _factored(self, world: int, u: Array) -> SuperLU:
        free = self._free[world]
        try:
            return splu(self._elements[world].stiffness(u)[free][:, free].tocsc())
        except RuntimeError:
            raise ConvergenceError("the stiffness is singular: the state of rest has no gradient") from None

    def pull_back(self, derivative: Array, names: Sequence[str]) -> dict[str, Any]:
        """As ``RestState.pull_back``."""
        given = np.asarray(derivative, np.float64).reshape(self._u.shape)
        moved, boundary = np.zeros_like(self._u), np.zeros_like(self._u)
        for world, (stiffness, factors) in enumerate(self._factors):
            free, held = self._free[world], self._held[world]
            motion = np.zeros(given[world].size)
            motion[free] = factors.solve(given[world].ravel()[free])
            moved[world] = motion.reshape(-1, 3)
            boundary[world] = np.where(held[:, None], given[world] - (stiffness @ motion).reshape(-1, 3), 0.0)
        work = _Work(self._elements, self._u, moved)
        flat = moved.reshape(-1, 3)
        found = derivatives(self.body, work, names, flat, flat @ self._gravity)
        if "rest" in names:
            found["rest"] = found["rest"] + boundary.reshape(-1, 3)
        if "boundary" in names:
            found["boundary"] = boundary.reshape(-1, 3)
        return found


class _Work:
    """The work of elements' forces in adjoint motions, in all worlds; as ``ElementWork``."""

    def __init__(self, elements: list[PreciseElements], u: Array, moved: Array):
        self._elements = elements
        of_worlds = [each.work(*pair) for each, *pair in zip(elements, u, moved, strict=True)]
        self._of_mu, self._of_lam, self._of_rest = (np.concatenate(values) for values in zip(*of_worlds, strict=True))

    def of_lame(self) -> tuple[Array, Array]:
        return self._of_mu, self._of_lam

    def of_rest(self) -> Array:
        return self._of_rest

    def of_activation(self) -> Array:
        return np.zeros(0)

    def of_weights(self, densities: Array) -> Array:
        rows = densities.reshape(len(self._elements), -1, 1, 1) * np.eye(3)
        return np.concatenate([each.scatter(-row) for each, row in zip(self._elements, rows, strict=True)])


def checked_host_law(body: SoftBody, law: Model) -> HostLaw:
    """The law in float64.

    Raises:
        InputError: The law does not exist in float64.
    """
    found = host_law(law)
    if found is None or not isinstance(body.material, Isotropic):
        raise InputError(
            "precision is 'float64'; it needs an isotropic material and Linear, Corotated, StVenantKirchhoff, "
            "NeoHookean or EdgeStVK with biquadratic springs"
        )
    return found
