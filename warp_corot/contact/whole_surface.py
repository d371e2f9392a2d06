"""The surfaces of bodies whose parts several ranks hold, on every rank."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warp_corot.errors import InputError
from warp_corot.kernels.contact.motion import Surface
from warp_corot.solvers.system import System

from .surface import NO_NODE, ContactSurface

if TYPE_CHECKING:
    from warp_corot.body.soft_body import SoftBody

#: What a surface's struct has besides the nodes.
SHARED = ("world", "rest", "x", "d", "yielding", "f")


class WholeSurface(ContactSurface):
    """The whole surfaces, of which each rank moves some nodes. All ranks do the same with them.

    Args:
        system: The parts of the bodies that this rank computes.

    Raises:
        InputError: The bodies are on another device than their parts.
    """

    is_whole = True

    def __init__(self, system: System):
        self._system = system
        wholes = [system.ranks.whole(body) for body in system.bodies]
        if wholes[0].device != system.device:
            raise InputError(
                f"the bodies are on {wholes[0].device}, and their parts on {system.device}; for contact of soft "
                "surfaces on several ranks both must be on one device"
            )
        super().__init__(wholes)

    @property
    def own(self) -> Surface:
        return self._own

    @property
    def solids(self) -> list[tuple[SoftBody, wp.array]]:
        return self._solids

    def complete(self, *values: wp.array) -> None:
        """Launch the exchange after which every rank has the values of all places."""
        for each in values:
            self._system.ranks.complete_surface(each)

    def _fill(self) -> None:
        super()._fill()
        ranks, node = self._system.ranks, self.arrays.node.numpy()
        found, rest = np.full(len(node), NO_NODE, np.int32), self.arrays.rest.numpy()
        self._solids = []
        for k, (part, whole) in enumerate(zip(self._system.bodies, self.bodies, strict=True)):
            numbers, is_own = ranks.numbers(k)
            number = np.full(whole.node_count, NO_NODE, np.int32)
            number[numbers[is_own]] = np.flatnonzero(is_own)
            places = np.arange(len(node))[self.places_of(k)]
            used = places[node[places] >= 0]
            found[used] = number[node[used]]
            rest[used] = whole.state.rest.numpy()[node[used], :3]
            of_nodes = np.full(len(part.state.rest), -1, np.int32)
            of_nodes[: len(numbers)] = self.places[k].numpy()[numbers]
            self._solids.append((part, wp.array(of_nodes, dtype=wp.int32, device=self.device)))
        self.arrays.rest.assign(rest)
        self._own = Surface()
        for name in SHARED:
            setattr(self._own, name, getattr(self.arrays, name))
        self._own.node = wp.array(found, dtype=wp.int32, device=self.device)
        ranks.take_whole_surface(np.flatnonzero(found >= 0).astype(np.int32))
