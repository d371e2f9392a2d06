"""Explicit steps on the CPU that visit only what may touch; see ``kernels.contact.approach`` and ``nearing``."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import warp as wp

from warp_corot.inputs.cpu_threads import Regions, launch
from warp_corot.kernels.contact import approach as kernels
from warp_corot.kernels.contact import nearing
from warp_corot.kernels.contact.law import Law
from warp_corot.kernels.contact.near import Near
from warp_corot.kernels.contact.touches import Touches
from warp_corot.kernels.contact.vertices import Rigid
from warp_corot.kernels.contact.visits import Part, Visits
from warp_corot.solvers.system import System

from .mass_split import MassSplit
from .obstacles import Obstacles, RigidForces
from .pairs import Pairs
from .search import Search
from .surface import ContactSurface


class Approach:
    """Steps that look only at places and pairs which their motion may have brought together.

    Args:
        system: The bodies.
        surface: Their surfaces.
        search: Its margins.
        obstacles: The obstacles.
        law: The law of contact.
        rigid: Contact with obstacles; None without.
        pairs: Contact between soft surfaces; None if they cannot touch.
        split: The solver of contacts, which gets what is visited.
        place: Launches the positions of all places and their motion without contact, from the ``offset`` and the
            damping.
        regions: The threads.

    Attributes:
        here: What may have touched an obstacle in the last step.
    """

    def __init__(
        self,
        system: System,
        surface: ContactSurface,
        search: Search,
        obstacles: Obstacles,
        law: Law,
        rigid: RigidForces | None,
        pairs: Pairs | None,
        split: MassSplit,
        place: Callable[[int, float], None],
        regions: Regions,
    ):
        self._system, self._surface, self._search, self._pairs = system, surface, search, pairs
        self._obstacles, self._law, self._rigid, self._split = obstacles, law, rigid, split
        self._place, self._regions, self._device, self._taken = place, regions, surface.device, (-1, -1)
        self.follow()

    @property
    def is_outdated(self) -> bool:
        """Whether surfaces have other places, or there is other room for pairs."""
        return self._taken != (self._surface.revision, 0 if self._pairs is None else self._pairs.room)

    def follow(self) -> None:
        """Update to the present surfaces and the room for pairs."""
        surface, device, room = self._surface, self._device, 0 if self._pairs is None else self._pairs.room
        if self.is_outdated:
            self._taken = (surface.revision, room)
            places, bodies, carriers = surface.count, len(surface.parts), surface.count + surface.bearer_count
            touches = 0 if self._rigid is None else self._rigid.touches.force.size
            bearing, visits = surface.arrays.bearing, Visits()
            visits.entries = wp.zeros(len(bearing.bearers), dtype=wp.vec4i, device=device)
            floats = {"ways": carriers, "needs": carriers, "until": len(bearing.places), "spans": places}
            floats |= {"came": 2}
            vectors = {"budgets": carriers, "carried": carriers, "mean_gone": surface.worlds}
            vectors |= {"searched": places, "gone": places, "goes": places, "mean_goes": surface.worlds}
            sizes = {"places": places, "touches": touches, "carriers": carriers, "due": carriers, "carrying": carriers}
            sizes |= {"chosen": places, "contacts": self._obstacles.count * places + room}
            sizes |= dict.fromkeys(("chosen_count", "due_count", "carrying_count"), bodies)
            sizes |= dict.fromkeys(("is_first", "may_miss", "count", "contact_count"), 1)
            for dtype, of in ((wp.float32, floats), (wp.int32, sizes), (wp.vec4, vectors)):
                for name, size in of.items():
                    setattr(visits, name, wp.zeros(size, dtype=dtype, device=device))
            visits.step = wp.zeros(1, dtype=wp.int64, device=device)
            visits.body = wp.array(surface.body_of_places(), dtype=wp.int32, device=device)
            visits.first_place = wp.array([part.start for part in surface.parts], dtype=wp.int32, device=device)
            visits.triangles, visits.corner_starts = surface.triangles, surface.corner_starts
            visits.corners, visits.is_shared = surface.corners, int(self._regions.team.parts > 1)
            self._visits, self.here = visits, Near()
            lists = {"flags": places, "nodes": places, "touches": touches, "count": 1, "touch_count": 1}
            for name, size in lists.items():
                setattr(self.here, name, wp.zeros(size, dtype=wp.int32, device=device))
        inputs = [surface.arrays.bearing, self._visits.entries]
        wp.launch(kernels.find_entries, surface.bearer_count, inputs, device=device)
        self.forget()

    def forget(self) -> None:
        """Visit everything in the next step."""
        self._visits.step.fill_(-2)

    def launch(self, offset: int, damping: float, accounts: list[wp.array] | None) -> None:
        """Launch the motion of obstacles and the forces of a step.

        Args:
            offset: The number of steps since the clock was last advanced.
            damping: The rate of damping [1/s].
            accounts: Count work on each body, if it is counted here.
        """
        system, watch, visits = self._system, self._search.watch, self._visits
        inputs = [self._obstacles.motions, system.pace.arrays, system.bodies[0].conditions.world_starts, offset]
        wp.launch(kernels.begin_visits, 1, [*inputs, self._touches], [watch, self.here, visits], device=self._device)
        if len(system.constraints) > 1:  # which add to them
            self._clear()
        if self._rigid is not None:
            self._over_parts(kernels.find_due, offset, damping, [watch, visits])
        if self._pairs is not None:
            self._over_parts(nearing.foresee_carriers, offset, damping, [visits])
            self._follow(nearing.BEFORE_STEP, offset)
            wp.capture_if(watch.due, partial(self._find_pairs, offset, damping))
            inputs = [self._split.first_pair, self._law.closing, self._surface.count]
            outputs = [self._pairs.rows, watch, self.here, visits]
            wp.launch(nearing.list_rows, 1, inputs, outputs, device=self._device)
        wp.capture_if(watch.awake, partial(self._act, offset, damping, accounts))

    def launch_end(self) -> None:
        """Launch what notes the end of a run."""
        wp.launch(kernels.end_run, 1, [self._system.pace.arrays], [self._search.watch], device=self._device)

    def launch_completion(self) -> None:
        """Launch the places of the corners of all triangles on which contact presses."""
        for k in range(len(self._system.bodies)):
            inputs = [self._system.pace.arrays, self._part(k, 0.0), self._visits]
            wp.launch(kernels.complete_triangles, 1, inputs, [self._surface.arrays], device=self._device)

    # --- pieces ----------------------------------------------------------------------------------------------------

    @property
    def _touches(self) -> Touches:
        return Touches() if self._rigid is None else self._rigid.touches

    def _part(self, k: int, damping: float) -> Part:
        """The surface of the k-th body, as a struct for kernels."""
        part, of = Part(), self._surface.parts[k]
        part.number, part.place, part.shift = k, of.start, self._surface.count if of.bearers else 0
        part.start, _count, part.nodes = self._surface.nodes_of(k)
        part.dynamics = self._system.dynamics(self._system.bodies[k], damping)
        return part

    def _over_parts(self, kernel: wp.Kernel, offset: int, damping: float, outputs: list) -> None:
        """Launch a kernel over the carriers of each body, in parts."""
        for k in range(len(self._system.bodies)):
            start, count, _nodes = self._surface.nodes_of(k)
            bounds, inputs = (
                self._regions.team.bounds(count),
                [self._part(k, damping), self._system.pace.arrays, offset],
            )

            def over(part: int, start: int = start, bounds: list = bounds, inputs: list = inputs) -> None:
                begin, end = bounds[part]
                launch(kernel, 1, [start + begin, start + end, *inputs], outputs, device=self._device)

            self._regions.launch((kernel, k, offset), over)

    def _follow(self, when: int, offset: int) -> None:
        """Launch how far places have come since the last search, and the test whether another one is due."""
        surface = self._surface
        for k, of in enumerate(surface.parts):
            bounds, part = self._regions.team.bounds(surface.worlds * of.nodes), self._part(k, 0.0)

            def follow(number: int, start: int = of.start, bounds: list = bounds, part: Part = part) -> None:
                begin, end = bounds[number]
                inputs = [start + begin, start + end, part, surface.arrays]
                launch(nearing.follow_places, 1, inputs, [self._visits], device=self._device)

            self._regions.launch((nearing.follow_places, k, offset), follow)
        inputs = [int(when), surface.arrays, self._law]
        wp.launch(nearing.ask_for_search, 1, inputs, [self._search.watch, self._visits], device=self._device)

    def _find_pairs(self, offset: int, damping: float) -> None:
        """Launch a search for pairs."""
        assert self._pairs is not None
        inputs, watch = [self._surface.arrays, self._law], self._search.watch
        watch.awake.fill_(1)
        for when in (nearing.BEFORE_SEARCH, nearing.AFTER_SEARCH):
            if when == nearing.AFTER_SEARCH:
                self._place(offset, damping)
                outputs = [watch, self._visits, self._search.near]
                wp.launch(nearing.reserve_motion, 1, inputs, outputs, device=self._device)
                self._pairs.find()
            wp.launch(nearing.ask_for_search, 1, [int(when), *inputs], [watch, self._visits], device=self._device)

    def _act(self, offset: int, damping: float, accounts: list[wp.array] | None) -> None:
        """Launch the contact of a step in which anything is due."""
        threads, watch, pace = self._regions.team.parts, self._search.watch, self._system.pace.arrays
        has_edges, rigid = int(self._rigid is not None and self._rigid.have_edges), Rigid()
        rigid.surface, rigid.motions, rigid.law = self._surface.arrays, self._obstacles.motions, self._law
        outputs = [rigid if self._rigid is None else self._rigid.arrays, self._visits, self.here]
        last = int(kernels.LIMIT)
        spans = [(0, last)] if threads == 1 else [(phase, phase) for phase in range(last + 1)]
        for k in range(len(self._system.bodies)):
            inputs = [self._part(k, damping), pace, offset, has_edges, watch]

            def visit(first: int, last: int, part: int, inputs: list = inputs) -> None:
                launch(kernels.visit, 1, [threads, part, first, last, *inputs], outputs, device=self._device)

            self._regions.launch((kernels.visit, k, offset), *(partial(visit, *span) for span in spans))
        self._split.launch(self.here, (self._visits.contacts, self._visits.contact_count))
        self._clear()
        given = [self._split.buffer, self._split.grain, self._visits, int(accounts is not None), pace, offset]
        for k, body in enumerate(self._system.bodies):
            account = None if accounts is None else accounts[k]
            outputs = [self._part(k, damping), self._split.sums, account, body.state.contact_forces]

            def end(part: int, outputs: list = outputs) -> None:
                launch(kernels.end_visits, 1, [threads, part, *given], outputs, device=self._device)

            self._regions.launch((kernels.end_visits, k, offset), end)

    def _clear(self) -> None:
        for body in self._system.bodies:
            body.state.contact_forces.zero_()
