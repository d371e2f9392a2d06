"""The contact forces of an explicit step; see ``kernels.contact.mass_split``."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import warp as wp

from warp_corot.inputs.cpu_threads import Regions, Team, launch
from warp_corot.kernels.contact import approach, sums
from warp_corot.kernels.contact import mass_split as kernels
from warp_corot.kernels.contact.approach import Part, Visits
from warp_corot.kernels.contact.explicit_rows import Rigid
from warp_corot.kernels.contact.law import Law
from warp_corot.kernels.contact.rows import Rows
from warp_corot.kernels.contact.watch import Near
from warp_corot.kernels.stepping.pace import Pace
from warp_corot.kernels.stepping.threads import LINE
from warp_corot.solvers.system import System

from .obstacles import Obstacles, RigidForces, have_edges
from .options import Contact, may_meet
from .pairs import Pairs
from .search import Search
from .surface import ContactSurface
from .tool import Obstacle
from .whole_surface import SurfaceHalo

#: Number of iterations if contacts share nodes, and otherwise: then the first one is exact.
ITERATIONS, EXACT = 4, 1
BLOCK = int(kernels.BLOCK)
#: The most contacts that the CPU keeps ready during the iterations.
RECORDS = 1 << 14
#: On CUDA one launch makes all phases. Its blocks of threads are resident: one on each multiprocessor if there is room
#: for at most so many blocks of contacts for each, else so many. Contacts that share no node wait for none; the most
#: blocks for them.
FEW_TURNS, BLOCKS_EACH, MOST_BLOCKS = 4, 4, 4096


def solver_of(
    device: wp.Device, obstacles: Sequence[Obstacle], options: Contact, bodies: int
) -> tuple[wp.Kernel, int | None]:
    """The kernel of a step, for what may touch, and its threads of a block."""
    kernel = kernels.solver(have_edges(obstacles), may_meet(bodies, options), device.is_cpu)
    return kernel, BLOCK if device.is_cuda else None


class MassSplit:
    """Projected Jacobi iterations over the contacts of a step.

    Args:
        surface: The bodies' surfaces.
        search: The search for nearby surfaces.
        law: The law of contact.
        pace: The clock.
        shared: The exchange with ranks that move the other nodes of the triangles here.
        rigid: Contact with obstacles; None without.
        pairs: Contact between soft surfaces; None if they cannot touch.
        team: The threads of the CPU that share the contacts.

    Attributes:
        sums: What contacts add up at nodes, as a struct for kernels.
        iterations: Number of iterations of a step.
    """

    def __init__(
        self,
        surface: ContactSurface,
        search: Search,
        law: Law,
        pace: Pace,
        shared: SurfaceHalo,
        rigid: RigidForces | None,
        pairs: Pairs | None,
        team: Team,
    ):
        self.surface, self.device = surface, surface.device
        self._search, self._law, self._pace, self._shared = search, law, pace, shared
        self._rigid, self._pairs, self._taken = rigid, pairs, (-1, -1)
        self._regions = Regions(team, self.device)
        alone = pairs is None and not surface.is_borne and (rigid is None or rigid.is_separate)
        self._none = wp.zeros(0, dtype=wp.int32, device=self.device)
        self._are_separate, self.iterations = alone, EXACT if alone else ITERATIONS
        has_triangles = rigid is not None and rigid.have_edges
        self._kernel = kernels.solver(has_triangles, pairs is not None, self.device.is_cpu)
        self.follow()

    def follow(self) -> None:
        """Update to the present surfaces and the room for pairs."""
        room = 0 if self._pairs is None else self._pairs.room
        if (self.surface.revision, room) == self._taken:
            return
        self._taken, device = (self.surface.revision, room), self.device
        count = self.surface.count + self.surface.bearer_count
        self.sums = kernels.Sums()
        self.sums.touched = wp.zeros(count, dtype=wp.int32, device=device)
        self.sums.weights = wp.zeros((2, count), dtype=wp.int32, device=device)
        self.sums.forces = wp.zeros((2, count), dtype=wp.vec3l, device=device)
        #: The number of the first pair among contacts.
        self.first_pair = 0 if self._rigid is None else len(self._rigid.rows.force)
        contacts = self.first_pair + room
        self.sums.live = wp.zeros(contacts, dtype=wp.int32, device=device)
        self.sums.live_count = wp.zeros(2, dtype=wp.int32, device=device)
        self.sums.arrived = wp.zeros(2 * int(LINE), dtype=wp.uint32, device=device)
        self._records = wp.zeros(min(contacts, RECORDS) if device.is_cpu else 0, dtype=kernels.Contact, device=device)
        #: Whether one launch makes all phases, and its threads, or those of a launch for each phase.
        self._is_one, self._threads = self._are_separate or self._regions.team.parts == 1, self._regions.team.parts
        self.sums.is_shared = int(self._regions.team.parts > 1)
        if device.is_cuda:
            blocks, each = max(-(-contacts // BLOCK), 1), device.sm_count
            most = each if blocks <= FEW_TURNS * each else BLOCKS_EACH * each
            self._is_one, self._threads = True, BLOCK * min(blocks, MOST_BLOCKS if self._are_separate else most)

    @property
    def grain(self) -> float:
        """Forces at nodes are summed in multiples of this [N]."""
        return self._law.grain

    @property
    def buffer(self) -> int:
        """The buffer of the sums that has the forces at the end of a step."""
        return self.iterations % 2

    def first(self, k: int) -> int:
        """The number in the sums of the first node that carries a body's surface."""
        part = self.surface.parts[k]
        return self.surface.count + part.bearer_start if part.bearers else part.start

    def launch(self, near: Near | None = None, listed: tuple[wp.array, wp.array] | None = None) -> None:
        """Launch all phases of a step for what is near; None: what the last search has found.

        Args:
            listed: The contacts of places that may act, and how many there are; None: any.
        """
        near, self._listed = near or self._search.near, listed or (self._none, self._none)
        last = self.iterations + 1
        if self._shared.ranks.is_alone:
            spans = [(0, last)] if self._is_one else [(phase, phase) for phase in range(last + 1)]
            self._regions.launch(self._kernel, *(partial(self._launch, near, *span) for span in spans))
            return
        self._shared.exchange(self.surface.arrays.yielding)
        for phase in range(last + 1):
            self._launch(near, phase, phase, 0)
            for buffer in (0, 1) if phase == 0 else (phase % 2,):
                self._shared.exchange(self.sums.weights[buffer])
                self._shared.exchange(self.sums.forces[buffer])
        self._shared.clear(self.sums.forces[self.buffer])

    def launch_clear(self) -> None:
        """Launch the reset of all sums, which the end of a step does for nodes that this process moves only."""
        self.sums.touched.zero_()
        self.sums.weights.zero_()
        self.sums.forces.zero_()

    def launch_place_forces(self, totals: wp.array | None) -> None:
        """Launch the sums of the last step's forces at each place.

        Args:
            totals: The forces of obstacles, vec3 [O, S]; None without.
        """
        forces, arrays = self.sums.forces[0], self.surface.arrays
        if self._pairs is not None:
            inputs = [self._law.grain, self._pairs.rows]
            wp.launch(sums.add_pairs, self._pairs.room, inputs, [forces], device=self.device, block_dim=BLOCK)
        inputs = [self._law.grain, totals, forces]
        wp.launch(sums.place_forces, self.surface.count, inputs, [arrays], device=self.device, block_dim=BLOCK)

    def _launch(self, near: Near, first: int, last: int, part: int) -> None:
        contacts, pairs = kernels.Contacts(), self._pairs
        contacts.first_pair, contacts.searched = self.first_pair, self._search.watch.places
        contacts.rigid = rigid_of(self._rigid, self.surface, self._law)
        contacts.pairs = Rows() if pairs is None else pairs.rows
        inputs: list = [self._threads, part, first, last, self.iterations, int(self._are_separate)]
        inputs += [self._search.watch.awake, near, *self._listed, self._pace]
        outputs = [contacts, self._records, self.sums]
        if self.device.is_cpu:
            launch(self._kernel, 1, inputs, outputs, device=self.device)
        else:
            block = min(self._threads, BLOCK)
            wp.launch(self._kernel, self._threads, inputs, outputs, device=self.device, block_dim=block)


