"""A state of rest in float64, on the host: elements, Newton's method, and a direct solver."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
import numpy.typing as npt
from scipy.sparse import block_array, coo_matrix, diags
from scipy.sparse.linalg import SuperLU, splu

from warp_corot.elasticity import ForceField, Model
from warp_corot.elasticity.dilatation import DilatationField
from warp_corot.elasticity.float64 import Measured, SharedDilatation, Stresses, float64_law, stresses
from warp_corot.errors import ConvergenceError, InputError
from warp_corot.kernels.elements.simd8 import IsotropicLaw
from warp_corot.materials.isotropic import Isotropic

if TYPE_CHECKING:
    from warp_corot.body.soft_body import SoftBody


Array = npt.NDArray[np.float64]


class PreciseElements:
    """The elements of one world.

    Args:
        body: The body.
        law: Its law.
        shared: The dilatation that elements share, if they do; the law then excludes it.
        world: The number of the world.
    """

    def __init__(self, body: SoftBody, law: IsotropicLaw, shared: SharedDilatation | None, world: int):
        mesh = body.mesh
        self.tets, self.nodes, self._law, self._shared = np.asarray(mesh.tets), len(mesh.points), law, shared
        corners = np.asarray(mesh.points)[self.tets]
        inverse = np.linalg.inv(np.swapaxes(corners[:, 1:] - corners[:, :1], 1, 2))
        self.hats = np.concatenate([-inverse.sum(axis=1, keepdims=True), inverse], axis=1)
        self.volumes = np.asarray(mesh.volumes, np.float64)
        fill = 1.0 if body.discretization.fill is None else body.discretization.fill
        shape = (body.worlds, len(self.tets))
        mu, lam = (
            np.broadcast_to(np.atleast_2d(value), shape)[world] * fill
            for value in (body.material.mu, body.material.lam)
        )
        self._lam, self._weights = lam, lam * self.volumes
        self._lame = mu, 0.0 * lam if shared else lam
        self._dofs = (3 * self.tets[:, :, None] + np.arange(3)).reshape(-1, 12)

    def gradients(self, u: Array) -> Array:
        """du/dX of nodal vectors [N, 3], [T, 3, 3]."""
        return np.asarray(np.einsum("tai,taj->tij", u[self.tets], self.hats))

    def scatter(self, stress: Array) -> Array:
        """-V P grad N summed at nodes [N], [N, 3]."""
        forces = np.zeros((self.nodes, 3))
        np.add.at(forces, self.tets, -np.einsum("t,tij,taj->tai", self.volumes, stress, self.hats))
        return forces

    def forces(self, u: Array) -> Array:
        """Elastic forces [N], [N, 3]."""
        a = self.gradients(u)
        stress = self._stresses(a).p
        if self._shared:
            measured, slope, _ = self._sharing(a)
            stress = stress + _each(self._lam * (slope + measured.held)) * measured.slope
        return self.scatter(stress)

    def _stresses(self, a: Array, da: Array | None = None) -> Stresses:
        return stresses(self._law, a, *self._lame, da).checked()

    def stiffness(self, u: Array) -> Any:
        """K, sparse [3 N, 3 N]."""
        a, blocks = self.gradients(u), np.empty((len(self.tets), 4, 3, 4, 3))
        sharing = self._sharing(a) if self._shared else None
        for k in range(3):
            for b in range(4):
                way = np.zeros_like(a)
                way[:, k] = self.hats[:, b]
                stress = self._stresses(a, way).dp
                if self._shared and sharing:
                    measured, slope = self._shared.measure(a, way), sharing[1]
                    held = measured.stiffness * np.sum(measured.slope * way, axis=(1, 2))
                    turning = _each(slope + measured.held) * measured.turning
                    stress = stress + _each(self._lam) * (_each(held) * measured.slope + turning)
                blocks[:, :, :, b, k] = np.einsum("t,tij,taj->tai", self.volumes, stress, self.hats)
        rows, columns = np.repeat(self._dofs, 12, axis=1).ravel(), np.tile(self._dofs, (1, 12)).ravel()
        size = 3 * self.nodes
        matrix = coo_matrix((blocks.ravel(), (rows, columns)), shape=(size, size)).tocsc()
        return matrix + self._coupling(*sharing) if sharing else matrix

    def work(self, u: Array, motion: Array) -> tuple[Array, Array, Array]:
        """Derivatives of the work of forces in a motion with respect to mu and lambda, [T], and to rest positions,
        [N, 3]; see ``kernels.gradients.elements``."""
        a, grad = self.gradients(u), self.gradients(motion)
        of_mu, of_lam = (
            -self.volumes * np.sum(stresses(self._law, a, *pair).p * grad, axis=(1, 2))
            for pair in ((1.0, 0.0), (0.0, 1.0))
        )
        stress, differential, _ = self._stresses(a, grad)
        turned = np.swapaxes(np.eye(3) + a, 1, 2) @ differential
        e = _each(np.sum(stress * grad, axis=(1, 2))) * np.eye(3) - turned - np.swapaxes(grad, 1, 2) @ stress
        if self._shared:
            of_lam, added = self._shared_work(a, grad)
            e = e + added
        return of_mu, of_lam, self.scatter(e)

    # --- a dilatation that elements share ----------------------------------------------------------------------------

    def _sharing(self, a: Array, da: Array | None = None) -> tuple[Measured, Array, Array]:
        """Elements' own dilatations and w' of the shared ones, [T], and the shared ones, [groups]."""
        assert self._shared
        measured = self._shared.measure(a, da)
        theta = self._shared.means(self._weights, measured.theta)
        return measured, self._shared.sharing.T @ self._shared.law(theta)[0], theta

    def _coupling(self, measured: Measured, _slope: Array, theta: Array) -> Any:
        """The part of K that couples elements: for each group, w'' / sum of q times the square of sum of q d
        theta_e.
        """
        assert self._shared
        changes = np.einsum("tij,taj->tai", measured.slope, self.hats).reshape(-1, 12)
        rows = np.repeat(np.arange(len(self.tets)), 12)
        shape = (len(self.tets), 3 * self.nodes)
        of_elements = coo_matrix(((self._weights[:, None] * changes).ravel(), (rows, self._dofs.ravel())), shape=shape)
        of_groups = self._shared.sharing @ of_elements.tocsr()
        total = self._shared.sharing @ self._weights
        stiffness = self._shared.law(theta)[1] / np.where(total != 0.0, total, 1.0)
        return (of_groups.T @ diags(stiffness) @ of_groups).tocsc()

    def _shared_work(self, a: Array, grad: Array) -> tuple[Array, Array]:
        """The derivative with respect to lambda, [T], and E of the shared part, [T, 3, 3]."""
        shared = self._shared
        assert shared
        measured, slope, theta = self._sharing(a, grad)
        f = np.eye(3) + a
        own = np.sum(measured.slope * grad, axis=(1, 2))
        pulled = shared.law(theta)[1] * shared.means(self._weights, own)  # w'' c
        along = shared.sharing.T @ pulled
        first = slope + measured.held
        density = first * own + along * measured.theta - shared.sharing.T @ (pulled * theta)
        turned = np.swapaxes(f, 1, 2) @ measured.slope
        turning = np.swapaxes(f, 1, 2) @ measured.turning + np.swapaxes(grad, 1, 2) @ measured.slope
        e = _each(density) * np.eye(3) - _each(along + measured.stiffness * own) * turned - _each(first) * turning
        return -self.volumes * density, _each(self._lam) * e


def _each(values: Array) -> Array:
    """[T] as [T, 1, 1]."""
    return values[:, None, None]


#: Maximum number of Newton's iterations, and the tolerance of the last one: its largest displacement over the largest
#: displacement.
ITERATIONS, SMALL = 20, 1e-13
#: Newton's method squares the error, so after a step below this only rounding is left: of bodies whose stiffness jumps
#: by factors of a million, more than ``SMALL``. Then the method ends once a step is more than half of the one before.
ROUNDED = 1e-8


class HostContact(Protocol):
    """Contact of one world in float64, such as ``gradients.contact.PreciseContact``, which explains the
    members."""

    count: int
    pushes: Array

    def gaps(self, u: Array) -> Array: ...

    def normals(self, u: Array) -> Any: ...

    def turning(self, u: Array, pushes: Array) -> Any: ...


class PreciseRest:
    """Moves a body from a state of rest in float32 to the one in float64.

    Args:
        body: The body; some nodes of each world must be held. Its displacements become the answer, rounded.
        field: Its elastic forces.
        law: The model.
        loads: Loads and weight [N], float64 [worlds * N, 3].
        contacts: The contact of each world, if there is any.

    Attributes:
        elements: The elements of each world.
        u: Displacements [m], float64 [worlds, N, 3].
        held: Whether nodes are held, bool [worlds, N].
        free: Free entries of each world's displacements, int64 each.
        factors: The stiffness and its factors at free entries, of each world. With contact, unknowns are the free
            entries and the opposites of forces of contact.
        pushes: The forces of contact of each world [N].
        iterations: Newton's iterations of the world that needed most.
        correction: The largest displacement of the last iteration over the largest displacement.
        residual: The norm of the unbalanced forces over that of loads and reactions, of the world where it is largest.

    Raises:
        InputError: The model or the material does not exist in float64.
        ConvergenceError: Newton's method does not converge from the present state, the stiffness is singular, or an
            element is crushed so far that it has no rotation.
    """

    def __init__(
        self, body: SoftBody, field: ForceField, law: Model, loads: Array, contacts: Sequence[HostContact] = ()
    ):
        self._contacts = contacts
        self.pushes = [each.pushes for each in contacts]
        of_float64 = checked_float64_law(body, law)
        shared = SharedDilatation(field) if isinstance(field, DilatationField) else None
        worlds, count = body.worlds, body.sizes.nodes
        self.elements = [PreciseElements(body, of_float64, shared, world) for world in range(worlds)]
        self._loads = loads.reshape(worlds, -1, 3)
        self.held = body.conditions.held_mask().reshape(worlds, -1)
        # Free nodes of no element stay where they are.
        self.free = [
            np.flatnonzero(np.repeat(~held & (masses > 0.0), 3))
            for held, masses in zip(self.held, body.masses.reshape(worlds, -1), strict=True)
        ]
        start = body.state.displacements.numpy()[:count, :3].astype(np.float64).reshape(worlds, -1, 3)
        self.u = np.empty_like(start)
        self.factors: list[tuple[Any, SuperLU]] = []
        self.iterations, self.correction, self.residual = 0, 0.0, 0.0
        for world in range(worlds):
            self.u[world] = self._solved(world, start[world])
        body.displacements = self.u.reshape(-1, 3)

    def _solved(self, world: int, u: Array) -> Array:
        free, before = self.free[world], np.inf
        for number in range(ITERATIONS):
            step = np.zeros(u.size)
            left = self._unbalanced(world, u).ravel()[free]
            if self._touches(world):
                left = np.concatenate([left, -self._contacts[world].gaps(u)])
            found = self._factored(world, u).solve(left)
            step[free] = found[: len(free)]
            if self._touches(world):
                self.pushes[world] = self.pushes[world] - found[len(free) :]
            u = u + step.reshape(u.shape)
            longest, most = np.abs(step).max(), np.abs(u).max()
            if not longest > SMALL * most or ROUNDED * most > before < 2.0 * longest:
                self.factors.append((self._stiffness(world, u), self._factored(world, u)))
                self._measure(world, u, number + 1, longest)
                return u
            before = longest
        raise ConvergenceError("Newton's method in float64 does not converge from the answer of float32")

    def _unbalanced(self, world: int, u: Array) -> Array:
        """Elastic forces and loads [N], [N, 3]; reactions are their opposites."""
        found = self.elements[world].forces(u) + self._loads[world]
        if self._touches(world):
            found = found + (self._contacts[world].normals(u) @ self.pushes[world]).reshape(-1, 3)
        return found

    def _touches(self, world: int) -> bool:
        return bool(self._contacts) and self._contacts[world].count > 0

    def _stiffness(self, world: int, u: Array) -> Any:
        """K, and the turning of contacts' normals."""
        found = self.elements[world].stiffness(u)
        return found + self._contacts[world].turning(u, self.pushes[world]) if self._touches(world) else found

    def _measure(self, world: int, u: Array, iterations: int, step: float) -> None:
        left, size = self._unbalanced(world, u).ravel(), np.abs(u).max()
        of_free = np.linalg.norm(left[self.free[world]])
        compared = np.hypot(np.linalg.norm(self._loads[world]), np.linalg.norm(left))
        self.iterations = max(self.iterations, iterations)
        self.correction = max(self.correction, float(step / size) if size > 0.0 else 0.0)
        self.residual = max(self.residual, float(of_free / compared) if compared > 0.0 else 0.0)

    def _factored(self, world: int, u: Array) -> SuperLU:
        free = self.free[world]
        matrix = self._stiffness(world, u)[free][:, free]
        if self._touches(world):
            normals = self._contacts[world].normals(u)[free]
            matrix = block_array([[matrix, normals], [normals.T, None]])
        try:
            return splu(matrix.tocsc())
        except RuntimeError:
            raise ConvergenceError("the stiffness is singular: the state of rest has no gradient") from None


def checked_float64_law(body: SoftBody, law: Model) -> IsotropicLaw:
    """The law in float64.

    Raises:
        InputError: The law does not exist in float64.
    """
    found = float64_law(law)
    if found is None or not isinstance(body.material, Isotropic):
        raise InputError(
            "precision is 'float64'; it needs an isotropic material and Linear, Corotated, StVenantKirchhoff, "
            "NeoHookean or EdgeStVK with biquadratic springs"
        )
    return found
