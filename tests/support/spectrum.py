"""The largest frequency of a strained body in float64, and with it the largest stable step about that state.

Small motions d about a state x obey M d'' = -K(x) d, where K is the derivative of the elastic forces. Central
differences in time stay bounded while dt < 2 / omega, with omega^2 the largest eigenvalue of M^-1 K. K comes from the
oracle: its exact tangents where it has them, central differences of its forces where it does not. 3,000 elements take
0.1 to 0.3 s.
"""

from dataclasses import dataclass

import numpy as np
import oracle
from scipy.sparse import coo_matrix, diags
from scipy.sparse.linalg import eigs, eigsh

#: Central differences move nodes by this fraction of the size of their element. Their error is about its square, 1e-8;
#: rounding adds 1e-12, and 1e-6 where the forces are differences themselves (anisotropic).
STEP = 1e-4


@dataclass
class Exploded:
    """Each element with separate nodes, so that one evaluation moves the same node of all elements at once."""

    mesh: oracle.Mesh

    def __post_init__(self):
        count = len(self.mesh.tets)
        self.apart = oracle.Mesh(self.mesh.points[self.mesh.tets.ravel()], np.arange(4 * count).reshape(count, 4))
        self.steps = STEP * np.cbrt(self.mesh.volumes)[:, None, None]

    def derivative(self, forces, corners):
        """-df/dx [T, 12, 3 n] of element forces [T, 4, 3], a function of corners [T, n, 3]."""
        count, n, _ = corners.shape
        found = np.empty((count, 12, 3 * n))
        for column in range(3 * n):
            step = np.zeros((1, n, 3))
            step[0].flat[column] = 1.0
            ahead, behind = (forces(corners + sign * self.steps * step) for sign in (1, -1))
            found[:, :, column] = ((behind - ahead) / (2 * self.steps)).reshape(count, 12)
        return found


def stiffness(law, mesh, x, mu, lam):
    """Sparse -df/dx [3 N, 3 N] (N/m) at positions x [N, 3].

    Args:
        law: A name of ``oracle.MODELS``, or a density like ``oracle.DENSITIES``, for instance ``oracle.anisotropic``
            with its C [T, 3, 3, 3, 3] in the place of mu.
    """
    if law in oracle.TANGENTS:
        return oracle.tangent_matrix(law, mesh, x, mu, lam)
    exploded = Exploded(mesh)

    def forces(corners):
        positions = corners.reshape(-1, 3)
        if callable(law):
            found = oracle.continuum(law, exploded.apart, positions, mu, lam)[1]
        else:
            found = oracle.evaluate(law, exploded.apart, positions, mu, lam)[1]
        return found.reshape(-1, 4, 3)

    blocks = exploded.derivative(forces, np.asarray(x, float)[mesh.tets])
    return _assemble(blocks, mesh.tets, mesh.tets, len(mesh.points))


def shared_stiffness(ancestors, mesh, x, mu, lam):
    """The same for the corotated law with the rotations of ancestors [T, 4] (nodes); it is not symmetric."""
    exploded = Exploded(mesh)
    owners = oracle.Mesh(mesh.points[ancestors.ravel()], exploded.apart.tets)
    turns = oracle.polar(owners.deformation_gradients(owners.points))  # the identity, in the right shape

    def forces(corners):
        turns[:] = oracle.polar(owners.deformation_gradients(corners[:, 4:].reshape(-1, 3)))
        own = corners[:, :4].reshape(-1, 3)
        return oracle.evaluate("corotated", exploded.apart, own, mu, lam, R=turns)[1].reshape(-1, 4, 3)

    nodes = np.concatenate([mesh.tets, ancestors], axis=1)
    blocks = exploded.derivative(forces, np.asarray(x, float)[nodes])
    return _assemble(blocks, mesh.tets, nodes, len(mesh.points))


def largest_frequency(K, masses, free=None):
    """The largest omega [rad/s] of M d'' = -K d with lumped masses [N] (kg) and free nodes (mask [N]; None for all).

    If K is not symmetric, the eigenvalue with the largest real part is used.
    """
    free = np.ones(len(masses), bool) if free is None else np.asarray(free)
    free = np.repeat(free & (np.asarray(masses) > 0), 3)
    root = diags(1 / np.sqrt(np.repeat(masses, 3)[free]))
    A = (root @ K.tocsr()[free][:, free] @ root).tocsr()
    start = np.random.default_rng(0).standard_normal(A.shape[0])
    if A.shape[0] < 60:
        value = np.linalg.eigvals(A.toarray()).real.max()
    elif abs(A - A.T).max() <= 1e-6 * abs(A).max():
        value = eigsh(A, k=1, which="LA", v0=start, ncv=40, tol=1e-6, return_eigenvectors=False)[0]
    else:
        value = eigs(A, k=1, which="LR", v0=start, ncv=40, tol=1e-6, return_eigenvectors=False)[0].real
    return float(np.sqrt(max(value, 0.0)))


def stable_step(law, body, ancestors=None):
    """The largest stable step [s] of a body (one world) about its current displacements, 2 / omega.

    Args:
        law: As in ``stiffness``.
        ancestors: Nodes of each element's ancestor [T, 4] if rotations are shared.
    """
    mesh = oracle.Mesh(body.mesh.points, body.mesh.tets)
    x = mesh.points + body.displacements.numpy().astype(float)
    # The solver's own mu and lambda: with the filled fraction of each element.
    mu, lam = (
        a.numpy().astype(float) if body.discretization.material_stride else float(a.numpy()[0])
        for a in (body.discretization.mu, body.discretization.lam)
    )
    state = mesh, x, mu, lam
    K = stiffness(law, *state) if ancestors is None else shared_stiffness(ancestors, *state)
    omega = largest_frequency(K, body.masses, ~body.constrained)
    return 2 / omega if omega > 0 else np.inf


def _assemble(blocks, rows, columns, nodes):
    """Sum of blocks [T, 3 a, 3 b] at the nodes rows [T, a] and columns [T, b]; sparse [3 N, 3 N]."""
    i, j = ((3 * each[:, :, None] + np.arange(3)).reshape(len(each), -1) for each in (rows, columns))
    i, j = np.broadcast_arrays(i[:, :, None], j[:, None, :])
    return coo_matrix((blocks.ravel(), (i.ravel(), j.ravel())), shape=(3 * nodes, 3 * nodes)).tocsr()