def rigid_of(rigid: RigidForces | None, surface: ContactSurface, law: Law) -> Rigid:
    """Contact with obstacles as a struct for kernels; without them only the surfaces and the law."""
    if rigid is not None:
        return rigid.arrays
    made = Rigid()
    made.surface, made.law = surface.arrays, law
    return made


# --- steps of the CPU that visit only what may touch ------------------------------------------------------------------


class Approach:
    """Steps that look only at places which their motion may have brought to obstacles.

    Args:
        system: The bodies.
        surface: Their surfaces.
        search: Its margins.
        obstacles: The obstacles.
        law: The law of contact.
        rigid: Contact with obstacles.
        split: The solver of contacts, which gets what is visited.
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
        rigid: RigidForces,
        split: MassSplit,
        regions: Regions,
    ):
        self._system, self._surface, self._search, self._split = system, surface, search, split
        self._obstacles, self._law, self._rigid = obstacles, law, rigid
        self._regions, self._device, self._taken = regions, surface.device, -1
        self.follow()

    @property
    def is_outdated(self) -> bool:
        """Whether surfaces have other places."""
        return self._taken != self._surface.revision

    def follow(self) -> None:
        """Update to the present surfaces."""
        surface, device = self._surface, self._device
        if self.is_outdated:
            self._taken = surface.revision
            places, bodies, carriers = surface.count, len(surface.parts), surface.count + surface.bearer_count
            touches = self._rigid.touch_count
            bearing, visits = surface.arrays.bearing, Visits()
            visits.entries = wp.zeros(len(bearing.bearers), dtype=wp.vec4i, device=device)
            floats = {"ways": carriers, "needs": carriers, "until": len(bearing.places), "spans": places}
            floats |= {"came": 2}
            sizes = {"places": places, "touches": touches, "carriers": carriers, "due": carriers, "carrying": carriers}
            sizes |= {"chosen": places, "contacts": self._obstacles.count * places}
            sizes |= dict.fromkeys(("chosen_count", "due_count", "carrying_count"), bodies)
            sizes |= dict.fromkeys(("is_first", "may_miss", "count", "contact_count"), 1)
            for dtype, of in ((wp.float32, floats), (wp.int32, sizes), (wp.vec4, {"budgets": carriers})):
                for name, size in of.items():
                    setattr(visits, name, wp.zeros(size, dtype=dtype, device=device))
            visits.step = wp.zeros(1, dtype=wp.int64, device=device)
            visits.first_place = wp.array([part.start for part in surface.parts], dtype=wp.int32, device=device)
            visits.is_shared, visits.has_edges = int(self._regions.team.parts > 1), int(self._rigid.have_edges)
            self._visits, self.here = visits, visits.here
            lists = {"flags": places, "nodes": places, "touches": touches, "count": 1, "touch_count": 1}
            for name, size in lists.items():
                setattr(self.here, name, wp.zeros(size, dtype=wp.int32, device=device))
        inputs = [surface.arrays.bearing, self._visits.entries]
        wp.launch(approach.find_entries, surface.bearer_count, inputs, device=device)
        self._visits.rigid, self._visits.watch = self._rigid.arrays, self._search.watch
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
        system, visits = self._system, self._visits
        inputs = [system.pace.arrays, system.bodies[0].conditions.world_starts, offset]
        wp.launch(approach.begin_visits, 1, inputs, [visits], device=self._device)
        if len(system.constraints) > 1:  # which add to them
            self._clear()
        self._find_due(offset, damping)
        wp.capture_if(visits.watch.awake, partial(self._act, offset, damping, accounts))

    def launch_end(self) -> None:
        """Launch what notes the end of a run."""
        wp.launch(approach.end_run, 1, [self._system.pace.arrays], [self._search.watch], device=self._device)

    def launch_completion(self) -> None:
        """Launch the places of the corners of all triangles on which contact presses."""
        for k in range(len(self._system.bodies)):
            inputs = [self._part(k, 0, 0.0), self._visits]
            wp.launch(approach.complete_triangles, 1, inputs, device=self._device)

    # --- pieces ----------------------------------------------------------------------------------------------------

    def _part(self, k: int, offset: int, damping: float) -> Part:
        """The surface of the k-th body, as a struct for kernels."""
        part, of = Part(), self._surface.parts[k]
        part.number, part.place, part.shift = k, of.start, self._surface.count if of.bearers else 0
        part.start, _count, part.nodes = self._surface.nodes_of(k)
        part.dynamics = self._system.dynamics(self._system.bodies[k], damping)
        part.pace, part.offset = self._system.pace.arrays, offset
        return part

    def _find_due(self, offset: int, damping: float) -> None:
        """Launch the search for carriers of each body that are due, in parts."""
        for k in range(len(self._system.bodies)):
            start, count, _nodes = self._surface.nodes_of(k)
            bounds, inputs = self._regions.team.bounds(count), [self._part(k, offset, damping), self._visits]

            def over(part: int, start: int = start, bounds: list = bounds, inputs: list = inputs) -> None:
                begin, end = bounds[part]
                launch(approach.find_due, 1, [start + begin, start + end, *inputs], [], device=self._device)

            self._regions.launch((approach.find_due, k, offset), over)

    def _act(self, offset: int, damping: float, accounts: list[wp.array] | None) -> None:
        """Launch the contact of a step in which anything is due."""
        threads, last = self._regions.team.parts, int(approach.LIMIT)
        spans = [(0, last)] if threads == 1 else [(phase, phase) for phase in range(last + 1)]
        for k in range(len(self._system.bodies)):
            inputs = [self._part(k, offset, damping), self._visits]

            def visit(first: int, last: int, part: int, inputs: list = inputs) -> None:
                launch(approach.visit, 1, [threads, part, first, last, *inputs], [], device=self._device)

            self._regions.launch((approach.visit, k, offset), *(partial(visit, *span) for span in spans))
        self._split.launch(self.here, (self._visits.contacts, self._visits.contact_count))
        self._clear()
        for k, body in enumerate(self._system.bodies):
            account = None if accounts is None else accounts[k]
            given = [self._split.buffer, self._split.grain, int(accounts is not None), self._part(k, offset, damping)]
            outputs = [self._visits, self._split.sums, account, body.state.contact_forces]

            def end(part: int, given: list = given, outputs: list = outputs) -> None:
                launch(approach.end_visits, 1, [threads, part, *given], outputs, device=self._device)

            self._regions.launch((approach.end_visits, k, offset), end)

    def _clear(self) -> None:
        for body in self._system.bodies:
            body.state.contact_forces.zero_()
