"""A state of rest and its adjoint in float64, on the host."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from warp_corot.solvers.implicit.precise import PreciseElements, PreciseRest

from .parameters import derivatives
from .precise_contact import PreciseContact
from .static import RestState

Array = npt.NDArray[np.float64]


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
        body, self._gravity = solved.body, solved.gravity
        self.body, self.report = body, solved.report
        loads = body.masses[:, None] * solved.gravity
        if body.conditions.has_loads:
            loads = loads + body.conditions.loads.numpy()[: body.sizes.nodes, :3]
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
        work = _Work(self._rest.elements, self._rest.u, moved)
        flat = moved.reshape(-1, 3)
        found = derivatives(self.body, work, names, flat, flat @ self._gravity)
        if "rest" in names:
            found["rest"] = found["rest"] + boundary.reshape(-1, 3)
        if "boundary" in names:
            found["boundary"] = boundary.reshape(-1, 3)
        if "obstacles" in names:
            found["obstacles"] = of_obstacles
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
