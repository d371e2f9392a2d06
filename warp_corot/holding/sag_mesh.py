"""How far a body sags if some of its nodes are fixed: linear statics of its own tetrahedra.

The simulation uses the same tetrahedra, so a thin neck bends and adjacent parts stay apart, which coarse cubes
(`sag.CoarseBody`) do not show. Conjugate gradients are preconditioned by the diagonal and, on a coarse grid of
groups of nodes, by their rigid motions (unsmoothed aggregation; Bulgakov and Kuhn 1995).
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.sparse import block_array, csr_array, diags_array
from scipy.sparse.linalg import splu

from .sag import POISSON, Array, Sag, solved

#: Meshes with more tetrahedra take too long.
MOST_TETS = 60_000
#: Approximate number of groups of nodes.
GROUPS = 400
#: The largest displacement is a quantile: this fraction of the weight moves by less. The rest may be crumbs with
#: a weak connection; they dangle and say nothing about how the body is fixed.
SHARE = 0.999
#: Regularization of the rotations of a group whose nodes lie on a line, relative to the diagonal.
SHIFT = 1.0e-8


class MeshBody:
    """A body with its own mesh.

    Args:
        points: Rest positions [m], [N, 3].
        tets: Tetrahedra of the body, [T, 4].
        volumes: Volume of the body in each [m^3], [T].
        young: Young's modulus [Pa], a number or [T].
        density: Density [kg/m^3], a number or [T].
    """

    def __init__(self, points: Array, tets: npt.NDArray[np.integer], volumes: Array, young: Any, density: Any):
        self._used, local = np.unique(tets, return_inverse=True)
        self._tets = local.reshape(-1, 4)
        self._x = points[self._used]
        self._masses = np.broadcast_to(density, len(tets)) * volumes
        count = len(self._used)
        self._weights = np.bincount(self._tets.ravel(), np.repeat(self._masses / 4.0, 4), count)
        self.centre = self._weights @ self._x / self._weights.sum()
        self._matrix = _stiffness(self._x, self._tets, np.broadcast_to(young, len(tets)) * volumes)
        self._motions = _rigid_motions(self._x, float(np.cbrt(volumes.sum() / GROUPS)))

    def sag(self, held: npt.NDArray[np.integer], accelerations: npt.ArrayLike) -> list[Sag]:
        """The response of the body to each of several accelerations.

        Args:
            held: Indices of the fixed nodes.
            accelerations: [m/s^2], [k, 3].
        """
        free = np.flatnonzero(np.tile(~np.isin(self._used, held), 3))
        given = np.asarray(accelerations, dtype=np.float64)
        loads = (given.T[:, None] * self._weights[:, None]).reshape(-1, len(given))
        moved = np.zeros((len(loads), len(given)))
        if len(free):
            matrix, motions = self._matrix[free][:, free], self._motions[free]
            far = float(np.linalg.norm(np.ptp(self._x, axis=0)))
            moved[free] = solved(
                matrix, loads[free], far, np.tile(self._weights, 3)[free], _preconditioner(matrix, motions)
            )
        of_nodes = moved.reshape(3, -1, len(given)).transpose(2, 1, 0)
        return [Sag(self._largest(u), self._weights @ u / self._weights.sum()) for u in of_nodes]

    def _largest(self, of_nodes: Array) -> float:
        lengths = np.linalg.norm(of_nodes[self._tets].mean(axis=1), axis=1)
        order = np.argsort(lengths)
        summed = np.cumsum(self._masses[order])
        return float(lengths[order[np.searchsorted(summed, SHARE * summed[-1])]])


def _stiffness(points: Array, tets: npt.NDArray[np.integer], moduli: Array) -> csr_array:
    """Stiffness of linear tetrahedra, all x, all y, all z, [3 N, 3 N]; ``moduli``: Young's times volumes [N m]."""
    mu, lam = 0.5 / (1.0 + POISSON), POISSON / ((1.0 + POISSON) * (1.0 - 2.0 * POISSON))
    count, slopes = len(tets), _slopes(points[tets])
    places = np.repeat(np.arange(count), 4), tets.ravel()
    along = [csr_array((slopes[:, :, a].ravel(), places), shape=(count, len(points))) for a in range(3)]
    weighted = [diags_array(moduli) @ g for g in along]
    m = [[(along[a].T @ weighted[b]).tocsr() for b in range(3)] for a in range(3)]
    trace = mu * (m[0][0] + m[1][1] + m[2][2])
    blocks = [[lam * m[a][b] + mu * m[b][a] + (trace if a == b else 0.0 * trace) for b in range(3)] for a in range(3)]
    return block_array(blocks, format="csr")


def _slopes(corners: Array) -> Array:
    """Gradients of the four corners' linear functions, [T, 4, 3]; zero where a tetrahedron is flat."""
    a, b, c = (corners[:, n] - corners[:, 0] for n in (1, 2, 3))
    normals = np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)], axis=1)
    volumes = np.einsum("ij,ij->i", a, normals[:, 0])[:, None, None]
    found = np.divide(normals, volumes, out=np.zeros_like(normals), where=volumes != 0.0)
    return np.concatenate([-found.sum(axis=1, keepdims=True), found], axis=1)


def _rigid_motions(points: Array, edge: float) -> csr_array:
    """The six rigid motions of groups of nodes, one group for each cube of an edge [m], [3 N, 6 groups]."""
    cubes = np.floor((points - points.min(axis=0)) / edge).astype(int)
    _, group = np.unique(cubes, axis=0, return_inverse=True)
    group = group.ravel()
    node, sizes = np.arange(len(points)), np.bincount(group)
    centres = np.stack([np.bincount(group, points[:, a]) / sizes for a in range(3)], axis=1)
    arm = (points - centres[group]) / edge
    rows, columns, values = [], [], []
    for a in range(3):
        b, c = (a + 1) % 3, (a + 2) % 3
        rows += [a * len(points) + node, c * len(points) + node, b * len(points) + node]
        columns += [6 * group + a, 6 * group + 3 + a, 6 * group + 3 + a]
        values += [np.ones(len(points)), arm[:, b], -arm[:, c]]
    places = np.concatenate(rows), np.concatenate(columns)
    return csr_array((np.concatenate(values), places), shape=(3 * len(points), 6 * len(sizes)))


def _preconditioner(matrix: csr_array, motions: csr_array) -> Any:
    diagonal = matrix.diagonal()
    inverse = np.divide(1.0, diagonal, out=np.zeros_like(diagonal), where=diagonal > 0.0)[:, None]
    coarse = motions.T @ matrix @ motions
    scale = coarse.diagonal()
    # Groups with all nodes fixed have no motions.
    coarse = coarse + diags_array(np.where(scale > 0.0, SHIFT * scale, 1.0) + SHIFT**2 * scale.max())
    factors = splu(coarse.tocsc())
    return lambda r: inverse * r + motions @ factors.solve(motions.T @ r)
