"""Line searches of implicit steps; see ``kernels.newton.line_search``."""

from __future__ import annotations

import warp as wp

from warp_corot.kernels.newton import line_search as kernels
from warp_corot.solvers.implicit.sums import WorldSums

from .links import LinkForces
from .unknowns import Unknowns

#: Shares that are tried, with 0 and 1.
TRIALS = 10


class LineSearch:
    """Finds how much of a change of the motions to take, in each world.

    Args:
        unknowns: The entries of vectors.
        links: Contacts and attachments.
        device: Where.
    """

    def __init__(self, unknowns: Unknowns, links: LinkForces, device: wp.Device):
        self._unknowns, self._links, self.device = unknowns, links, device
        self._power, self._loss = (WorldSums(unknowns.worlds, unknowns.count, 1, device) for _ in range(2))
        self._search = wp.zeros((unknowns.worlds, kernels.COLUMNS), dtype=wp.float64, device=device)
        self._slopes = wp.zeros(unknowns.worlds, dtype=wp.float64, device=device)

    def launch(self, rest: wp.array, product: wp.array, change: wp.array, d: wp.array) -> None:
        """Launch d += share of the change.

        Args:
            rest: b - A d, where A has no links.
            product: A change.
            change: The change, zero at entries that are not free.
            d: Motions.
        """
        self._power.launch_products(change, rest, 0)
        self._loss.launch_products(change, product, 0)
        lanes = self._power.lanes
        inputs = [self._power.parts, self._loss.parts, lanes]
        dim = (self._unknowns.worlds, lanes)
        wp.launch(kernels.begin_search, dim, inputs, [self._search, self._slopes], device=self.device)
        for number in range(TRIALS):
            self._links.add_slopes(d, change, self._search, self._slopes)
            self._launch(kernels.take_trial, self._unknowns.worlds, [number, self._search, self._slopes])
        inputs = [self._search, self._unknowns.count, change, d]
        self._launch(kernels.add_share, len(self._unknowns), inputs)

    def _launch(self, kernel: wp.Kernel, dim: int, inputs: list) -> None:
        wp.launch(kernel, dim, inputs, device=self.device)
