"""Soft surfaces against one another in implicit steps; see ``kernels.contact.joined``."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import warp as wp

from warp_corot.kernels.contact import joined as kernels
from warp_corot.kernels.contact import joined_places as finding
from warp_corot.kernels.contact import meetings
from warp_corot.kernels.contact.law import Law
from warp_corot.kernels.contact.motion import Surface
from warp_corot.kernels.implicit.assembled import Couplings
from warp_corot.solvers.system import System

from .carriers import PlaceCarriers
from .pairs import Pairs

#: Fields of ``Joined`` for places and for pairs.
OF_PLACES = {"start": wp.vec3}
OF_PAIRS = {
    "base": wp.vec3,
    "given": wp.vec3,
    "target": wp.float32,
    "stiffness": wp.float32,
    "multiplier": wp.vec3,
    "most": wp.float32,
    "force": wp.vec3,
    "derivative": wp.mat33,
    "pushed": wp.int32,
    "begun": wp.int32,
    "near": wp.int32,
    "pushing": wp.int32,
    "reached": wp.int32,
}


class JoinedRows:
    """Pairs of soft surfaces as springs between the bodies of an implicit step.

    Args:
        system: The bodies.
        pairs: Pairs of their surfaces.
        law: How fast things that overlap are pushed apart.

    Attributes:
        locates: Whether pairs are located in the next round, int32 [1].
        solves: Number of linear solves that the step has had so far, int32 [1].
        total: Number of pairs, int32 [1].
    """

    def __init__(self, system: System, pairs: Pairs, law: Law):
        self._system, self._pairs, self._law, self.device = system, pairs, law, system.device
        self.locates, self.solves, self._searches = (wp.zeros(1, dtype=wp.int32, device=self.device) for _ in range(3))
        self._made = (-1, -1, -1)
        self._carriers = PlaceCarriers(pairs.surface, system.bodies)
        self._places: Surface | None = None
        self.prepare()

    @property
    def total(self) -> wp.array:
        return self._pairs.rows.total

    def prepare(self) -> None:
        """Take the present surfaces and rooms; not while launches are recorded."""
        self._take_surface()
        self._carriers.follow()
        sizes = (self._pairs.surface.count, self._pairs.room, self._pairs.surface.bearer_count)
        if sizes == self._made:
            return
        self._made, joined = sizes, kernels.Joined()
        for fields, size in ((OF_PLACES, sizes[0]), (OF_PAIRS, sizes[1])):
            for name, dtype in fields.items():
                setattr(joined, name, wp.zeros(size, dtype=dtype, device=self.device))
        joined.locates, joined.solves = self.locates, self.solves
        joined.counts = wp.zeros(3, dtype=wp.int32, device=self.device)
        self._joined = joined
        self._added = wp.zeros(sizes[0], dtype=wp.vec3, device=self.device)
        carriers = len(self._carriers.arrays.entry)
        self._marked = wp.zeros(carriers, dtype=wp.int32, device=self.device)

    def _take_surface(self) -> None:
        """Places of their own, where pairs are located: obstacles find the places where they are when a step begins."""
        arrays = self._pairs.surface.arrays
        if self._places is not None and self._places.rest.ptr == arrays.rest.ptr:
            return
        self._places = Surface()
        for name in ("node", "world", "rest", "d", "yielding", "f", "bearing"):
            setattr(self._places, name, getattr(arrays, name))
        self._places.x = wp.zeros_like(arrays.x)

    def reserve(self, motion: float) -> None:
        """Search for pairs along the way that is expected, from which anything may stray so far in a step [m]."""
        bounds = [self._system.ranks.owned(body).bounds for body in self._system.bodies]
        self._pairs.search.serve_implicit(motion, max(float(np.linalg.norm(high - low)) for low, high in bounds))
        self._pairs.meeting.ahead = self._pairs.search.watch.ahead

    # --- launches ----------------------------------------------------------------------------------------------------

    def launch_meetings(self, offset: int, touched: Sequence[wp.array], begins: wp.array) -> None:
        """Launch the test whether pairs have begun or ceased to push in the last step, or will meet in this one.

        Args:
            offset: The number of the step since the clock was last advanced.
            touched: What the nodes of each body have touched, int32 [worlds * nodes]; see ``launch_touched``.
            begins: Nonzero afterwards if so, int32 [1].
        """
        pace, surface = self._system.pace.arrays, self._pairs.surface.arrays
        for k, body in enumerate(self._system.bodies):
            state = body.state
            inputs = [state.rest, state.displacements, state.velocities, pace, touched[k]]
            self._on_carriers(k, meetings.foresee_places, inputs, [begins])
            self._carriers.launch_places(k)
        self.launch_search(offset)
        inputs = [self._law, surface, self._pairs.meeting, self._pairs.rows, begins]
        self._on_rows(meetings.find_row_meetings, inputs)

    def launch_touched(self, touched: Sequence[wp.array]) -> None:
        """Launch the record, after a step, of what the nodes of each body have touched."""
        surface = self._pairs.surface.arrays
        self._on_rows(meetings.mark_acting, [surface, self._pairs.rows, self._marked])
        for k, array in enumerate(touched):
            start, offset, count, own = self._carriers.nodes_of(k)
            inputs = [start, offset, own, self._marked, array]
            wp.launch(meetings.note_touched, count, inputs, device=self.device)

    def launch_begin(self, k: int, first: int, blocks: wp.array, increment: wp.array, guess: wp.array) -> None:
        """Launch the state of the k-th body at the beginning of a step.

        Args:
            k: The number of the body.
            first: Its first entry in vectors of all bodies.
            blocks: The blocks on the diagonal of its matrix, mat33.
            increment: How far held nodes have gone in the step [m], vec4.
            guess: How far nodes may go [m], vec4.
        """
        self._carriers.launch_begin(k, first, blocks, increment, guess)

    def launch_search(self, offset: int) -> None:
        """Launch a search for pairs, if it is due."""
        self._searches.zero_()
        self._pairs.search.launch(offset, follows=True)

    def launch_searched_again(self, d: wp.array, rounds: wp.array, most: int, again: wp.array) -> None:
        """Launch another search along the way of motions d if they have strayed from the way of the last one.

        Args:
            d: Motions [m], vec4.
            rounds, most: The number of solves in the step, int32 [1], and its maximum.
            again: Nonzero afterwards if so; then it must be solved again, int32 [1].
        """
        again.zero_()
        surface = self._pairs.surface
        inputs = [d, self._joined, self._carriers.arrays, self._searches, rounds, most]
        outputs = [self._pairs.search.watch, surface.arrays, again]
        wp.launch(finding.find_strays, surface.count, inputs, outputs, device=self.device)
        wp.capture_if(again, self._search_again, d=d)

    def _search_again(self, d: wp.array) -> None:
        self._on_rows(kernels.keep_row_forces, [self._pairs.rows, self._joined, self._searches])
        self._pairs.search.launch(1, follows=True)
        self.solves.zero_()
        self.locates.fill_(1)
        self._locate(finding.REPEATED, d)

    def launch_first(self, d: wp.array) -> None:
        """Launch the search for the closest points of pairs when the step begins, with a guess d of the motions."""
        inputs = [self._pairs.surface.arrays, self._joined]
        wp.launch(finding.begin_places, self._pairs.surface.count, inputs, device=self.device)
        self.locates.fill_(1)
        self._locate(finding.FIRST, d)

    def launch_located(self, d: wp.array) -> None:
        """Launch the same after motions d, if it is due."""
        self._locate(finding.LATER, d)

    def _locate(self, which: int, d: wp.array) -> None:
        surface, joined, count = self._places, self._joined, self._pairs.surface.count
        carriers = self._carriers.arrays
        inputs = [int(which), d, joined, carriers, surface]
        wp.launch(finding.place_nodes, count, inputs, device=self.device)
        wp.launch(finding.empty_crowds, len(carriers.crowd), [joined, carriers], device=self.device)
        inputs = [int(which), self._law, self._system.pace.arrays, d, surface, self._pairs.meeting]
        self._on_rows(finding.locate_rows, [*inputs, carriers, self._pairs.rows, joined])
        self._on_rows(finding.stiffen_rows, self._springs)

    def update(self, d: wp.array, *, is_solved: bool = False) -> None:
        """Launch forces and their derivatives after motions d, which are those of a solve if ``is_solved``."""
        self._empty(kernels.PUSHING)
        self._on_rows(kernels.update_rows, [int(is_solved), self._pairs.friction, d, *self._springs])

    def find_reached(self, d: wp.array, change: wp.array) -> None:
        """Launch the list of pairs that may push along a change of the motions d; ``add_slopes`` visits only these."""
        self._empty(kernels.REACHED)
        self._on_rows(kernels.find_reached, [d, change, *self._springs])

    def add_forces(self, y: wp.array) -> None:
        self._on_rows(kernels.add_row_forces, [*self._springs, y])

    def add_products(self, x: wp.array, y: wp.array) -> None:
        self._on_rows(kernels.add_row_products, [*self._springs, x, y])

    def launch_couplings(self, couplings: Couplings) -> None:
        """Launch the addition of the derivative to an assembled matrix."""
        self._on_rows(kernels.couple_rows, [*self._springs, couplings])

    def add_slopes(self, d: wp.array, change: wp.array, search: wp.array, slopes: wp.array) -> None:
        """Launch the power along a change; see ``solvers.implicit.conjugate_gradients``."""
        self._on_rows(kernels.add_row_slopes, [*self._springs, d, change, search, slopes])

    def launch_end(self, d: wp.array) -> None:
        """Launch the update of what users read about contact, and of whether a new search is due."""
        self._on_rows(kernels.end_rows, [self._pairs.rows, self._joined, self._added])
        inputs = [d, self._joined, self._carriers.arrays, self._added, self._pairs.surface.arrays]
        wp.launch(kernels.end_places, self._pairs.surface.count, inputs, device=self.device)
        for k in range(len(self._system.bodies)):
            self._carriers.launch_end(k)
        self._pairs.search.launch_after()

    @property
    def _springs(self) -> list:
        return [self._places, self._carriers.arrays, self._pairs.rows, self._joined]

    def _empty(self, which: int) -> None:
        wp.launch(kernels.empty_list, 1, [int(which), self._joined], device=self.device)

    def _on_rows(self, kernel: wp.Kernel, inputs: Sequence) -> None:
        threads = self._pairs.search.threads(self._pairs.room)
        wp.launch(kernel, threads, [threads, *inputs], device=self.device)

    def _on_carriers(self, k: int, kernel: wp.Kernel, inputs: Sequence, outputs: Sequence) -> None:
        start, _offset, count, own = self._carriers.nodes_of(k)
        wp.launch(kernel, count, [start, *inputs], [own, *outputs], device=self.device)
