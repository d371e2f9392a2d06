"""The surfaces of bodies whose parts several ranks hold, on every rank."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.kernels.contact.motion import Surface
from warp_corot.kernels.distributed.exchange import clear_values
from warp_corot.solvers.halo import Halo
from warp_corot.solvers.system import System

from .surface import NO_NODE, ContactSurface

if TYPE_CHECKING:
    from warp_corot.body.soft_body import SoftBody

#: What a surface's struct has besides the nodes.
SHARED = ("world", "rest", "x", "d", "yielding", "f")
#: The arrays of places, or of bearers, that ranks exchange.
EXCHANGED = ("x", "d", "yielding")


class WholeSurface(ContactSurface):
    """The whole surfaces, of which each rank moves some nodes or bearers. All ranks do the same with them.

    Args:
        system: The parts of the bodies that this rank computes.
        are_own, are_close: As for ``ContactSurface``.
    """

    is_whole = True

    def __init__(self, system: System, *, are_own: bool = False, are_close: bool = False):
        self._system = system
        wholes = [system.ranks.owned(body).whole for body in system.bodies]
        super().__init__(wholes, are_own=are_own, are_close=are_close, device=system.device)

    @property
    def own(self) -> Surface:
        return self._own

    @property
    def own_bearers(self) -> Surface:
        return self._own_bearers

    @property
    def solids(self) -> list[tuple[SoftBody, wp.array]]:
        return self._solids

    def complete(self) -> None:
        """Launch the exchange after which every rank has the motion of all places at nodes, and of all bearers."""
        for exchange, arrays in zip(self._exchanges, (self.arrays, self.bearers), strict=True):
            for values in (getattr(arrays, name) for name in EXCHANGED):
                if len(values):
                    exchange(values)

    def _fill(self) -> None:
        super()._fill()
        ranks, self._solids = self._system.ranks, []
        at_places, at_bearers = (_Held(each) for each in (self.arrays, self.bearers))
        for k, (part, whole) in enumerate(zip(self._system.bodies, self.bodies, strict=True)):
            owned = ranks.owned(part)
            numbers, is_own = owned.places, owned.nodes
            number = np.full(whole.node_count, NO_NODE, np.int32)
            number[numbers[is_own]] = np.flatnonzero(is_own)
            rest = whole.state.rest.numpy()[:, :3]
            here = self.parts[k]
            if here.bearers:
                at_bearers.take(here.bearer_start, self.worlds * here.bearers, number, rest)
            else:
                at_places.take(here.start, self.worlds * here.nodes, number, rest)
            of_nodes = np.full(len(part.state.rest), -1, np.int32)
            of_nodes[: len(numbers)] = self.places[k].numpy()[numbers]
            self._solids.append((part, wp.array(of_nodes, dtype=wp.int32, device=self.device)))
        self._own, self._own_bearers = at_places.own(self.device), at_bearers.own(self.device)
        self._exchanges = [ranks.connect(np.arange(len(own)), own) for own in (at_places.moved, at_bearers.moved)]


class _Held:
    """Places of a surface, or its bearers, and which of them this rank moves.

    Args:
        whole: All of them.
    """

    def __init__(self, whole: Surface):
        self._whole, self._node = whole, whole.node.numpy()
        self._found = np.full(len(self._node), NO_NODE, np.int32)
        self._rest = whole.rest.numpy()

    def take(self, start: int, count: int, number: npt.NDArray[np.int32], rest: npt.NDArray[np.float32]) -> None:
        """Take those of a body.

        Args:
            start, count: Where they are.
            number: The number in this rank's part of each node of the whole body, -1 for those of other ranks.
            rest: The rest positions of the nodes [m].
        """
        used = start + np.flatnonzero(self._node[start : start + count] >= 0)
        self._found[used] = number[self._node[used]]
        self._rest[used] = rest[self._node[used]]

    @property
    def moved(self) -> npt.NDArray[np.bool_]:
        """Which of them this rank moves, bool."""
        return self._found >= 0

    def own(self, device: wp.Device) -> Surface:
        """The same arrays with only the nodes that this rank moves, by their numbers in its parts."""
        self._whole.rest.assign(self._rest)
        made = Surface()
        for name in SHARED:
            setattr(made, name, getattr(self._whole, name))
        made.node = wp.array(self._found, dtype=wp.int32, device=device)
        return made


# --- places of other ranks --------------------------------------------------------------------------------------------


class SurfaceHalo:
    """The exchange of values at the places of a surface.

    A rank has all triangles of the bodies' surfaces around its nodes. It finds the forces of obstacles on them from the
    same numbers as the other ranks that have these triangles. Its sums at nodes of other ranks are incomplete and are
    replaced.

    Args:
        ranks: The ranks; alone, nothing is launched.
        surface: This rank's surfaces.

    Attributes:
        ranks: As given.
        exchange: Launches the exchange of an array over the places, of any numbers or vectors.
    """

    def __init__(self, ranks: Halo, surface: ContactSurface):
        self.ranks = ranks
        node = surface.arrays.node.numpy()
        number, own = np.full(len(node), -1, np.int64), np.ones(len(node), bool)
        first = 0
        for k, body in enumerate(() if ranks.is_alone else surface.bodies):
            owned = ranks.owned(body)
            assert owned.numbers is not None
            here = np.arange(len(node))[surface.places_of(k)]
            here = here[node[here] >= 0]
            number[here], own[here] = first + owned.numbers[node[here]], owned.nodes[node[here]]
            first += owned.node_count
        self.exchange = ranks.connect(number, own & (number >= 0))
        self._ghosts = wp.array(np.flatnonzero(~own).astype(np.int32), dtype=wp.int32, device=surface.device)

    def clear(self, forces: wp.array) -> None:
        """Launch the reset to zero of forces on nodes of other ranks: their own ranks add them."""
        if len(self._ghosts):
            wp.launch(clear_values, len(self._ghosts), [self._ghosts], [forces], device=self._ghosts.device)
