"""Contact with planes and balls in float64, on the host."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.sparse import csc_array, csr_array

from warp_corot.contact.shapes import Ground, Shape, Sphere, axis_of
from warp_corot.errors import InputError

from .contact import Column, RestingContact, normals_of, turning_of

Array = npt.NDArray[np.float64]


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
