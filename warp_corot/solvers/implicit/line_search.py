"""Line searches of steps with contacts that open and close; see ``kernels.implicit.line_search``."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

import warp as wp

from warp_corot.kernels.implicit import line_search as kernels
from warp_corot.solvers.halo import ALONE, Halo

from .sums import WorldSums, take_in

if TYPE_CHECKING:
    from .contact_constraints import Contact


class Contacts(Protocol):
    """Forces of contacts as functions of the motions in a step."""

    def add_slopes(self, d: wp.array, change: wp.array, search: wp.array, slopes: wp.array) -> None:
        """Launch the addition of the contacts' power along a change from motions d, at the share in ``search``, to
        ``slopes``, float64 [worlds]."""
        ...


class LineSearch:
    """Finds how much of a change of the motions to take, in each world.

    Args:
        worlds: Number of worlds.
        count: Number of entries of each world.
        contacts: The contacts that open and close.
        device: The device.
    """

    _ranks: Halo = ALONE

    def __init__(self, worlds: int, count: int, contacts: Contacts, device: wp.Device):
        self._worlds, self._count, self._contacts, self.device = worlds, count, contacts, device
        self._power, self._loss = (WorldSums(worlds, count, 1, device, self._ranks) for _ in range(2))
        self._search = wp.zeros((worlds, kernels.COLUMNS), dtype=wp.float64, device=device)
        self._slopes = wp.zeros(worlds, dtype=wp.float64, device=device)
        self._searching = wp.zeros(1, dtype=wp.int32, device=device)

    def _add_slopes(self, d: wp.array, change: wp.array) -> None:
        self._contacts.add_slopes(d, change, self._search, self._slopes)

    def launch(
        self, rest: wp.array, product: wp.array, change: wp.array, d: wp.array, image: wp.array | None = None
    ) -> None:
        """Launch d += share of the change.

        Args:
            rest: b - A d, where A has no contacts.
            product: A times the change.
            change: The change, zero at entries that are not free.
            d: Motions.
            image: A d, which follows.
        """
        self._power.launch_products(change, rest, 0)
        self._loss.launch_products(change, product, 0)
        lanes = self._power.lanes
        inputs = [self._power.parts, self._loss.parts, lanes]
        outputs = [self._search, self._slopes, self._searching]
        wp.launch(kernels.begin_search, (self._worlds, lanes), inputs, outputs, device=self.device)
        wp.capture_while(self._searching, self._try, d=d, change=change)
        for increase, grown in ((change, d), (product, image)):
            if grown is not None:
                inputs = [self._search, self._count, increase, grown]
                self._launch(kernels.add_share, self._worlds * self._count, inputs)

    def _try(self, d: wp.array, change: wp.array) -> None:
        self._add_slopes(d, change)
        self._launch(kernels.take_trial, self._worlds, [self._search, self._slopes, self._searching])

    def _launch(self, kernel: wp.Kernel, dim: int, inputs: list) -> None:
        wp.launch(kernel, dim, inputs, device=self.device)


class SharedLineSearch(LineSearch):
    """A line search of several ranks, all of which find the same share.

    Args:
        worlds, count, contacts, device: As for ``LineSearch``.
        body: The number of the body.
        ranks: The ranks with the other entries of each world.
    """

    def __init__(self, worlds: int, count: int, contacts: Contact, body: int, device: wp.Device, ranks: Halo):
        self._ranks, self._apart, self._body = ranks, contacts, body
        super().__init__(worlds, count, contacts, device)
        # The sums of worlds are in the first places.
        self._addends = wp.zeros(
            (worlds, max(contacts.places_of(body) // worlds, 1), 1), dtype=wp.float64, device=device
        )
        self._slopes = self._addends[:, 0, 0]

    def _add_slopes(self, d: wp.array, change: wp.array) -> None:
        self._addends.zero_()
        self._apart.add_slopes(d, change, self._search, self._addends.flatten(), apart=self._body)
        take_in(self._addends, [0], self._ranks)
