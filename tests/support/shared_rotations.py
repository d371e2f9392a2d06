"""Forces of elements that share their ancestors' rotations and the dilatation of groups, in float64 NumPy."""

import numpy as np
import oracle
import shared_dilatation
from scipy.sparse import coo_matrix

FREE, RAMP = 0.25, 0.5


class SharedRotations:
    """The corotated law of a forest with a fixed ``rotation_level``.

    Args:
        forest: A ``TetForest``.
        young, poisson: The material.
        level: Elements share the rotation of their ancestor of this level.
    """

    def __init__(self, forest, young, poisson, level):
        self.mesh = oracle.Mesh(forest.points, forest.tets)
        above, self._of = np.unique(forest.ancestors(level), return_inverse=True)
        self._above = oracle.Mesh(forest.points, forest.tree.tets[above])
        self._mu, self._lam = oracle.lame(young, poisson)
        groups = shared_dilatation.of_forest(forest)
        self._groups, self._weights = groups, groups @ self.mesh.volumes
        corners = self.mesh.tets.size
        places = self.mesh.tets.ravel(), np.arange(corners)
        self._sums = coo_matrix((np.ones(corners), places), (len(self.mesh.points), corners)).tocsr()
        self._areas = np.swapaxes(self.mesh.gradients, 1, 2) * -self.mesh.volumes[:, None, None]

    def __call__(self, x):
        """Nodal forces [N, 3] at positions x [N, 3], and the energy [J]."""
        F = self.mesh.deformation_gradients(x)
        R = oracle.polar(self._above.deformation_gradients(x))[self._of.ravel()]
        stretch = np.swapaxes(R, 1, 2) @ F
        strain = 0.5 * (stretch + np.swapaxes(stretch, 1, 2)) - np.eye(3)
        cofactor = oracle.cofactor(F)
        theta = np.einsum("tij,tij->t", F, cofactor) / 3.0 - 1.0
        shared = self._groups @ (self.mesh.volumes * theta) / self._weights
        beyond = np.maximum(np.abs(theta) - FREE, 0.0)
        far = np.maximum(beyond - RAMP, 0.0)
        holding = np.sign(theta) * (beyond**2 - far**2) / (2.0 * RAMP)
        stress = 2.0 * self._mu * R @ strain
        stress += (self._lam * (self._groups.T @ shared + holding))[:, None, None] * cofactor
        forces = self._sums @ np.swapaxes(stress @ self._areas, 1, 2).reshape(-1, 3)
        energy = self._mu * self.mesh.volumes @ np.sum(strain**2, axis=(1, 2))
        held = self.mesh.volumes @ shared_dilatation.holding(theta)
        return forces, energy + self._lam * (0.5 * self._weights @ shared**2 + held)
