"""Contact in implicit steps and static answers: one table of rows; see ``kernels.contact.implicit_rows``."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import warp as wp

from warp_corot.kernels.contact import bearing
from warp_corot.kernels.contact import implicit_location as location
from warp_corot.kernels.contact import implicit_rows as kernels
from warp_corot.kernels.contact.motion import Surface
from warp_corot.kernels.contact.rows import Rows
from warp_corot.kernels.contact.shapes import Rolling
from warp_corot.kernels.implicit.assembled import Couplings
from warp_corot.solvers.implicit.operator import Springs

if TYPE_CHECKING:
    from .parts import AllContacts

#: Types of the arrays of ``ImplicitRows``: of all rows, of triangles, of pairs, and of one number.
OF_ROWS = {
    **dict.fromkeys(("listed", "near", "pushing", "reached"), wp.int32),
    **dict.fromkeys(("gap", "opened", "target", "friction", "stiffness", "most"), wp.float32),
    **dict.fromkeys(("normal", "moved", "multiplier", "force"), wp.vec3),
    "places": wp.vec4i,
    "weights": wp.vec4,
    "derivative": wp.mat33,
}
OF_TRIANGLES = {"rolling": Rolling, "bend": wp.float32, "tilt": wp.vec3, "moment": wp.vec3}
OF_PAIRS = dict.fromkeys(("pushed", "begun"), wp.int32)
NUMBERS = ("due", "locates", "solves")
#: Maximum number of threads of launches over those that are listed.
MOST_THREADS = 1 << 14


class ImplicitContact:
    """The contact of all bodies with obstacles and with one another in implicit steps.

    Args:
        contacts: The contact.

    Attributes:
        couples: Whether bodies may touch one another, so that all of them are solved for together.
        changed: Whether obstacles were missing after the last solve, int32 [1].
        locates: Whether pairs are located in the next round, int32 [1].
        solves: Number of linear solves that the step has had so far, int32 [1].
        total: Number of pairs, int32 [1].
    """

    def __init__(self, contacts: AllContacts):
        self._of, self._rigid, self._pairs, self._law = contacts, contacts.rigid, contacts.pairs, contacts.law
        self._system, self._surface, self.device = contacts.system, contacts.surface, contacts.device
        self.couples = self._pairs is not None
        self.changed, self._searches, self._none = (wp.zeros(1, dtype=wp.int32, device=self.device) for _ in range(3))
        self._rows = kernels.ImplicitRows()
        for name in NUMBERS:
            setattr(self._rows, name, wp.zeros(1, dtype=wp.int32, device=self.device))
        self._rows.counts = wp.zeros(4, dtype=wp.int32, device=self.device)
        self.locates, self.solves = self._rows.locates, self._rows.solves
        self._made: tuple[int, int] = (-1, -1)
        #: The first entry of each body in vectors of all bodies.
        self._firsts = [0] * len(self._system.bodies)
        self.prepare()

    @property
    def total(self) -> wp.array:
        return self._none if self._pairs is None else self._pairs.rows.total

    def prepare(self) -> None:
        """Update to the present surfaces and the room for pairs; not while launches are recorded."""
        surface, rows = self._surface, self._rows
        obstacles = self._of.obstacles.count
        room = 0 if self._pairs is None else self._pairs.room
        if (surface.revision, room) == self._made:
            return
        self._made = (surface.revision, room)
        # On several ranks, obstacles touch nodes only.
        edges = self._rigid is not None and self._rigid.have_edges and self._system.ranks.is_alone
        triangles = obstacles * surface.triangle_count if edges else 0
        rows.first_triangle = obstacles * surface.count
        rows.first_pair = rows.first_triangle + triangles
        self._length, carriers = rows.first_pair + room, surface.count + surface.bearer_count
        self._items = surface.count + (surface.triangle_count if edges else 0)
        for fields, size in ((OF_ROWS, self._length), (OF_TRIANGLES, triangles), (OF_PAIRS, room)):
            for name, dtype in fields.items():
                setattr(rows, name, self._zeros(size, dtype))
        self._carriers = bearing.Carriers()
        self._carriers.surface = surface.arrays
        for name, dtype in {"entry": wp.int32, "compliance": wp.float32, "gone": wp.vec3}.items():
            setattr(self._carriers, name, self._zeros(carriers, dtype))
        self._carriers.crowd = self._zeros((2, carriers), wp.float32)
        rows.carriers = self._carriers
        self._marked, self._added = self._zeros(carriers, wp.int32), self._zeros(surface.count, wp.vec3)
        # Places of their own, where pairs are located: obstacles find the places where they are when a step begins.
        self._located = cast(Any, Surface())
        self._located.assign(surface.arrays)
        self._located.x = self._zeros(surface.count if room else 0, wp.vec3)
        self._stiffness = self._zeros(surface.count, wp.mat33)
        self._springs: dict[int, Springs] = {}

    def springs(self, k: int) -> Springs:
        """The places of a body and the stiffness of obstacles there, for a preconditioner; not while launches are
        recorded."""
        if k not in self._springs:
            surface, at = self._surface, self._surface.places_of(k)
            nodes = np.stack([surface.arrays.node.numpy()[at], *np.full((3, self.places_of(k)), -1)], axis=1)
            weights = np.where(nodes >= 0, 1.0, 0.0)
            if surface.parts[k].bearers:
                weights = np.where(nodes[:, :1] >= 0, surface.arrays.bearing.weights.numpy()[at], 0.0)
                bearers = surface.bearers.node.numpy()[surface.arrays.bearing.bearers.numpy()[at]]
                nodes = np.where(weights != 0.0, bearers, -1)
            weights_ = wp.array(weights, dtype=wp.vec4, device=self.device)
            nodes_ = wp.array(nodes, dtype=wp.vec4i, device=self.device)
            self._springs[k] = Springs(nodes_, weights_, self._stiffness[at])
        return self._springs[k]

    def places_of(self, k: int) -> int:
        """Number of places of a body in all worlds."""
        return self._surface.worlds * self._surface.parts[k].nodes

    def reserve(self, motion: float) -> None:
        """Search for pairs along the way that is expected, from which anything may stray so far in a step [m]."""
        if self._pairs is not None:
            bounds = [self._system.ranks.owned(body).bounds for body in self._system.bodies]
            self._pairs.search.serve_implicit(motion, max(float(np.linalg.norm(high - low)) for low, high in bounds))
            self._pairs.meeting.ahead = self._pairs.search.watch.ahead

    # --- before a step -----------------------------------------------------------------------------------------------

    def launch_onsets(self, offset: int, touched: Sequence[wp.array], begins: wp.array) -> None:
        """Launch the test whether contacts have begun or ceased to push in the last step, or will begin in this one.

        Args:
            offset: The number of the step since the clock was last advanced.
            touched: What the nodes of each body have touched, int32 [worlds * nodes]; see ``launch_touched``.
            begins: Nonzero afterwards if so, int32 [1].
        """
        for k, array in enumerate(touched):
            self._on_carriers(k, bearing.foresee_places, [array, begins])
            self._launch_places(k)
        if self._rigid is not None:
            inputs = [self._rigid.arrays, self._carriers]
            wp.launch(location.find_onsets, self._surface.count, inputs, [begins], device=self.device)
        if self._pairs is not None:
            self._launch_search(offset)
            inputs = [self._law, self._surface.arrays, self._pairs.rows, begins]
            self._on_pairs(location.find_pair_onsets, inputs)

    def launch_touched(self, touched: Sequence[wp.array]) -> None:
        """Launch the record, after a step, of what the nodes of each body have touched."""
        inputs = [max(self._of.obstacles.count, 1), self._rows, self._marked]
        self._on_rows(kernels.mark_acting, inputs)
        for k, array in enumerate(touched):
            self._on_carriers(k, bearing.note_touched, [self._marked, array])

    def launch_begin(self, k: int, first: int, blocks: wp.array, increment: wp.array, guess: wp.array) -> None:
        """Launch the state of the k-th body at the beginning of a step.

        Args:
            k: The number of the body.
            first: Its first entry in vectors of all bodies.
            blocks: The blocks on the diagonal of its matrix, mat33.
            increment: How far held nodes have gone in the step [m], vec4.
            guess: How far free nodes may go [m], vec4.
        """
        self._firsts[k] = first
        self._on_carriers(k, bearing.begin_carriers, [first, blocks, increment, guess, self._carriers])
        self._launch_places(k)

    def launch_first(self, offset: int, d: wp.array) -> None:
        """Launch the search for pairs, if it is due, and the location of rows when the step begins, with a guess d of
        the motions [m], vec4."""
        if self._pairs is not None:
            self._launch_search(offset)
        self._locate(kernels.FIRST, d)

    # --- in a round of solves ----------------------------------------------------------------------------------------

    def locate(self, d: wp.array) -> None:
        """Launch the location of rows after motions d, if it is due."""
        self._locate(kernels.AGAIN, d)

    def update(self, d: wp.array, *, is_solved: bool = False) -> None:
        """Launch forces and their derivatives after motions d, which are those of a solve if ``is_solved``."""
        self._on_rows(kernels.update_rows, [int(is_solved), d, self._rows])

    def add_forces(self, y: wp.array) -> None:
        """Launch the addition of forces on free nodes [N]."""
        self._on_rows(kernels.add_row_forces, [self._rows, y])

    def add_products(self, x: wp.array, y: wp.array) -> None:
        """Launch the addition of the derivative times x."""
        self._on_rows(kernels.add_row_products, [self._rows, x, y])

    def add_couplings(self, couplings: Couplings) -> None:
        """Launch the addition of the derivative to an assembled matrix."""
        self._on_rows(kernels.couple_rows, [self._rows, couplings])

    def update_springs(self) -> None:
        """Launch the stiffness of ``springs``, from the derivatives of the last ``update``."""
        self._stiffness.zero_()
        self._on_rows(kernels.gather_stiffness, [self._rows, self._stiffness])

    def scale(self, k: int, v: wp.array, *, is_after: bool) -> None:
        """Launch v = G v with the springs at a body's nodes, or G^T v; see ``scale_nodes``."""
        inputs = [self._surface.parts[k].start, self._firsts[k], int(is_after), self._carriers]
        wp.launch(kernels.scale_nodes, self.places_of(k), [*inputs, self._stiffness, v], device=self.device)

    def find_reached(self, d: wp.array, change: wp.array) -> None:
        """Launch the list of rows that may push along a change of the motions d; ``add_slopes`` visits only these."""
        self._on_rows(kernels.find_reached, [d, change, self._rows])

    def add_slopes(
        self, d: wp.array, change: wp.array, search: wp.array, slopes: wp.array, *, apart: int | None = None
    ) -> None:
        """Launch the power along a change; see ``solvers.implicit.conjugate_gradients``.

        If there is only one slope, it is that of all worlds together. With ``apart``, a body, there is one for each of
        its places, [worlds * places].
        """
        first = -1 if apart is None else self._surface.parts[apart].start
        inputs = [int(len(search) == 1), first, self._rows, d, change, search, slopes]
        self._on_rows(kernels.add_row_slopes, inputs)

    def launch_going(self, d: wp.array, rounds: wp.array, most: int, going: wp.array) -> None:
        """Launch the search for missing obstacles if the step would end with motions d, which sets ``changed``, and the
        decision whether another solve follows for that.

        Args:
            d: Motions [m], vec4.
            rounds, most: The number of solves in the step, int32 [1], and its maximum.
            going: Whether another solve follows, int32 [1].
        """
        if self._rigid is not None:
            self.changed.zero_()
            self._locate_obstacles(kernels.MISSING, d, going)
        inputs = [self.changed, rounds, most, self._rows, going]
        wp.launch(kernels.judge_rows, 1, inputs, device=self.device)

    def launch_searched_again(self, d: wp.array, rounds: wp.array, most: int, again: wp.array) -> None:
        """Launch another search for pairs along the way of motions d if they have strayed from that of the last one.

        Args:
            d, rounds, most: As for ``launch_going``.
            again: Nonzero afterwards if so; then it must be solved again, int32 [1].
        """
        assert self._pairs is not None
        again.zero_()
        inputs = [d, self._carriers, self._searches, rounds, most]
        outputs = [self._pairs.search.watch, again]
        wp.launch(location.find_strays, self._surface.count, inputs, outputs, device=self.device)
        wp.capture_if(again, self._search_again, d=d)

    def launch_end(self, d: wp.array) -> None:
        """Launch the update of what users read about contact, and of whether a new search is due."""
        surface, beside = self._surface, Rows() if self._rigid is None else self._rigid.rows
        self.update(d)
        self._launch(kernels.end_rows, self._length, [self._rows, beside, self._pair_rows, self._added])
        wp.launch(kernels.end_places, surface.count, [d, self._added, self._carriers], device=self.device)
        for k, body in enumerate(self._system.bodies):
            self._on_carriers(k, bearing.end_carriers, [surface.arrays, body.state.contact_forces])
        if self._pairs is not None:
            self._pairs.search.launch_after()

    # --- pieces ------------------------------------------------------------------------------------------------------

    def _launch_search(self, offset: int) -> None:
        assert self._pairs is not None
        self._searches.zero_()
        self._pairs.search.launch(offset, follows=True)

    def _search_again(self, d: wp.array) -> None:
        assert self._pairs is not None
        self._on_pairs(kernels.keep_pair_forces, [self._rows, self._pairs.rows, self._searches])
        self._pairs.search.launch(1, follows=True)
        self.solves.zero_()
        self.locates.fill_(1)
        self._locate(kernels.REPEATED, d)

    def _locate(self, which: int, d: wp.array) -> None:
        inputs = [int(which), d, self._located, self._rows]
        wp.launch(kernels.begin_location, len(self._marked), inputs, device=self.device)
        if self._rigid is not None and which != kernels.REPEATED:
            self._locate_obstacles(which, d, self._none)
        if self._pairs is not None:
            inputs = [int(which), self._law, self._system.pace.arrays, d, self._located, self._pair_rows, self._rows]
            self._on_pairs(location.locate_pairs, inputs)
        self._on_rows(kernels.stiffen_rows, [int(which), self.changed, self._rows])

    def _locate_obstacles(self, which: int, d: wp.array, going: wp.array) -> None:
        assert self._rigid is not None
        inputs = [int(which), self._rigid.arrays, self._system.pace.arrays, d, going, self._rows, self.changed]
        self._launch(location.locate_obstacles, self._items, inputs, most=self._items)

    @property
    def _pair_rows(self) -> Rows:
        return Rows() if self._pairs is None else self._pairs.rows

    def _on_carriers(self, k: int, kernel: wp.Kernel, inputs: list) -> None:
        """Launch a kernel over the carriers of a body."""
        wp.launch(kernel, self._surface.nodes_of(k)[1], [self._of.part(k), *inputs], device=self.device)

    def _launch_places(self, k: int) -> None:
        """Launch the positions and motions of the places between nodes of a body, from those of the nodes."""
        surface, part = self._surface, self._surface.parts[k]
        if part.bearers:
            inputs = [part.start, surface.bearers, surface.arrays]
            wp.launch(bearing.place_borne, self.places_of(k), inputs, device=self.device)

    def _on_rows(self, kernel: wp.Kernel, inputs: list) -> None:
        self._launch(kernel, self._length, inputs)

    def _on_pairs(self, kernel: wp.Kernel, inputs: list) -> None:
        assert self._pairs is not None
        threads = self._pairs.search.threads(self._pairs.room)
        wp.launch(kernel, threads, [threads, *inputs], device=self.device)

    def _launch(self, kernel: wp.Kernel, count: int, inputs: list, most: int = MOST_THREADS) -> None:
        """Launch a kernel over so many rows; one thread of the CPU sees at once that there is nothing to do."""
        threads = 1 if self.device.is_cpu else max(min(count, most), 1)
        wp.launch(kernel, threads, [threads, *inputs], device=self.device)

    def _zeros(self, shape: int | tuple[int, ...], dtype: type) -> wp.array:
        return wp.zeros(shape, dtype=dtype, device=self.device)
