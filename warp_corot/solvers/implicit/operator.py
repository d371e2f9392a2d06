"""The interface of a linear system for iterative solvers and preconditioners.

Vectors over nodes are ``wp.vec4`` arrays like those of ``body.state.State``: [worlds * nodes], world after world, the
fourth lane zero. Vectors that A and preconditioners are applied to are zero at nodes that are not free. All methods
that take vectors launch kernels and do not wait for the device, so that a solve can be recorded.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import warp as wp

if TYPE_CHECKING:
    pass


class Product(Protocol):
    """A symmetric matrix A as what it does to vectors.

    Attributes:
        device: The device of the arrays.
        worlds: Number of copies of the body, which do not interact.
        node_count: Number of nodes of one world; vectors have ``worlds * node_count`` entries or more.
    """

    @property
    def device(self) -> wp.Device: ...

    @property
    def worlds(self) -> int: ...

    @property
    def node_count(self) -> int: ...

    def apply(self, x: wp.array, y: wp.array) -> None:
        """Launch y = A x; both vec4 [worlds * nodes], different arrays."""
        ...


class LinearOperator(Product, Protocol):
    """A symmetric matrix A = a M + b D + c K at one state of a body: mass, damping and stiffness.

    Rows of nodes that are not free are those of the identity, and their diagonal blocks too.

    Attributes:
        inverse_mass: Zero at nodes that are not free, float32 [worlds * nodes] [1/kg].
        displacements: The displacements of the linearisation, vec4 [worlds * nodes] [m]; they change with each one.
        scales: a [1/s^2], b [1/s] and c, float32 [3] on the device, so that recorded launches stay valid.
        revision: Changes whenever launches do, so that they must be recorded again: other arrays, other elements. A
            new linearisation or new scales do not change it.
    """

    @property
    def inverse_mass(self) -> wp.array: ...

    @property
    def displacements(self) -> wp.array: ...

    @property
    def scales(self) -> wp.array: ...

    @property
    def revision(self) -> int: ...

    def diagonal_blocks(self) -> wp.array:
        """Launch the 3x3 blocks on the diagonal of A, and return their array, mat33 [worlds * nodes]."""
        ...

    def other_blocks(self) -> wp.array:
        """Launch the 3x3 blocks on K's diagonal of forces besides elasticity, and give their array, mat33
        [worlds * nodes], which ``diagonal_blocks`` may use, too; an array of one entry if there are none."""
        ...


class Preconditioner(Protocol):
    """An approximate inverse B of an operator: linear, symmetric and positive definite.

    At nodes that are not free, B keeps the zeros of r.
    """

    def update(self, operator: LinearOperator) -> None:
        """Launch the update after a new linearisation or new scales of the operator."""
        ...

    def apply(self, r: wp.array, z: wp.array) -> None:
        """Launch z = B r; both vec4 [worlds * nodes], different arrays."""
        ...


@dataclass(frozen=True, eq=False)
class Springs:
    """Places between nodes where springs may be, besides an operator.

    Attributes:
        nodes: The nodes that bear each place, numbered in all worlds, -1 for none, vec4i [S].
        weights: Their shares, vec4 [S].
        stiffness: Of the springs there, zero where there is none, mat33 [S] [N/m].
    """

    nodes: wp.array
    weights: wp.array
    stiffness: wp.array
