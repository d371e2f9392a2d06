"""What implicit steps ask of contact and of grasps."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Protocol

import warp as wp

from warp_corot.kernels.implicit.assembled import Couplings

from .operator import Springs

if TYPE_CHECKING:
    from warp_corot.body.soft_body import SoftBody


class HeldNodes(Protocol):
    """Nodes that are held along directions, by ``contact.active_set.ActiveSet``, which explains the members."""

    def launch_again(self) -> None: ...

    def launch_yielding(self, v: wp.array) -> None: ...


class ObstacleContact(Protocol):
    """Contact with obstacles, which holds nodes (``contact.active_set.ActiveSet``, which explains the members), or only
    consists of springs (``contact.borne_set.BorneSet``).
    """

    changed: wp.array

    @property
    def count(self) -> int: ...

    @property
    def nodes(self) -> HeldNodes | None:
        """The nodes that are held; None if none ever are."""
        ...

    @property
    def springs(self) -> Springs | None:
        """Springs that a preconditioner may take into account, if there are any."""
        ...

    def prepare(self) -> None: ...

    def launch_begin(self, u: wp.array, d: wp.array, blocks: wp.array) -> None: ...

    def launch_imposed(self, d: wp.array) -> None: ...

    def launch_drag(self, x: wp.array, y: wp.array) -> None: ...

    def launch_friction(self, d: wp.array, r: wp.array) -> None: ...

    def launch_couplings(self, couplings: Couplings) -> None: ...

    def add_slopes(
        self, d: wp.array, change: wp.array, search: wp.array, slopes: wp.array, *, apart: bool = False
    ) -> None: ...

    def launch_judgement(self, b: wp.array, q: wp.array, d: wp.array) -> None: ...

    def launch_going(self, d: wp.array, locates: wp.array, rounds: wp.array, most: int, going: wp.array) -> None: ...

    def launch_end(self, d: wp.array) -> None: ...

    def launch_meetings(self, met: wp.array, begins: wp.array) -> None: ...


class SoftContact(Protocol):
    """Forces between bodies, such as ``contact.joined_rows.JoinedRows``, which explains the members."""

    locates: wp.array
    solves: wp.array

    @property
    def total(self) -> wp.array: ...

    def prepare(self) -> None: ...

    def launch_begin(self, k: int, first: int, blocks: wp.array, increment: wp.array, guess: wp.array) -> None: ...

    def reserve(self, motion: float) -> None: ...

    def launch_meetings(self, offset: int, touched: Sequence[wp.array], begins: wp.array) -> None: ...

    def launch_touched(self, touched: Sequence[wp.array]) -> None: ...

    def launch_search(self, offset: int) -> None: ...

    def launch_first(self, d: wp.array) -> None: ...

    def launch_located(self, d: wp.array) -> None: ...

    def launch_searched_again(self, d: wp.array, rounds: wp.array, most: int, again: wp.array) -> None: ...

    def update(self, d: wp.array, *, is_solved: bool = False) -> None: ...

    def find_reached(self, d: wp.array, change: wp.array) -> None: ...

    def add_forces(self, y: wp.array) -> None: ...

    def add_products(self, x: wp.array, y: wp.array) -> None: ...

    def launch_couplings(self, couplings: Couplings) -> None: ...

    def add_slopes(self, d: wp.array, change: wp.array, search: wp.array, slopes: wp.array) -> None: ...

    def launch_end(self, d: wp.array) -> None: ...


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

    def active_set(self, k: int) -> ObstacleContact | None:
        """The contact of the k-th body with obstacles, if there are any."""
        ...

    def joined_rows(self) -> SoftContact | None:
        """The contact of bodies with one another, if they may touch."""
        ...
