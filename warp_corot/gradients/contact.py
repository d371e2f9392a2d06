"""Adjoint motions of bodies that rest on obstacles or on themselves: they keep to the surfaces that they touch."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.contact.contacts import Contacts
from warp_corot.contact.obstacles import measured_gaps
from warp_corot.contact.reading import ActingRow, acting_rows
from warp_corot.contact.shapes import Ground, Shape, Sphere, axis_of
from warp_corot.errors import InputError
from warp_corot.kernels.gradients import steps as kernels
from warp_corot.kernels.implicit.tangent import add_products

if TYPE_CHECKING:
    from scipy.sparse import csc_array, csr_array

    from warp_corot.body.soft_body import SoftBody

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

#: The largest number of contacts: the inverse of their matrix is dense.
MOST_ROWS = 4000
#: Eigenvalues of the contacts' matrix below this share of the largest one are of contacts that others contain.
DEPENDENT = 1e-7
#: The step of differences of obstacles' normals, over the size of the body, and that of pairs' over theirs.
STEP, STEP_OF_PAIRS = 1e-3, 1e-5
#: An imaginary step so small that its square is nothing [m].
IMAGINARY = 1e-30
#: Curvature times the size of the body, below which an obstacle is flat.
FLAT = 1e-2
#: The share of Coulomb's bound from which on a contact slips.
SLIPS = 0.999
#: Weights below this are zero: the contact is on an edge or a corner.
LEAST_SHARE = 1e-5


@dataclass(frozen=True)
class Column:
    """A direction in which a contact keeps its nodes.

    Attributes:
        row: The contact.
        normal: The direction, [3].
        yields: Whether the contact may slide across it: friction does not hold it.
        nodes: The nodes that bear its places, numbered over all worlds.
        weights: Their weights in each place, [places, nodes].
    """

    row: ActingRow
    normal: Array
    yields: bool
    nodes: Ints
    weights: Array


class RestingContact:
    """The contacts of a body at rest, without friction or with friction that holds them where they are.

    In an equilibrium, forces f(x) + sum_i l_i grad d_i = 0 and gaps d_i(x) = 0. With the stiffness K, the normals
    N = grad d, and the turning of the normals G = -sum_i l_i grad grad d_i, a change of forces by q moves the nodes by
    dx with (K + G) dx - N dl = q and N^T dx = 0. A contact on a triangle or an edge slides there to where the gap is
    least, which is part of G. A place that friction holds does not move: N has three columns for it, and G nothing.

    Args:
        body: The body.
        contacts: Its contact in the last step.
        rows: What pushes it.
        friction: The coefficient of each obstacle.

    Attributes:
        columns: Those of N.

    Raises:
        InputError: There are more than ``MOST_ROWS`` columns, contacts that slip, or pairs at borders of triangles.
    """

    def __init__(self, body: SoftBody, contacts: Contacts, rows: Sequence[ActingRow], friction: Sequence[float]):
        self._body, self._contacts = body, contacts
        _check_borders(rows)
        self.columns: list[Column] = []
        for row, sticks in zip(rows, sticking(rows, friction), strict=True):
            nodes, weights = self._borne(row)
            directions = np.eye(3) if sticks else row.normal[None] / np.linalg.norm(row.normal)
            self.columns += [Column(row, each, not sticks, nodes, weights) for each in directions]
        if len(self.columns) > MOST_ROWS:
            raise InputError(f"contact has {len(self.columns)} unknowns; gradients take up to {MOST_ROWS}")
        if not self.columns:
            return
        self.obstacle = np.array([column.row.obstacle for column in self.columns])
        self._assemble()

    @property
    def pushes(self) -> bool:
        """Whether there are any contacts."""
        return bool(self.columns)

    def _assemble(self) -> None:
        """Find N, G, the inverse of N^T N at free nodes, and ``_moved``: the nodes of each contact, and the sums of G's
        columns over them, [nodes, 3, 3]."""
        count = self._body.sizes.nodes
        x = self._contacts.surface.arrays.x.numpy().astype(float)
        parts, blocks = [], []
        for column, curvature in zip(self.columns, self._curvatures(), strict=True):
            row, normal = column.row, column.normal
            parts.append((column.nodes, (column.weights.T @ row.weights)[:, None] * normal))
            push = float(row.force @ normal) if column.yields else 0.0
            at = x[row.places]
            bends = pair_hessian(row, at) if row.obstacle < 0 else self._hessian(row, at, normal, curvature)
            spread = np.kron(column.weights, np.eye(3))
            blocks.append((column.nodes, by_nodes(spread.T @ (-push * bends) @ spread)))
        self._moved = [(nodes, block.sum(axis=1)) for nodes, block in blocks]
        self._all_normals, self._turning = normals_of(parts, count), turning_of(blocks, count)
        free = ~self._body.conditions.held_mask()
        self._free_normals = self._all_normals.multiply(np.repeat(free, 3)[:, None]).tocsc()
        # Contacts that others contain share their forces with these.
        square = (self._free_normals.T @ self._free_normals).toarray()
        self._inverse = np.linalg.pinv(square, rcond=DEPENDENT, hermitian=True)
        self._upload(free, joined_parts(parts), joined_blocks(blocks))

    def _borne(self, row: ActingRow) -> tuple[Ints, Array]:
        """The nodes that bear a contact's places, numbered over all worlds, and their weights [places, nodes]."""
        surface, count = self._contacts.surface, self._body.sizes.nodes // self._body.worlds
        found = [surface.nodes_at(np.array([place]), np.ones(1)) for place in row.places]
        nodes = np.unique(np.concatenate([each[2] for each in found]))
        weights = np.zeros((len(found), len(nodes)))
        for line, (_, _, those, shares) in enumerate(found):
            weights[line, np.searchsorted(nodes, those)] = shares
        return nodes + found[0][1] * count, weights

    def _curvatures(self) -> Array:
        """The second derivatives of obstacles' distances at contacts [1/m], [m, 3, 3], by central differences of
        normals; zero for pairs."""
        curvatures = np.zeros((len(self.columns), 3, 3))
        columns = [column for column in self.columns if column.row.obstacle >= 0]
        step = STEP * float(np.ptp(self._body.mesh.points, axis=0).max())
        points = np.array([column.row.point for column in columns]).reshape(-1, 1, 3)
        worlds = [int(column.nodes[0]) * self._body.worlds // self._body.sizes.nodes for column in columns]
        steps = step * np.concatenate([np.eye(3), -np.eye(3)])
        given = [column.row.obstacle for column in columns], worlds, points + steps
        obstacles = self._contacts.obstacles
        found = measured_gaps(obstacles.shapes, obstacles.motions.later, *given)[1].astype(float)
        slopes = (found[:, :3] - found[:, 3:]) / (2.0 * step)
        curvatures[self.obstacle >= 0] = 0.5 * (slopes + np.swapaxes(slopes, 1, 2))
        return curvatures

    def _hessian(self, row: ActingRow, x: Array, normal: Array, curvature: Array) -> Array:
        """The second derivative of the gap with respect to its places x [1/m], [3 places, 3 places]."""
        count = len(row.places)
        found = np.zeros((count, 3, count, 3))
        used = np.flatnonzero(row.weights > LEAST_SHARE)
        shares = row.weights[used]
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

    def _upload(
        self, free: npt.NDArray[np.bool_], parts: tuple[Ints, Ints, Array], blocks: tuple[Ints, Ints, Array]
    ) -> None:
        """Give kernels N and G at free nodes."""
        device, self._rows = self._body.device, kernels.Rows()
        self._launch = partial(wp.launch, device=device)
        couples = free[blocks[0]] & free[blocks[1]] & blocks[2].any(axis=(1, 2))
        which, nodes, values = (a[free[parts[1]]] for a in parts)
        self._rows.row, self._rows.node = (wp.array(a, dtype=wp.int32, device=device) for a in (which, nodes))
        self._rows.part = wp.array(values, dtype=wp.vec3, device=device)
        self._rows.inverse = wp.array(self._inverse, dtype=wp.float64, device=device)
        kinds = (wp.int32, wp.int32, wp.mat33)
        self._couplings = [wp.array(a[couples], dtype=k, device=device) for a, k in zip(blocks, kinds, strict=True)]
        self._along, self._shared = (wp.zeros(len(self.columns), dtype=wp.float64, device=device) for _ in range(2))

    # --- on the device -----------------------------------------------------------------------------------------------

    def launch_free(self, x: wp.array) -> None:
        """Launch the removal of what moves nodes off obstacles or into them."""
        self._along.zero_()
        self._launch(kernels.measure_rows, len(self._rows.node), [self._rows, x, self._along])
        self._launch(kernels.share_rows, len(self._shared), [self._rows, self._along, self._shared])
        self._launch(kernels.remove_rows, len(self._rows.node), [self._rows, self._shared, x])

    def launch_turning(self, x: wp.array, y: wp.array) -> None:
        """Launch y + G x."""
        self._launch(add_products, len(self._couplings[0]), [*self._couplings, x, y])

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
        for i, (nodes, moved) in enumerate(self._moved):
            if self.obstacle[i] >= 0:
                moved_by = np.einsum("ni,nij->j", motion[nodes], moved)
                found[self.obstacle[i]] += multipliers[i] * self.columns[i].normal + moved_by
        return found


class PreciseContact:
    """The contacts of one world in float64.

    Args:
        resting: The contacts in float32.
        shapes: The obstacles.
        rest: Rest positions of a world's nodes [m], [N, 3].
        world: The world.

    Raises:
        InputError: A contact is not one of a node, or a place on an own surface, with a ``Ground`` or a ``Sphere``.
    """

    def __init__(self, resting: RestingContact, shapes: tuple[Shape, ...], rest: Array, world: int):
        self._rest, self._shapes = rest, shapes
        for column in resting.columns:
            if column.row.obstacle < 0 or len(column.row.places) > 1:
                raise InputError("precision is 'float64'; contact must be at nodes, with obstacles")
            shape = shapes[column.row.obstacle]
            if column.yields and not isinstance(shape, Ground | Sphere):
                raise InputError(
                    f"precision is 'float64'; obstacles must be Ground or Sphere, and {column.row.obstacle} is "
                    f"{shape!r}"
                )
        self._columns = [column for column in resting.columns if int(column.nodes[0]) // len(rest) == world]
        self.count = len(self._columns)
        self.pushes = np.array([float(column.row.force @ column.normal) for column in self._columns])

    def gaps(self, u: Array) -> Array:
        """The gaps at displacements u [m], [m]."""
        return np.array([self._at(column, u)[0] for column in self._columns])

    def normals(self, u: Array) -> csc_array:
        """N, [3 N, m]."""
        parts = [(self._nodes(column), np.outer(column.weights[0], self._at(column, u)[1])) for column in self._columns]
        return normals_of(parts, len(self._rest))

    def turning(self, u: Array, pushes: Array) -> csr_array:
        """G, [3 N, 3 N]."""
        blocks = []
        for column, push in zip(self._columns, pushes, strict=True):
            shares = np.outer(column.weights[0], column.weights[0])
            blocks.append((self._nodes(column), shares[:, :, None, None] * (-push * self._at(column, u)[2])))
        return turning_of(blocks, len(self._rest))

    def of_obstacles(self, u: Array, pushes: Array, motion: Array, multipliers: Array) -> Array:
        """The derivative with respect to the places of obstacles, [obstacles, 3], from an adjoint motion [N, 3]."""
        found = np.zeros((len(self._shapes), 3))
        for column, push, multiplier in zip(self._columns, pushes, multipliers, strict=True):
            _, normal, bend = self._at(column, u)
            moved = column.weights[0] @ motion[self._nodes(column)]
            found[column.row.obstacle] += multiplier * normal - push * bend @ moved
        return found

    def _nodes(self, column: Column) -> npt.NDArray[np.int64]:
        """The nodes that bear its place, numbered within the world."""
        return column.nodes % len(self._rest)

    def _at(self, column: Column, u: Array) -> tuple[float, Array, Array]:
        """The gap of a contact, and its first and second derivative with respect to the place; if friction holds this,
        the distance along the direction from where that is."""
        x = column.weights[0] @ (self._rest + u)[self._nodes(column)]
        if not column.yields:
            return float(column.normal @ (x - column.row.point)), column.normal, np.zeros((3, 3))
        shape = self._shapes[column.row.obstacle]
        away = x - shape.position
        if isinstance(shape, Ground):
            up = axis_of(shape.quaternion)
            return float(up @ away), up, np.zeros((3, 3))
        distance = float(np.linalg.norm(away))
        normal = away / distance
        return distance - shape.size[0], normal, (np.eye(3) - np.outer(normal, normal)) / distance


# --- sparse matrices of contacts --------------------------------------------------------------------------------------


def joined_parts(parts: Sequence[tuple[Ints, Array]]) -> tuple[Ints, Ints, Array]:
    """The contact, the node and the part [3] of each entry of N, from the nodes and parts of contacts."""
    which = np.repeat(np.arange(len(parts)), [len(nodes) for nodes, _ in parts])
    return which, np.concatenate([nodes for nodes, _ in parts]), np.concatenate([values for _, values in parts])


def joined_blocks(blocks: Sequence[tuple[Ints, Array]]) -> tuple[Ints, Ints, Array]:
    """The two nodes and the block [3, 3] of each entry of G, from the nodes and blocks [n, n, 3, 3] of contacts."""
    first, second = (np.concatenate([of(nodes, len(nodes)) for nodes, _ in blocks]) for of in (np.repeat, np.tile))
    return first, second, np.concatenate([block.reshape(-1, 3, 3) for _, block in blocks])


def normals_of(parts: Sequence[tuple[Ints, Array]], count: int) -> csc_array:
    """N of ``count`` nodes, [3 count, m]."""
    from scipy.sparse import coo_array

    which, nodes, values = joined_parts(parts)
    places = (3 * nodes[:, None] + np.arange(3)).ravel(), np.repeat(which, 3)
    return coo_array((values.ravel(), places), shape=(3 * count, len(parts))).tocsc()


def turning_of(blocks: Sequence[tuple[Ints, Array]], count: int) -> csr_array:
    """G, [3 count, 3 count]."""
    from scipy.sparse import coo_array

    first, second, values = joined_blocks(blocks)
    axes = np.arange(3)
    places = np.broadcast_arrays(3 * first[:, None, None] + axes[:, None], 3 * second[:, None, None] + axes)
    lines, columns = (each.ravel() for each in places)
    return coo_array((values.ravel(), (lines, columns)), shape=(3 * count, 3 * count)).tocsr()


def by_nodes(matrix: Array) -> Array:
    """A matrix [3 n, 3 n] as blocks [n, n, 3, 3]."""
    n = len(matrix) // 3
    return matrix.reshape(n, 3, n, 3).swapaxes(1, 2)


# --- rows -------------------------------------------------------------------------------------------------------------


def pair_hessian(row: ActingRow, x: Array) -> Array:
    """The second derivative of a pair's gap with respect to its four places x [1/m], [12, 12], by central differences
    of the first, which is that of an imaginary step."""
    step = STEP_OF_PAIRS * float(np.abs(x - x[0]).max())
    steps = step * np.array([1.0, -1.0])[:, None, None, None] * np.eye(12)[:, None]
    places = (x.ravel() + steps + 1j * IMAGINARY * np.eye(12)).reshape(2, 12, 12, 4, 3)
    ahead, behind = _pair_gap(row, places).imag / IMAGINARY
    found = (ahead - behind) / (2.0 * step)
    return np.asarray(0.5 * (found + found.T))


def _pair_gap(row: ActingRow, x: npt.NDArray[np.complexfloating]) -> npt.NDArray[np.complexfloating]:
    """The gap of a pair at places x [..., 4, 3]: of two lines, or of a point and a plane."""
    corner = 2 if row.first == 2 else 1
    first = x[..., 1, :] - x[..., 0, :] if row.first == 2 else x[..., 2, :] - x[..., 1, :]
    normal = np.cross(first, x[..., 3, :] - x[..., corner, :])
    sign = np.sign(normal.real @ row.normal)
    return sign * np.sum(normal * (x[..., 0, :] - x[..., corner, :]), axis=-1) / np.sqrt(np.sum(normal**2, axis=-1))


def sticking(rows: Sequence[ActingRow], friction: Sequence[float]) -> list[bool]:
    """Whether friction holds each contact.

    Args:
        rows: The contacts.
        friction: The coefficient of each obstacle.

    Raises:
        InputError: It does not hold a contact that has friction.
    """
    sticks, slipping = [], 0
    for row in rows:
        normal = row.normal / np.linalg.norm(row.normal)
        bound = 0.0 if row.obstacle < 0 else friction[row.obstacle]
        push = float(row.force @ normal)
        across = float(np.linalg.norm(row.force - push * normal))
        sticks.append(bound > 0.0)
        slipping += bound > 0.0 and across > SLIPS * bound * push
    if slipping:
        raise InputError(
            f"{slipping} of {len(rows)} contacts slip; gradients need friction that sticks, or friction=0.0"
        )
    return sticks


def _check_borders(rows: Sequence[ActingRow]) -> None:
    """Check that no pairs push at the border of a triangle or at the end of an edge."""
    pairs = [row for row in rows if row.obstacle < 0]
    borders = sum(float(np.abs(row.weights).min()) < LEAST_SHARE for row in pairs)
    if borders:
        raise InputError(
            f"{borders} of {len(pairs)} contacts of the body with itself are at borders of triangles, where gradients "
            "jump"
        )


def rows_after(body: SoftBody, contacts: Contacts) -> list[ActingRow]:
    """The nodes that obstacles have pushed in the last step, where they are at its end.

    Raises:
        InputError: Obstacles push something else: triangles, or places of the body's own surface.
    """
    if contacts.rigid is None:
        return []
    part = contacts.surface.parts[0]
    if part.skin.own is not None:
        raise InputError("obstacles touch the body's own surface; runs need contact at nodes: Contact(on='tetrahedra')")
    rows = list(acting_rows(contacts))
    if any(len(row.places) > 1 for row in rows):
        raise InputError("an obstacle touches triangles between the nodes; runs with gradients need contact at nodes")
    world, at = np.divmod(np.array([int(row.places[0]) for row in rows], int) - part.start, part.nodes)
    nodes = part.skin.nodes[at] + world * body.world_node_count
    x = (body.rest_positions + body.state.displacements.numpy()[: body.sizes.nodes, :3])[nodes]
    given = [row.obstacle for row in rows], world, x[:, None]
    normals = measured_gaps(contacts.obstacles.shapes, contacts.obstacles.motions.later, *given)[1][:, 0].astype(float)
    return [row._replace(point=p, normal=n) for row, p, n in zip(rows, x, normals, strict=True)]
