"""Forces, stiffness and adjoint work of a body's elements in float64, on the host."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_matrix, diags

from warp_corot.elasticity.float64 import Measured, SharedDilatation, Stresses, stresses
from warp_corot.kernels.elements.simd8 import IsotropicLaw

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
