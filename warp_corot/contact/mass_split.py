"""The contact forces of an explicit step; see ``kernels.contact.mass_split``."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING

import warp as wp

from warp_corot.inputs.cpu_threads import launch
from warp_corot.kernels.contact import approach, sums
from warp_corot.kernels.contact import mass_split as kernels
from warp_corot.kernels.contact.rows import Rows
from warp_corot.kernels.contact.watch import Near
from warp_corot.kernels.stepping.threads import LINE

from .obstacles import RigidForces, have_edges
from .options import Contact, may_meet
from .tool import Obstacle

if TYPE_CHECKING:
    from .parts import AllContacts

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
        contacts: The contact whose forces it finds.

    Attributes:
        sums: What contacts add up at nodes, as a struct for kernels.
        iterations: Number of iterations of a step.
    """

    def __init__(self, contacts: AllContacts):
        self._of, self.device, self._taken = contacts, contacts.device, (-1, -1)
        rigid, pairs = contacts.rigid, contacts.pairs
        alone = pairs is None and not contacts.surface.is_borne and (rigid is None or rigid.is_separate)
        self._none = wp.zeros(0, dtype=wp.int32, device=self.device)
        self._are_separate, self.iterations = alone, EXACT if alone else ITERATIONS
        has_triangles = rigid is not None and rigid.have_edges
        self._kernel = kernels.solver(has_triangles, pairs is not None, self.device.is_cpu)
        self.follow()

    def follow(self) -> None:
        """Update to the present surfaces and the room for pairs."""
        surface, rigid, team = self._of.surface, self._of.rigid, self._of.regions.team
        room = 0 if self._of.pairs is None else self._of.pairs.room
        if (surface.revision, room) == self._taken:
            return
        self._taken, device = (surface.revision, room), self.device
        count = surface.count + surface.bearer_count
        self.sums = kernels.Sums()
        self.sums.touched = wp.zeros(count, dtype=wp.int32, device=device)
        self.sums.weights = wp.zeros((2, count), dtype=wp.int32, device=device)
        self.sums.forces = wp.zeros((2, count), dtype=wp.vec3l, device=device)
        #: The number of the first pair among contacts.
        self.first_pair = 0 if rigid is None else len(rigid.rows.force)
        contacts = self.first_pair + room
        self.sums.live = wp.zeros(contacts, dtype=wp.int32, device=device)
        self.sums.live_count = wp.zeros(2, dtype=wp.int32, device=device)
        self.sums.arrived = wp.zeros(2 * int(LINE), dtype=wp.uint32, device=device)
        self._records = wp.zeros(min(contacts, RECORDS) if device.is_cpu else 0, dtype=kernels.Contact, device=device)
        #: Whether one launch makes all phases, and its threads, or those of a launch for each phase.
        self._is_one, self._threads = self._are_separate or team.parts == 1, team.parts
        self.sums.is_shared = int(team.parts > 1)
        if device.is_cuda:
            blocks, each = max(-(-contacts // BLOCK), 1), device.sm_count
            most = each if blocks <= FEW_TURNS * each else BLOCKS_EACH * each
            self._is_one, self._threads = True, BLOCK * min(blocks, MOST_BLOCKS if self._are_separate else most)

    @property
    def buffer(self) -> int:
        """The buffer of the sums that has the forces at the end of a step."""
        return self.iterations % 2

    def launch(self, near: Near | None = None, listed: tuple[wp.array, wp.array] | None = None) -> None:
        """Launch all phases of a step for what is near; None: what the last search has found.

        Args:
            listed: The contacts of places that may act, and how many there are; None: any.
        """
        near, self._listed = near or self._of.search.near, listed or (self._none, self._none)
        last = self.iterations + 1
        shared = self._of.shared
        if shared.ranks.is_alone:
            spans = [(0, last)] if self._is_one else [(phase, phase) for phase in range(last + 1)]
            self._of.regions.launch(self._kernel, *(partial(self._launch, near, *span) for span in spans))
            return
        shared.exchange(self._of.surface.arrays.yielding)
        for phase in range(last + 1):
            self._launch(near, phase, phase, 0)
            for buffer in (0, 1) if phase == 0 else (phase % 2,):
                shared.exchange(self.sums.weights[buffer])
                shared.exchange(self.sums.forces[buffer])
        shared.clear(self.sums.forces[self.buffer])

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
        forces, surface, pairs, grain = self.sums.forces[0], self._of.surface, self._of.pairs, self._of.law.grain
        if pairs is not None:
            wp.launch(sums.add_pairs, pairs.room, [grain, pairs.rows], [forces], device=self.device, block_dim=BLOCK)
        inputs = [grain, totals, forces]
        wp.launch(sums.place_forces, surface.count, inputs, [surface.arrays], device=self.device, block_dim=BLOCK)

    def _launch(self, near: Near, first: int, last: int, part: int) -> None:
        contacts, pairs, search = kernels.Contacts(), self._of.pairs, self._of.search
        contacts.first_pair, contacts.searched = self.first_pair, search.watch.places
        contacts.rigid = self._of.rigid_arrays
        contacts.pairs = Rows() if pairs is None else pairs.rows
        inputs: list = [self._threads, part, first, last, self.iterations, int(self._are_separate)]
        inputs += [search.watch.awake, near, *self._listed, self._of.system.pace.arrays]
        outputs = [contacts, self._records, self.sums]
        if self.device.is_cpu:
            launch(self._kernel, 1, inputs, outputs, device=self.device)
        else:
            block = min(self._threads, BLOCK)
            wp.launch(self._kernel, self._threads, inputs, outputs, device=self.device, block_dim=block)


# --- steps of the CPU that visit only what may touch ------------------------------------------------------------------


class Approach:
    """Steps that look only at places which their motion may have brought to obstacles.

    Args:
        contacts: The contact of the bodies with obstacles.

    Attributes:
        here: What may have touched an obstacle in the last step.
    """

    def __init__(self, contacts: AllContacts, rigid: RigidForces):
        self._of, self._rigid, self._taken = contacts, rigid, -1
        self.follow()

    @property
    def is_outdated(self) -> bool:
        """Whether surfaces have other places."""
        return self._taken != self._of.surface.revision

    def follow(self) -> None:
        """Update to the present surfaces."""
        surface, device = self._of.surface, self._of.device
        if self.is_outdated:
            self._taken = surface.revision
            places, bodies, carriers = surface.count, len(surface.parts), surface.count + surface.bearer_count
            touches = self._rigid.touch_count
            bearing, visits = surface.arrays.bearing, approach.Visits()
            visits.entries = wp.zeros(len(bearing.bearers), dtype=wp.vec4i, device=device)
            floats = {"ways": carriers, "needs": carriers, "until": len(bearing.places), "spans": places}
            floats |= {"came": 2}
            sizes = {"places": places, "touches": touches, "carriers": carriers, "due": carriers, "carrying": carriers}
            sizes |= {"chosen": places, "contacts": self._of.obstacles.count * places}
            sizes |= dict.fromkeys(("chosen_count", "due_count", "carrying_count"), bodies)
            sizes |= dict.fromkeys(("is_first", "may_miss", "count", "contact_count"), 1)
            for dtype, of in ((wp.float32, floats), (wp.int32, sizes), (wp.vec4, {"budgets": carriers})):
                for name, size in of.items():
                    setattr(visits, name, wp.zeros(size, dtype=dtype, device=device))
            visits.step = wp.zeros(1, dtype=wp.int64, device=device)
            visits.first_place = wp.array([part.start for part in surface.parts], dtype=wp.int32, device=device)
            visits.is_shared, visits.has_edges = int(self._of.regions.team.parts > 1), int(self._rigid.have_edges)
            self._visits, self.here = visits, visits.here
            lists = {"flags": places, "nodes": places, "touches": touches, "count": 1, "touch_count": 1}
            for name, size in lists.items():
                setattr(self.here, name, wp.zeros(size, dtype=wp.int32, device=device))
        inputs = [surface.arrays.bearing, self._visits.entries]
        wp.launch(approach.find_entries, surface.bearer_count, inputs, device=device)
        self._visits.rigid, self._visits.watch = self._rigid.arrays, self._of.search.watch
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
        system, visits = self._of.system, self._visits
        inputs = [self._of.obstacles.motions, system.pace.arrays, system.bodies[0].conditions.world_starts, offset]
        wp.launch(approach.begin_visits, 1, inputs, [visits], device=self._of.device)
        if len(system.constraints) > 1:  # which add to them
            self._clear()
        self._find_due(offset, damping)
        wp.capture_if(visits.watch.awake, partial(self._act, offset, damping, accounts))

    def launch_end(self) -> None:
        """Launch what notes the end of a run."""
        inputs = [self._of.system.pace.arrays]
        wp.launch(approach.end_run, 1, inputs, [self._visits.watch], device=self._of.device)

    def launch_completion(self) -> None:
        """Launch the places of the corners of all triangles on which contact presses."""
        for k in range(len(self._of.system.bodies)):
            inputs = [self._of.part(k), self._visits]
            wp.launch(approach.complete_triangles, 1, inputs, device=self._of.device)

    # --- pieces ----------------------------------------------------------------------------------------------------

    def _launch(self, kernel: wp.Kernel, given: list, k: int, offset: int) -> None:
        """Launch a kernel for the k-th body, one part after another."""
        threads, device = self._of.regions.team.parts, self._of.device

        def phase(part: int) -> None:
            launch(kernel, 1, [threads, part, *given], [], device=device)

        self._of.regions.launch((kernel, k, offset), phase)

    def _find_due(self, offset: int, damping: float) -> None:
        """Launch the search for carriers of each body that are due."""
        for k in range(len(self._of.system.bodies)):
            start, count, _nodes = self._of.surface.nodes_of(k)
            self._launch(approach.find_due, [start, count, self._of.part(k, offset, damping), self._visits], k, offset)

    def _act(self, offset: int, damping: float, accounts: list[wp.array] | None) -> None:
        """Launch the contact of a step in which anything is due."""
        regions, last, split = self._of.regions, int(approach.LIMIT), self._of.split
        threads = regions.team.parts
        spans = [(0, last)] if threads == 1 else [(phase, phase) for phase in range(last + 1)]
        for k in range(len(self._of.system.bodies)):
            inputs = [self._of.part(k, offset, damping), self._visits]

            def visit(first: int, last: int, part: int, inputs: list = inputs) -> None:
                launch(approach.visit, 1, [threads, part, first, last, *inputs], [], device=self._of.device)

            regions.launch((approach.visit, k, offset), *(partial(visit, *span) for span in spans))
        split.launch(self.here, (self._visits.contacts, self._visits.contact_count))
        self._clear()
        for k, body in enumerate(self._of.system.bodies):
            given = [split.buffer, self._of.law.grain, int(accounts is not None), self._of.part(k, offset, damping)]
            given += [self._visits, split.sums, accounts and accounts[k], body.state.contact_forces]
            self._launch(approach.end_visits, given, k, offset)

    def _clear(self) -> None:
        for body in self._of.system.bodies:
            body.state.contact_forces.zero_()
