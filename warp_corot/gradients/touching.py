"""Adjoint motions of bodies that rest on obstacles: they keep to the obstacles' surfaces."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.contact.contacts import Contacts
from warp_corot.contact.reading import Touch
from warp_corot.errors import InputError
from warp_corot.kernels.gradients import contact as kernels
from warp_corot.solvers.implicit.operator import LinearOperator, Preconditioner

from .touches import LEAST_SHARE, Array, Ints, Pair, pair_hessian, sticking, unit_normal

if TYPE_CHECKING:
    from scipy.sparse import csr_array

    from warp_corot.body.soft_body import SoftBody

#: The largest number of contacts: the inverse of their matrix is dense.
MOST_ROWS = 4000
#: Eigenvalues of the contacts' matrix below this share of the largest one are of contacts that others contain.
DEPENDENT = 1e-7
#: The step of differences of obstacles' normals, over the size of the body.
STEP = 1e-3
#: Curvature times the size of the body, below which an obstacle is flat.
FLAT = 1e-2


class RestingContact:
    """The contacts of a body at rest, without friction or with friction that holds them where they are.

    In an equilibrium, forces f(x) + sum_i l_i grad d_i = 0 and gaps d_i(x) = 0. With the stiffness K, the normals
    N = grad d, and the turning of the normals G = -sum_i l_i grad grad d_i, a change of forces by q moves the nodes by
    dx with (K + G) dx - N dl = q and N^T dx = 0. A contact on a triangle or an edge slides there to where the gap is
    least, which is part of G. A place that friction holds does not move: N has three columns for it, and G nothing.

    Args:
        body: The body.
        contacts: Its contact in the last step.
        found: Where obstacles push it, and pairs of its own surface that push each other.
        friction: The coefficient of each obstacle.

    Attributes:
        pushes: Whether there are any contacts.
        obstacle: The obstacle of each column of N, int [m]; -1 for pairs.
        normals: The directions of these columns [m, 3].

    Raises:
        InputError: There are more than ``MOST_ROWS`` columns, or contacts that slip.
    """

    def __init__(self, body: SoftBody, contacts: Contacts, found: Sequence[Touch | Pair], friction: Sequence[float]):
        self._body, self._contacts = body, contacts
        sticks = sticking(found, friction)
        touches = [touch for touch, stuck in zip(found, sticks, strict=True) for _ in range(3 if stuck else 1)]
        if len(touches) > MOST_ROWS:
            raise InputError(f"contact has {len(touches)} unknowns; gradients take up to {MOST_ROWS}")
        self.pushes = bool(touches)
        if not self.pushes:
            return
        directions = [
            np.eye(3) if stuck else unit_normal(touch)[None] for touch, stuck in zip(found, sticks, strict=True)
        ]
        self._yields = np.concatenate([np.full(len(each), len(each) == 1) for each in directions])
        self.obstacle = np.array([touch.obstacle for touch in touches])
        self.normals = np.concatenate(directions)
        self._touches = touches
        self._assemble(touches)
        free = np.repeat(~body.conditions.held_mask(), 3)
        self._free_normals = self._all_normals.multiply(free[:, None]).tocsc()
        self._inverse = _inverse((self._free_normals.T @ self._free_normals).toarray())
        self._upload()

    def _assemble(self, touches: list[Touch | Pair]) -> None:
        """The sparse matrices: ``_all_normals`` N [3n, m], ``_turning`` G [3n, 3n], and the sums of G's columns over
        the nodes of each contact, ``_moved`` [m, 3n, 3] as a list."""
        from scipy.sparse import coo_array

        count, m = 3 * self._body.sizes.nodes, len(touches)
        carriers = [self._carried(touch) for touch in touches]
        each_world = self._body.sizes.nodes // self._body.worlds
        curvatures = self._curvatures(touches, np.array([int(nodes[0]) // each_world for nodes, _ in carriers]))
        x = self._contacts.surface.arrays.x.numpy().astype(float)
        entries, blocks, self._moved = [], [], []
        for i, (touch, normal, curvature) in enumerate(zip(touches, self.normals, curvatures, strict=True)):
            nodes, carried = carriers[i]
            rows = (3 * nodes[:, None] + np.arange(3)).ravel()
            entries.append((rows, np.full(len(rows), i), (carried.T @ touch.shares)[:, None] * normal))
            push = float(touch.force @ normal) if self._yields[i] else 0.0
            at = x[touch.places]
            bends = pair_hessian(touch, at) if isinstance(touch, Pair) else self._hessian(touch, at, normal, curvature)
            change = -push * bends
            spread = np.kron(carried, np.eye(3))
            block = spread.T @ change @ spread
            blocks.append((np.repeat(rows, len(rows)), np.tile(rows, len(rows)), block))
            self._moved.append((rows, block.reshape(len(rows), -1, 3).sum(axis=1)))
        of_rows, of_touches, values = (np.concatenate([np.ravel(e[k]) for e in entries]) for k in range(3))
        self._all_normals = coo_array((values, (of_rows, of_touches)), shape=(count, m)).tocsc()
        first, second, values = (np.concatenate([np.ravel(b[k]) for b in blocks]) for k in range(3))
        self._turning: csr_array = coo_array((values, (first, second)), shape=(count, count)).tocsr()

    def described(self) -> Iterator[tuple[Touch | Pair, Array, bool, tuple[Ints, Array]]]:
        """For each column of N what touches, its direction, whether the place may slide, and what carries it."""
        for i, touch in enumerate(self._touches):
            yield touch, self.normals[i], bool(self._yields[i]), self._carried(touch)

    def _carried(self, touch: Touch | Pair) -> tuple[Ints, Array]:
        """The nodes, numbered over all worlds, that carry a contact's places, and the weight of each node [places,
        nodes]."""
        surface, count = self._contacts.surface, self._body.sizes.nodes // self._body.worlds
        found = [surface.nodes_at(np.array([place]), np.ones(1)) for place in touch.places]
        nodes = np.unique(np.concatenate([each[2] for each in found]))
        weights = np.zeros((len(found), len(nodes)))
        for row, (_, _, those, shares) in enumerate(found):
            weights[row, np.searchsorted(nodes, those)] = shares
        return nodes + found[0][1] * count, weights

    def _curvatures(self, all_touches: list[Touch | Pair], worlds: Ints) -> Array:
        """The second derivatives of obstacles' distances at contacts [1/m], [m, 3, 3], by central differences of
        normals; zero for pairs."""
        contacts, device = self._contacts, self._contacts.device
        curvatures = np.zeros((len(all_touches), 3, 3))
        touches = [touch for touch in all_touches if isinstance(touch, Touch)]
        if not touches:
            return curvatures
        with_obstacles = self.obstacle >= 0
        step = STEP * float(np.ptp(self._body.mesh.points, axis=0).max())
        steps = step * np.concatenate([np.eye(3), -np.eye(3)])
        points = np.array([touch.point for touch in touches])[:, None] + steps
        inputs = [
            contacts.obstacles.shapes,
            contacts.obstacles.motions,
            _ints(self.obstacle[with_obstacles], device),
            _ints(worlds[with_obstacles], device),
            wp.array(points, dtype=wp.vec3, device=device),
        ]
        normals = wp.zeros((len(touches), 6), dtype=wp.vec3, device=device)
        wp.launch(kernels.find_normals, normals.shape, inputs, [normals], device=device)
        found = normals.numpy().astype(float)
        slopes = (found[:, :3] - found[:, 3:]) / (2.0 * step)
        curvatures[with_obstacles] = 0.5 * (slopes + np.swapaxes(slopes, 1, 2))
        return curvatures

    def _hessian(self, touch: Touch, x: Array, normal: Array, curvature: Array) -> Array:
        """The second derivative of the gap with respect to its places x [1/m], [3 places, 3 places]."""
        count = len(touch.places)
        found = np.zeros((count, 3, count, 3))
        used = np.flatnonzero(touch.shares > LEAST_SHARE)
        shares = touch.shares[used]
        inner = np.einsum("a,b,ij->aibj", shares, shares, curvature)
        if len(used) > 1:
            along = (x[used[1:]] - x[used[0]]).T
            slide = along.T @ curvature @ along
            values, vectors = np.linalg.eigh(slide)
            size = float(np.ptp(self._body.mesh.points, axis=0).max())
            least = FLAT / size * float((along**2).sum(axis=0).max())
            bent = values > least
            mixed = np.einsum("a,is->ais", shares, curvature @ along)
            mixed[0] -= normal[:, None]
            mixed[1:] += np.eye(len(used) - 1)[:, None] * normal[:, None]
            turned = mixed @ (vectors[:, bent] / np.sqrt(values[bent]))
            inner = inner - np.einsum("aik,bjk->aibj", turned, turned)
        axes = np.arange(3)
        found[np.ix_(used, axes, used, axes)] = inner
        return found.reshape(3 * count, 3 * count)

    def _upload(self) -> None:
        """The same for kernels."""
        device, rows = self._body.device, kernels.Rows()
        by_row = self._by_nodes(self._free_normals)
        rows.starts, rows.nodes = _starts(by_row[0], len(self.obstacle), device), _ints(by_row[1], device)
        rows.parts = wp.array(by_row[2], dtype=wp.vec3, device=device)
        touched = np.unique(by_row[1])
        order = np.argsort(by_row[1], kind="stable")
        rows.touched, rows.of_node, rows.row = (_ints(each, device) for each in (touched, order, by_row[0]))
        rows.node_starts = _starts(np.searchsorted(touched, by_row[1][order]), len(touched), device)
        rows.inverse = wp.array(self._inverse, dtype=wp.float64, device=device)
        blocks = self._turning.tobsr((3, 3))
        starts = np.concatenate([[0], np.cumsum(np.diff(blocks.indptr)[touched])])
        picked = np.concatenate([np.arange(blocks.indptr[n], blocks.indptr[n + 1]) for n in touched]).astype(int)
        rows.block_starts, rows.block_nodes = _ints(starts, device), _ints(blocks.indices[picked], device)
        rows.blocks = wp.array(blocks.data[picked], dtype=wp.mat33, device=device)
        self._rows = rows
        self._along, self._shared = (wp.zeros(len(self.obstacle), dtype=wp.float64, device=device) for _ in range(2))

    @staticmethod
    def _by_nodes(normals: csr_array) -> tuple[Ints, Ints, Array]:
        """The contact, the node and the part of each entry of N, contact by contact."""
        entries = normals.tocoo()
        count = normals.shape[0] // 3
        keys, which = np.unique(entries.col.astype(np.int64) * count + entries.row // 3, return_inverse=True)
        parts = np.zeros((len(keys), 3))
        parts[which.ravel(), entries.row % 3] = entries.data
        return keys // count, keys % count, parts

    # --- on the device -----------------------------------------------------------------------------------------------

    def launch_free(self, x: wp.array) -> None:
        """Launch the removal of what moves nodes off obstacles or into them."""
        device, rows = self._body.device, self._rows
        count = len(self.obstacle)
        wp.launch(kernels.measure_rows, count, [rows, x, self._along], device=device)
        wp.launch(kernels.share_rows, count, [rows, self._along, self._shared], device=device)
        wp.launch(kernels.remove_rows, len(rows.touched), [rows, self._shared, x], device=device)

    def launch_turning(self, x: wp.array, y: wp.array) -> None:
        """Launch y + G x."""
        wp.launch(kernels.add_turning, len(self._rows.touched), [self._rows, x, y], device=self._body.device)

    # --- on the host -------------------------------------------------------------------------------------------------

    def free(self, x: Array) -> Array:
        """x [worlds * N, 3] without what moves nodes off obstacles or into them; see ``multipliers``."""
        return x - (self._free_normals @ self.multipliers(x)).reshape(-1, 3)

    def multipliers(self, x: Array) -> Array:
        """The shares m of the normals N in x, [m]."""
        return self._inverse @ (self._free_normals.T @ x.ravel())

    def turning(self, x: Array) -> Array:
        """G x, [worlds * N, 3]."""
        return (self._turning @ x.ravel()).reshape(-1, 3)

    def reactions(self, multipliers: Array) -> Array:
        """N m, held nodes included, [worlds * N, 3]."""
        return (self._all_normals @ multipliers).reshape(-1, 3)

    def of_obstacles(self, motion: Array, multipliers: Array) -> Array:
        """The derivative with respect to the places of obstacles, [obstacles, 3], from an adjoint motion and its
        multipliers."""
        found = np.zeros((self._contacts.obstacles.count, 3))
        flat = motion.ravel()
        for i, (rows, moved) in enumerate(self._moved):
            if self.obstacle[i] < 0:
                continue
            found[self.obstacle[i]] += multipliers[i] * self.normals[i] + flat[rows] @ moved
        return found


class RestingOperator:
    """S (A + G) of an operator A, for vectors in the range of the projector S that keeps to obstacles."""

    def __init__(self, operator: LinearOperator, contact: RestingContact):
        self._operator, self._contact = operator, contact

    def __getattr__(self, name: str) -> object:
        return getattr(self._operator, name)

    def apply(self, x: wp.array, y: wp.array) -> None:
        self._operator.apply(x, y)
        self._contact.launch_turning(x, y)
        self._contact.launch_free(y)


class RestingPreconditioner:
    """S B S of a preconditioner B; ``update`` is B's."""

    def __init__(self, preconditioner: Preconditioner, contact: RestingContact):
        self._preconditioner, self._contact = preconditioner, contact
        self._r: wp.array | None = None

    def update(self, operator: LinearOperator) -> None:
        self._preconditioner.update(operator)

    def apply(self, r: wp.array, z: wp.array) -> None:
        if self._r is None:
            self._r = wp.zeros_like(r)
        # Rounding moves residuals out of the range of S.
        wp.copy(self._r, r)
        self._contact.launch_free(self._r)
        self._preconditioner.apply(self._r, z)
        self._contact.launch_free(z)


def _inverse(matrix: Array) -> Array:
    """The inverse of N^T N; contacts that others contain share their forces with these."""
    return np.asarray(np.linalg.pinv(matrix, rcond=DEPENDENT, hermitian=True), np.float64)


def _ints(values: npt.ArrayLike, device: wp.Device) -> wp.array:
    return wp.array(values, dtype=wp.int32, device=device)


def _starts(owners: npt.NDArray[np.integer], count: int, device: wp.Device) -> wp.array:
    """Where the entries of each owner begin, for sorted owners."""
    return _ints(np.searchsorted(owners, np.arange(count + 1)), device)
