"""Contact on several ranks: the surface nodes of a rank's parts, and those of other ranks at its triangles."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from .halo import Halo
from .parts import Part


class SurfacePlaces:
    """The ghosts among the places of a surface, and the ranks that exchange their values.

    A rank has all triangles of the bodies' surfaces around its nodes. It finds the forces of obstacles on them from the
    same numbers as the other ranks that have these triangles. Its sums at ghosts are incomplete and are replaced.

    Args:
        nodes: The node of its part at each place of this rank's surfaces, in all worlds, int32; -1 for unused places.
        places: The places of each part.
        parts: This rank's parts.
        starts: The number of each body's first node among those of all bodies.
        numbers: The numbers of each part's nodes among those of all worlds of its body.
        comm: The ranks.

    Attributes:
        halo: The lists of places to send and to receive.
        ghosts: Places of nodes that other ranks move, int32.
    """

    def __init__(
        self,
        nodes: wp.array,
        places: Sequence[slice],
        parts: Sequence[Part],
        starts: Sequence[int],
        numbers: Sequence[npt.NDArray[np.int64]],
        comm: Any,
    ):
        node = nodes.numpy()
        # Unused places belong to no other rank.
        number = np.iinfo(np.int64).max - np.arange(len(node), dtype=np.int64)
        owner = np.full(len(node), comm.rank)
        for k, part in enumerate(parts):
            own = np.arange(len(node))[places[k]]
            own = own[node[own] >= 0]
            number[own] = starts[k] + numbers[k][node[own]]
            owner[own] = np.tile(part.numbers.owner, part.worlds)[node[own]]
        self.halo = Halo.of(number, owner.astype(np.int32), 1, comm)
        ghosts = np.flatnonzero(owner != comm.rank).astype(np.int32)
        self.ghosts = wp.array(ghosts, dtype=wp.int32, device=nodes.device)
