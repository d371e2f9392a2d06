"""A state of rest and its adjoint in float64, on the host: Newton's method with a direct solver."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_matrix
from scipy.sparse.linalg import SuperLU, splu

from warp_corot.body.soft_body import SoftBody
from warp_corot.elasticity import Corotated, Model
from warp_corot.elasticity.dilatation.options import ELEMENT, shares_dilatation
from warp_corot.elasticity.host_laws import HostLaw, host_law
from warp_corot.errors import ConvergenceError, InputError
from warp_corot.inputs.checks import shown
from warp_corot.materials.isotropic import Isotropic

from .rest_state import RestState
from .sums import derivatives

Array = npt.NDArray[np.float64]

FLOAT32, FLOAT64 = "float32", "float64"
#: Newton's iterations at most, and the largest displacement of the last one over the largest displacement.
ITERATIONS, SMALL = 20, 1e-13


def solved_state(body: SoftBody, *, precision: str = FLOAT32, model: Model | None = None, **options: Any) -> Any:
    """A ``RestState`` or a ``PreciseState`` of a body.

    Args:
        body: The body.
        precision: As for ``static_gradient``.
        model: As for ``solve_static``.
        options: Others of ``RestState``.

    Raises:
        InputError, ConvergenceError: As ``static_gradient``.
    """
    if precision not in (FLOAT32, FLOAT64):
        raise InputError(f"precision is {shown(precision)}; it must be {FLOAT32!r} or {FLOAT64!r}")
    if precision == FLOAT64 and isinstance(body, SoftBody):
        checked_host_law(body, Corotated() if model is None else model)
    solved = RestState(body, model=model, **options)
    return solved if precision == FLOAT32 else PreciseState(solved)


class PreciseElements:
    """The elements of one world.

    Args:
        body: The body.
        law: Its law.
        world: Which world.
    """

    def __init__(self, body: SoftBody, law: HostLaw, world: int):
        mesh = body.mesh
        self.tets, self.nodes, self._law = np.asarray(mesh.tets), len(mesh.points), law
        corners = np.asarray(mesh.points)[self.tets]
        inverse = np.linalg.inv(np.swapaxes(corners[:, 1:] - corners[:, :1], 1, 2))
        self.hats = np.concatenate([-inverse.sum(axis=1, keepdims=True), inverse], axis=1)
        self.volumes = np.asarray(mesh.volumes, np.float64)
        fill = 1.0 if body.discretization.fill is None else body.discretization.fill
        lame = (np.atleast_2d(value) for value in (body.material.mu, body.material.lam))
        self._lame = [
            (np.broadcast_to(value, (body.worlds, len(self.tets)))[world] * fill)[:, None, None] for value in lame
        ]
        dofs = (3 * self.tets[:, :, None] + np.arange(3)).reshape(-1, 12)
        self._rows, self._columns = np.repeat(dofs, 12, axis=1).ravel(), np.tile(dofs, (1, 12)).ravel()

    def gradients(self, u: Array) -> Array:
        """du/dX of nodal vectors [N, 3], [T, 3, 3]."""
        return np.asarray(np.einsum("tai,taj->tij", u[self.tets], self.hats))

    def scatter(self, stress: Array) -> Array:
        """-V P grad N summed at nodes [N], [N, 3]."""
        forces = np.zeros((self.nodes, 3))
        np.add.at(forces, self.tets, -np.einsum("t,tij,taj->tai", self.volumes, stress, self.hats))
        return forces

    def forces(self, u: Array) -> Array:
        return self.scatter(self._law.stress(np.eye(3) + self.gradients(u), *self._lame))

    def stiffness(self, u: Array) -> Any:
        """K, sparse [3 N, 3 N]."""
        f, blocks = np.eye(3) + self.gradients(u), np.empty((len(self.tets), 4, 3, 4, 3))
        for k in range(3):
            for b in range(4):
                way = np.zeros_like(f)
                way[:, k] = self.hats[:, b]
                stress = self._law.differential(f, way, *self._lame)
                blocks[:, :, :, b, k] = np.einsum("t,tij,taj->tai", self.volumes, stress, self.hats)
        size = 3 * self.nodes
        return coo_matrix((blocks.ravel(), (self._rows, self._columns)), shape=(size, size)).tocsc()

    def work(self, u: Array, motion: Array) -> tuple[Array, Array, Array]:
        """Derivatives of the work of forces in a motion with respect to mu and lambda, [T], and to rest positions,
        [N, 3]; see ``kernels.gradients.elements``."""
        f, grad = np.eye(3) + self.gradients(u), self.gradients(motion)
        of_mu, of_lam = (
            -self.volumes * np.sum(self._law.stress(f, *pair) * grad, axis=(1, 2)) for pair in ((1.0, 0.0), (0.0, 1.0))
        )
        stress = self._law.stress(f, *self._lame)
        turned = np.swapaxes(f, 1, 2) @ self._law.differential(f, grad, *self._lame)
        e = np.sum(stress * grad, axis=(1, 2))[:, None, None] * np.eye(3) - turned - np.swapaxes(grad, 1, 2) @ stress
        return of_mu, of_lam, self.scatter(e)


class PreciseState:
    """A body at rest in float64, and gradients there; as ``RestState``.

    Args:
        solved: The state in float32; its body is moved to the answer.

    Attributes:
        body, report: Of that.
        adjoint_iterations, adjoint_residual: None of conjugate gradients.

    Raises:
        InputError: The model or the material is none of those in float64.
        ConvergenceError: Newton's method does not converge from there, or K is singular.
    """

    def __init__(self, solved: RestState):
        body, gravity = solved.body, solved.gravity
        self.body, self.report, self._gravity = body, solved.report, gravity
        found = checked_host_law(body, solved.law)
        worlds, count = body.worlds, body.sizes.nodes
        self._elements = [PreciseElements(body, found, world) for world in range(worlds)]
        loads = body.masses[:, None] * gravity
        if body.conditions.has_loads:
            loads = loads + body.conditions.loads.numpy()[:count, :3]
        self._loads = loads.reshape(worlds, -1, 3)
        self._held = body.conditions.held_mask().reshape(worlds, -1)
        # What is not held and belongs to no element stays.
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
    """What elements' forces do in adjoint motions, of all worlds; as ``ElementWork``."""

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
        InputError: There is none.
    """
    found = host_law(law)
    if found is None or not isinstance(body.material, Isotropic):
        raise InputError(
            "precision is 'float64'; it needs an isotropic material and Linear, Corotated, StVenantKirchhoff, "
            "NeoHookean or EdgeStVK with biquadratic springs"
        )
    dilatation = getattr(law, "dilatation", ELEMENT)
    if shares_dilatation(dilatation, body.discretization):
        raise InputError(
            f"precision is 'float64', and elements share their dilatation; it needs a model with dilatation={ELEMENT!r}"
        )
    return found
