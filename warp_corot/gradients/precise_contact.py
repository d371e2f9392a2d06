"""Contact with planes and balls in float64, on the host."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_array, csr_array

from warp_corot.contact.reading import Touch
from warp_corot.contact.shapes import Ground, Shape, Sphere
from warp_corot.errors import InputError

if TYPE_CHECKING:
    from .touching import RestingContact

Array = npt.NDArray[np.float64]


class Row(NamedTuple):
    """A direction in which a place cannot move.

    Attributes:
        obstacle: The number of the obstacle.
        shape: The shape, or None if friction holds the place.
        direction: The direction in float32's answer, [3].
        nodes, shares: The nodes of one world that carry the place, and their shares.
        at: The place where friction holds it [m], [3].
        push: The force along the direction in float32's answer [N].
    """

    obstacle: int
    shape: Shape | None
    direction: Array
    nodes: npt.NDArray[np.integer]
    shares: Array
    at: Array
    push: float


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
        self.rows = [row for found, row in self._all_rows(resting) if found == world]
        self.count = len(self.rows)
        self.pushes = np.array([row.push for row in self.rows])

    def _all_rows(self, resting: RestingContact) -> list[tuple[int, Row]]:
        found, count = [], len(self._rest)
        for touch, direction, yields, (numbers, weights) in resting.described():
            if not isinstance(touch, Touch) or len(touch.places) > 1:
                raise InputError("precision is 'float64'; contact must be at nodes, with obstacles")
            shape = self._shapes[touch.obstacle] if yields else None
            if not isinstance(shape, Ground | Sphere | None):
                raise InputError(
                    f"precision is 'float64'; obstacles must be Ground or Sphere, and {touch.obstacle} is {shape!r}"
                )
            push = float(touch.force @ direction)
            row = Row(touch.obstacle, shape, direction, numbers % count, weights[0], touch.point, push)
            found.append((int(numbers[0]) // count, row))
        return found

    def gaps(self, u: Array) -> Array:
        """The gaps at displacements u [m], [m]."""
        return np.array([self._at(row, u)[0] for row in self.rows])

    def normals(self, u: Array) -> csr_array:
        """N, [3 N, m]."""
        entries = [
            ((3 * row.nodes[:, None] + np.arange(3)).ravel(), i, np.outer(row.shares, self._at(row, u)[1]).ravel())
            for i, row in enumerate(self.rows)
        ]
        lines, columns, values = (
            np.concatenate([np.broadcast_to(each[k], each[0].shape) for each in entries]) for k in range(3)
        )
        return coo_array((values, (lines, columns)), shape=(u.size, self.count)).tocsr()

    def turning(self, u: Array, pushes: Array) -> csr_array:
        """G, [3 N, 3 N]."""
        lines, columns, values = [], [], []
        for row, push in zip(self.rows, pushes, strict=True):
            own = (3 * row.nodes[:, None] + np.arange(3)).ravel()
            block = np.kron(np.outer(row.shares, row.shares), -push * self._at(row, u)[2])
            lines.append(np.repeat(own, len(own)))
            columns.append(np.tile(own, len(own)))
            values.append(block.ravel())
        lines_, columns_, values_ = (np.concatenate(each) for each in (lines, columns, values))
        return coo_array((values_, (lines_, columns_)), shape=(u.size, u.size)).tocsr()

    def of_obstacles(self, u: Array, pushes: Array, motion: Array, multipliers: Array) -> Array:
        """The derivative with respect to the places of obstacles, [obstacles, 3], from an adjoint motion [N, 3]."""
        found = np.zeros((len(self._shapes), 3))
        for row, push, multiplier in zip(self.rows, pushes, multipliers, strict=True):
            _, normal, bend = self._at(row, u)
            found[row.obstacle] += multiplier * normal - push * bend @ (row.shares @ motion[row.nodes])
        return found

    def _at(self, row: Row, u: Array) -> tuple[float, Array, Array]:
        """The gap of a row, and its first and second derivative with respect to the place."""
        x = row.shares @ (self._rest + u)[row.nodes]
        if row.shape is None:
            return float(row.direction @ (x - row.at)), row.direction, np.zeros((3, 3))
        away = x - row.shape.position
        if isinstance(row.shape, Ground):
            up = _axis(row.shape)
            return float(up @ away), up, np.zeros((3, 3))
        distance = float(np.linalg.norm(away))
        normal = away / distance
        return distance - row.shape.size[0], normal, (np.eye(3) - np.outer(normal, normal)) / distance


def _axis(shape: Shape) -> Array:
    """The z axis of a shape's frame, [3]."""
    x, y, z, w = np.asarray(shape.quaternion, np.float64)
    return np.array((2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)))
