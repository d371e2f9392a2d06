"""The contact forces of an explicit step; see ``kernels.contact.mass_split``."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import warp as wp

from warp_corot.inputs.cpu_threads import Regions, Team, launch
from warp_corot.kernels.contact import mass_split as kernels
from warp_corot.kernels.contact import sums
from warp_corot.kernels.contact.law import Law
from warp_corot.kernels.contact.near import Near
from warp_corot.kernels.contact.rows import Meeting, Rows
from warp_corot.kernels.contact.sweep import sweeper
from warp_corot.kernels.contact.touches import Touches
from warp_corot.kernels.contact.vertices import Rigid
from warp_corot.kernels.stepping.pace import Pace
from warp_corot.kernels.stepping.threads import LINE

from .obstacles import RigidForces, have_edges
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
    kernel = _compiled(device, have_edges(obstacles), may_meet(bodies, options))
    return kernel, BLOCK if device.is_cuda else None


def _compiled(device: wp.Device, has_triangles: bool, has_pairs: bool) -> wp.Kernel:
    return (kernels.solver if device.is_cuda else sweeper)(has_triangles, has_pairs)


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
        self._kernel = _compiled(self.device, rigid is not None and rigid.have_edges, pairs is not None)
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
        self._at_places = self._at_triangles = 0
        if self._rigid is not None:
            self._at_places, self._at_triangles = self._rigid.forces.size, self._rigid.touches.force.size
        contacts = self._at_places + self._at_triangles + room
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

    @property
    def first_pair(self) -> int:
        """The number of the first pair among contacts."""
        return self._at_places + self._at_triangles

    def first(self, k: int) -> int:
        """The number in the sums of the first node that carries a body's surface."""
        part = self.surface.parts[k]
        return self.surface.count + part.bearer_start if part.bearers else part.start

    def launch(self, near: Near | None = None, listed: tuple[wp.array, wp.array] | None = None) -> None:
        """Launch all phases of a step for what is near; None: what the last search has found.

        Args:
            listed: The contacts of places and of pairs that may act, and how many there are; None: any.
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
        contacts = kernels.Contacts()
        contacts.first_triangle, contacts.first_pair = self._at_places, self.first_pair
        contacts.triangles, contacts.touches = self.surface.triangles, Touches()
        if self._rigid is not None:
            contacts.rigid, contacts.touches = self._rigid.arrays, self._rigid.touches
        else:
            contacts.rigid = Rigid()
            contacts.rigid.surface, contacts.rigid.law = self.surface.arrays, self._law
        contacts.meeting, contacts.rows = Meeting(), Rows()
        if self._pairs is not None:
            contacts.meeting, contacts.rows = self._pairs.meeting, self._pairs.rows
        search = self._search
        inputs: list = [first, last, self.iterations, int(self._are_separate), search.watch.awake, near, self._pace]
        outputs = [contacts, self.sums]
        if self.device.is_cpu:
            inputs = [self._threads, part, *inputs[:-1], *self._listed, inputs[-1]]
            launch(self._kernel, 1, inputs, [contacts, self._records, self.sums], device=self.device)
        else:
            dim, block = self._threads, min(self._threads, BLOCK)
            wp.launch(self._kernel, dim, [dim, *inputs], outputs, device=self.device, block_dim=block)
