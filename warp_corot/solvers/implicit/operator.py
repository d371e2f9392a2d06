"""The interfaces of linear systems, preconditioners, contact and grasps for implicit solvers.

Vectors over nodes are ``wp.vec4`` arrays like those of ``body.state.State``: [worlds * nodes], world after world, the
fourth lane zero. Vectors that A and preconditioners are applied to are zero at nodes that are not free. All methods
that take vectors launch kernels and do not wait for the device, so that a solve can be recorded.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import warp as wp

if TYPE_CHECKING:
    from warp_corot.body.soft_body import SoftBody
    from warp_corot.kernels.implicit.assembled import Couplings

    from .tangent import TangentOperator


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


class Preconditioner(Protocol):
    """An approximate inverse B of an operator: linear, symmetric and positive definite.

    At nodes that are not free, B keeps the zeros of r.
    """

    def update(self, operator: TangentOperator) -> None:
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


class SolvedContact(Protocol):
    """Forces as functions of the motions in a step, such as ``ImplicitContact``, which explains the members; some need
    not do anything."""

    changed: wp.array

    def locate(self, d: wp.array) -> None:
        return

    def update(self, d: wp.array, *, is_solved: bool = False) -> None: ...

    def add_forces(self, y: wp.array) -> None: ...

    def add_products(self, x: wp.array, y: wp.array) -> None: ...

    def update_springs(self) -> None:
        return

    def find_reached(self, d: wp.array, change: wp.array) -> None:
        return

    def add_slopes(
        self, d: wp.array, change: wp.array, search: wp.array, slopes: wp.array, *, apart: int | None = None
    ) -> None: ...

    def launch_going(self, d: wp.array, rounds: wp.array, most: int, going: wp.array) -> None: ...

    def launch_end(self, d: wp.array) -> None: ...


class Contact(SolvedContact, Protocol):
    """The contact of all bodies of a system, such as ``contact.implicit.ImplicitContact``, which explains the
    members."""

    couples: bool
    locates: wp.array
    solves: wp.array

    @property
    def total(self) -> wp.array: ...

    def springs(self, k: int) -> Springs: ...

    def places_of(self, k: int) -> int: ...

    def prepare(self) -> None: ...

    def reserve(self, motion: float) -> None: ...

    def launch_onsets(self, offset: int, touched: Sequence[wp.array], begins: wp.array) -> None: ...

    def launch_touched(self, touched: Sequence[wp.array]) -> None: ...

    def launch_begin(self, k: int, first: int, blocks: wp.array, increment: wp.array, guess: wp.array) -> None: ...

    def launch_first(self, offset: int, d: wp.array) -> None: ...

    def add_couplings(self, couplings: Couplings) -> None: ...

    def scale(self, k: int, v: wp.array, *, is_after: bool) -> None: ...

    def launch_searched_again(self, d: wp.array, rounds: wp.array, most: int, again: wp.array) -> None: ...


class Hold(Protocol):
    """A constraint that is a spring in implicit steps, such as ``contact.grasp.Grasp``."""

    def launch_begin(self) -> None:
        """Launch the beginning of a step."""
        ...

    def add_forces(self) -> None: ...

    def add_stiffness(self, body: SoftBody, p: wp.array, y: wp.array) -> None: ...

    def add_diagonal(self, body: SoftBody, blocks: wp.array) -> None: ...

    def launch_held(self, body: SoftBody) -> None:
        """Launch the addition of its forces on a body after the step to those of contact."""
        ...


class Touching(Protocol):
    """A constraint that implicit steps resolve, such as ``contact.contacts.Contacts``."""

    def launch_motion(self, offset: int) -> None:
        """Launch the motion of obstacles in the ``offset``-th step since the clock was last advanced."""
        ...

    def implicit(self) -> Contact | None:
        """The contact of the bodies, if anything may touch."""
        ...
