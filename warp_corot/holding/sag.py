"""How far a body sags if some of its nodes are fixed: linear statics on a coarse grid of cubes, or of its tetrahedra.

On the grid, each cube has the stiffness and the weight of the part of the body inside it. It is a trilinear brick with
incompatible modes (Wilson et al. 1973; Taylor, Beresford and Wilson 1976), so that parts one cube thick bend as they
should.

The simulation uses the body's tetrahedra, too. So with these a thin neck bends and adjacent parts stay apart, which
coarse cubes (`CoarseBody`) do not show. Conjugate gradients are preconditioned by the diagonal and, on a coarse grid of
groups of nodes, by their rigid motions (unsmoothed aggregation; Bulgakov and Kuhn 1995).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.sparse import block_array, coo_array, csr_array, diags_array
from scipy.sparse.linalg import splu
from scipy.spatial import cKDTree

from warp_corot.mesh.topology import signed_volumes

#: Approximate number of full cubes of a body.
CUBES = 1000
#: Samples of the body's volume in each cube.
SAMPLES = 8
#: Larger meshes are thinned out to this number of tetrahedra before they are sampled.
MOST_TETS = 200_000
#: Poisson's ratio of the grid only: volumetric locking would stiffen it, and the sag hardly depends on it.
POISSON = 0.3
#: Conjugate gradients end when this many iterations add less than this fraction to the work of the weights.
LAST, ENOUGH, MOST_ITERATIONS = 20, 3e-3, 1000
#: They also end when the whole body has moved this many times its length.
FAR = 10.0

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Sag:
    """What a fixed body does under an acceleration, in linear statics.

    Attributes:
        largest: Largest displacement of any part [m].
        centre: Displacement of the centre of mass [m], [3].
    """

    largest: float
    centre: Array


class CoarseBody:
    """A body made of cubes.

    Args:
        points: Rest positions [m], [N, 3].
        tets: Tetrahedra of the body, [T, 4].
        volumes: Volume of the body in each [m^3], [T].
        young: Young's modulus [Pa], a number or [T].
        density: Density [kg/m^3], a number or [T].
    """

    def __init__(self, points: Array, tets: npt.NDArray[np.integer], volumes: Array, young: Any, density: Any):
        inside = np.broadcast_to(young, len(tets)), np.broadcast_to(density, len(tets))
        samples, of_tet, shares = _samples(points, tets, volumes)
        # Cubes finer than the mesh's own elements would show motions that the mesh cannot make.
        own = np.average(np.cbrt(6.0 * np.abs(signed_volumes(points, tets))), weights=volumes)
        self.edge = max(float(np.cbrt(volumes.sum() / CUBES)), float(own))
        self._origin = samples.min(axis=0) - 0.5 * self.edge
        cells, cube = np.unique(np.floor((samples - self._origin) / self.edge).astype(int), axis=0, return_inverse=True)
        full = self.edge**3
        cube = cube.ravel()
        stiffness = np.bincount(cube, shares * inside[0][of_tet]) / full * self.edge
        self._masses = np.bincount(cube, shares * inside[1][of_tet])
        corners = cells[:, None] + _CORNERS
        self._lattice, places = np.unique(corners.reshape(-1, 3), axis=0, return_inverse=True)
        self._places = places.reshape(-1, 8)
        used = np.unique(tets)
        self._points = points
        self._nearest = used[cKDTree(points[used]).query(self._origin + self.edge * self._lattice)[1]]
        self.centre = self._masses @ (self._origin + (cells + 0.5) * self.edge) / self._masses.sum()
        self._matrix = self._assembled(stiffness)
        self._weights = np.bincount(self._places.ravel(), np.repeat(self._masses / 8.0, 8))

    def sag(self, held: npt.NDArray[np.integer], accelerations: npt.ArrayLike) -> list[Sag]:
        """The response of the body to each of several accelerations.

        Args:
            held: Indices of the fixed nodes.
            accelerations: [m/s^2], [k, 3].
        """
        free = np.repeat(~self._held(held), 3)
        given = np.asarray(accelerations, dtype=np.float64)
        u = np.zeros((self._matrix.shape[0], len(given)))
        loads = (self._weights[:, None, None] * given.T).reshape(-1, len(given))
        if free.any():
            far = self.edge * float(np.ptp(self._lattice, axis=0).max())
            weights = np.repeat(self._weights, 3)[free]
            u[free] = solved(self._matrix[free][:, free], loads[free], far, weights)
        moved = np.moveaxis(u.reshape(-1, 3, len(given)), 2, 0)
        # Corners of nearly empty cubes are not in the body, so displacements are means over the corners of cubes.
        of_cubes = moved[:, self._places].mean(axis=2)
        lengths = np.linalg.norm(of_cubes, axis=2).max(axis=1)
        centres = np.einsum("c,kcx->kx", self._masses, of_cubes) / self._masses.sum()
        return [Sag(float(length), centre) for length, centre in zip(lengths, centres, strict=True)]

    def _held(self, nodes: npt.NDArray[np.integer]) -> npt.NDArray[np.bool_]:
        """Corners whose nearest node is fixed; if there are none, those next to fixed nodes."""
        mask = np.isin(self._nearest, nodes)
        if not mask.any():
            mask[cKDTree(self._lattice).query((self._points[nodes] - self._origin) / self.edge)[1]] = True
        return mask

    def _assembled(self, stiffness: Array) -> csr_array:
        dofs = (3 * self._places[:, :, None] + np.arange(3)).reshape(-1, 24)
        rows, columns = np.repeat(dofs, 24, axis=1), np.tile(dofs, (1, 24))
        values = stiffness[:, None] * _brick().ravel()
        size = 3 * len(self._lattice)
        return coo_array((values.ravel(), (rows.ravel(), columns.ravel())), shape=(size, size)).tocsr()


_CORNERS = np.array([[i, j, k] for i in (0, 1) for j in (0, 1) for k in (0, 1)])


def _samples(
    points: Array, tets: npt.NDArray[np.integer], volumes: Array
) -> tuple[Array, npt.NDArray[np.integer], Array]:
    """Points spread evenly over the tetrahedra, the tetrahedron of each, and the volume that each represents."""
    stride = max(1, len(tets) // MOST_TETS)
    chosen = np.arange(0, len(tets), stride)
    counts = np.ceil(SAMPLES * CUBES * volumes[chosen] / volumes[chosen].sum()).astype(int)
    counts = np.maximum(counts, 1)
    of_tet = np.repeat(chosen, counts)
    # The additive recurrence R3 (Roberts 2018) in the unit cube, folded into the tetrahedron (Rocchini, Cignoni 2000).
    phi = 1.2207440846057596
    s, t, u = np.modf(0.5 + np.arange(len(of_tet))[:, None] * phi ** -np.arange(1.0, 4.0))[0].T
    over = s + t > 1.0
    s, t = np.where(over, 1.0 - s, s), np.where(over, 1.0 - t, t)
    back, far = t + u > 1.0, s + t + u > 1.0
    s, t, u = (
        np.select([back, far], [s, 1.0 - t - u], s),
        np.select([back, far], [1.0 - u, t], t),
        np.select([back, far], [1.0 - s - t, s + t + u - 1.0], u),
    )
    weights = np.stack([1.0 - s - t - u, s, t, u], axis=1)
    corners = points[tets[of_tet]]
    shares = (volumes[chosen] / counts)[np.repeat(np.arange(len(chosen)), counts)]
    return np.einsum("nc,ncx->nx", weights, corners), of_tet, shares * volumes.sum() / volumes[chosen].sum()


@cache
def _brick() -> Array:
    """Stiffness of the unit cube with Young's modulus one, [24, 24]."""
    mu, lam = 0.5 / (1.0 + POISSON), POISSON / ((1.0 + POISSON) * (1.0 - 2.0 * POISSON))
    law = np.diag([2.0 * mu] * 3 + [mu] * 3)
    law[:3, :3] += lam
    stiffness = np.zeros((33, 33))
    at = np.array([-1.0, 1.0]) / np.sqrt(3.0)
    for place in np.stack(np.meshgrid(at, at, at), axis=-1).reshape(-1, 3):
        signs = 2.0 * _CORNERS - 1.0
        factors = 1.0 + signs * place
        gradients = np.stack([signs[:, a] * factors[:, a - 1] * factors[:, a - 2] for a in range(3)], axis=1) / 4.0
        gradients = np.concatenate([gradients, np.diag(-4.0 * place)])
        strain = np.zeros((6, 33))
        for node, (x, y, z) in enumerate(gradients):
            strain[:, 3 * node : 3 * node + 3] = [[x, 0, 0], [0, y, 0], [0, 0, z], [y, x, 0], [0, z, y], [z, 0, x]]
        stiffness += strain.T @ law @ strain / 8.0
    own, coupled, inner = stiffness[:24, :24], stiffness[:24, 24:], stiffness[24:, 24:]
    return own - coupled @ np.linalg.solve(inner, coupled.T)


