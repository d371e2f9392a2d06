"""Contact on several ranks: the surface nodes of a rank's parts, and those of other ranks at its triangles."""

from __future__ import annotations

import numpy as np
import warp as wp

from warp_corot.kernels.distributed.exchange import clear_values
from warp_corot.solvers.halo import Halo

from .surface import ContactSurface


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
