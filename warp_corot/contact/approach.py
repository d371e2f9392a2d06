"""Explicit steps beside obstacles on the CPU that visit only what may touch; see ``kernels.contact.approach``."""

from __future__ import annotations

from functools import partial

import warp as wp

from warp_corot.inputs.cpu_threads import Regions, launch
from warp_corot.kernels.contact import approach as kernels
from warp_corot.kernels.contact.near import Near
from warp_corot.kernels.contact.visits import Visits
from warp_corot.solvers.system import System

from .mass_split import MassSplit
from .rigid_forces import RigidForces
from .search import Search
from .surface import ContactSurface


class Approach:
    """Steps of one body that only obstacles can touch, without a search.

    Args:
        system: The body.
        surface: Its surface.
        search: Its margins.
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
        rigid: RigidForces,
        split: MassSplit,
        regions: Regions,
    ):
        self._system, self._body, self._surface = system, system.bodies[0], surface
        self._watch, self._rigid, self._split, self._regions = search.watch, rigid, split, regions
        self._device, self._taken = surface.device, -1
        self.follow()

    def follow(self) -> None:
        """Update to the present surface."""
        if self._surface.revision != self._taken:
            self._taken = self._surface.revision
            places, touches = self._surface.count, self._rigid.touches.force.size
            carriers = self._surface.bearer_count or places
            visits, device = Visits(), self._device
            visits.budgets = wp.zeros(carriers, dtype=wp.vec4, device=device)
            visits.ways, visits.needs = (wp.zeros(carriers, dtype=wp.float32, device=device) for _ in range(2))
            bearing = self._surface.arrays.bearing
            visits.until = wp.zeros(len(bearing.places), dtype=wp.float32, device=device)
            visits.entries = wp.zeros(len(bearing.bearers), dtype=wp.vec4i, device=device)
            visits.spans = wp.zeros(places, dtype=wp.float32, device=device)
            visits.came = wp.zeros(2, dtype=wp.float32, device=device)
            visits.step = wp.zeros(1, dtype=wp.int64, device=device)
            sizes = {"places": places, "touches": touches, "carriers": carriers, "due": carriers, "carrying": carriers}
            sizes |= {"chosen": places, "contacts": self._rigid.forces.size}
            counts = ("chosen_count", "contact_count", "due_count", "carrying_count")
            alone = dict.fromkeys(("is_first", "may_miss", "count", *counts), 1)
            for name, size in (sizes | alone).items():
                setattr(visits, name, wp.zeros(size, dtype=wp.int32, device=device))
            visits.is_shared = int(self._regions.team.parts > 1)
            self._visits, self.here = visits, Near()
            lists = {"flags": places, "nodes": places, "touches": touches, "count": 1, "touch_count": 1}
            for name, size in lists.items():
                setattr(self.here, name, wp.zeros(size, dtype=wp.int32, device=device))
        bearing = self._surface.arrays.bearing
        inputs = [bearing, self._visits.entries]
        wp.launch(kernels.find_entries, self._surface.bearer_count, inputs, device=self._device)
        self.forget()

    def forget(self) -> None:
        """Visit everything in the next step."""
        self._visits.step.fill_(-2)

    def launch(self, offset: int, damping: float, account: wp.array | None) -> None:
        """Launch the motion of obstacles and the forces of a step.

        Args:
            offset: The number of steps since the clock was last advanced.
            damping: The rate of damping [1/s].
            account: Counts work, if it is counted here.
        """
        state, conditions, nodes = self._body.state, self._body.conditions, self._nodes
        inputs = [self._rigid.obstacles.motions, self._system.pace.arrays, conditions.world_starts, offset]
        inputs += [self._rigid.touches]
        outputs = [self._watch, self.here, self._visits]
        wp.launch(kernels.begin_visits, 1, inputs, outputs, device=self._device)
        if len(self._system.constraints) > 1:  # which add to them
            state.contact_forces.zero_()
        bounds = self._regions.team.bounds(len(nodes.node))

        def find_due(part: int) -> None:
            inputs = [*bounds[part], *self._moving(offset, damping)]
            launch(
                kernels.FIND_DUE[conditions.loads.dtype],
                1,
                inputs,
                [nodes, self._watch, self._visits],
                device=self._device,
            )

        self._regions.launch((kernels.find_due, offset), find_due)
        wp.capture_if(self._watch.awake, partial(self._act, offset, damping, account))

    def launch_end(self) -> None:
        """Launch what notes the end of a run."""
        wp.launch(kernels.end_run, 1, [self._system.pace.arrays], [self._watch], device=self._device)

    def launch_completion(self) -> None:
        """Launch the places of the corners of all triangles on which contact presses."""
        state, surface = self._body.state, self._surface
        inputs = [self._system.pace.arrays, state.displacements, state.velocities, self._nodes, surface.triangles]
        inputs += [surface.corner_starts, surface.corners, self.here, self._visits]
        wp.launch(kernels.complete_triangles, 1, inputs, [surface.arrays], device=self._device)

    # --- pieces ----------------------------------------------------------------------------------------------------

    @property
    def _nodes(self):
        """The carriers of the surface."""
        return self._surface.nodes_of(0)[2]

    def _moving(self, offset: int, damping: float) -> list:
        """The inputs of kernels from which the motion of nodes without contact follows."""
        state, conditions, system = self._body.state, self._body.conditions, self._system
        moving = [damping, system.gravity, conditions.inverse_mass, int(conditions.has_loads), conditions.loads]
        moving += [system.pace.arrays, offset, state.rest, state.forces]
        return [*moving, state.displacements, state.velocities]

    def _act(self, offset: int, damping: float, account: wp.array | None) -> None:
        """Launch the contact of a step in which anything is due."""
        state, surface, threads = self._body.state, self._surface, self._regions.team.parts
        conditions, has_edges = self._body.conditions, self._rigid.have_edges
        inputs = [*self._moving(offset, damping), int(has_edges), surface.triangles]
        inputs += [surface.corner_starts, surface.corners, self._watch]
        outputs = [self._nodes, self._rigid.arrays, self._visits, self.here]

        def visit(first: int, last: int, part: int) -> None:
            given = [threads, part, first, last, *inputs]
            launch(kernels.VISIT[conditions.loads.dtype], 1, given, outputs, device=self._device)

        last = int(kernels.LIMIT)
        spans = [(0, last)] if threads == 1 else [(phase, phase) for phase in range(last + 1)]
        self._regions.launch((kernels.visit, offset), *(partial(visit, *span) for span in spans))
        self._split.launch(self.here, (self._visits.contacts, self._visits.contact_count))
        state.contact_forces.zero_()

        def end(part: int) -> None:
            given = [threads, part, self._split.first(0), self._split.buffer, self._split.grain, self._nodes]
            given += [self._visits, int(account is not None), *self._moving(offset, damping)]
            outputs = [self._split.sums, account, state.contact_forces]
            launch(kernels.END_VISITS[conditions.loads.dtype], 1, given, outputs, device=self._device)

        self._regions.launch((kernels.end_visits, offset), end)