def solved(
    matrix: csr_array,
    loads: Array,
    far: float,
    weights: npt.NDArray[Any],
    precondition: Callable[[Array], Array] | None = None,
) -> Array:
    """Conjugate gradients for several right-hand sides at once.

    A part that is hardly fixed moves further and further; its iteration ends once its centre of mass is far away.

    Args:
        matrix: [n, n].
        loads: [n, k].
        far: The body's length [m].
        weights: Weight of each degree of freedom in the centre of mass, [n].
        precondition: Preconditioner of residuals [n, k]; None: by the diagonal.
    """
    inverse = 1.0 / matrix.diagonal()[:, None] if precondition is None else 1.0
    prepared = precondition or (lambda r: inverse * r)
    x, r = np.zeros_like(loads), loads.copy()
    p = z = prepared(r)
    rz = np.einsum("nk,nk->k", r, z)
    works: list[Array] = []
    for _ in range(MOST_ITERATIONS):
        q = matrix @ p
        pq = np.einsum("nk,nk->k", p, q)
        alpha = np.divide(rz, pq, out=np.zeros_like(rz), where=pq > 0.0)
        x += alpha * p
        r -= alpha * q
        works.append(np.einsum("nk,nk->k", loads, x))
        settled = len(works) > LAST and (works[-1] - works[-1 - LAST] <= ENOUGH * np.abs(works[-1])).all()
        if settled or (len(works) % LAST == 0 and (weights @ np.abs(x)).max() > FAR * far * weights.sum()):
            break
        z = prepared(r)
        before, rz = rz, np.einsum("nk,nk->k", r, z)
        p = z + np.divide(rz, before, out=np.zeros_like(rz), where=before > 0.0) * p
    return x


#: Meshes with more tetrahedra take too long.
MOST_SOLVED_TETS = 60_000
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
