"""Contact of one body with obstacles on its own surface, whose places nodes bear, in implicit steps."""

from __future__ import annotations

import warp as wp

from warp_corot.kernels.contact import meetings
from warp_corot.kernels.contact import span_places as kernels
from warp_corot.kernels.contact.law import Law
from warp_corot.kernels.implicit.assembled import Couplings
from warp_corot.solvers.implicit.operator import Springs
from warp_corot.solvers.system import System

from .rigid_forces import RigidForces
from .spans import Spans


class BorneSet:
    """Contact of a body with obstacles in implicit steps: all of it consists of springs with multipliers.

    Members are those of ``ActiveSet``.

    Args:
        system: The bodies.
        rigid: Forces of obstacles.
        law: How fast things that overlap are pushed apart.
        k: The number of the body.
    """

    #: No node is held.
    nodes = None

    def __init__(self, system: System, rigid: RigidForces, law: Law, k: int):
        self._system, self._rigid, self._law, self._k = system, rigid, law, k
        self.body, self.device = system.bodies[k], rigid.device
        #: Whether obstacles were missing after the last solve, int32 [1].
        self.changed = wp.zeros(1, dtype=wp.int32, device=self.device)
        self._spans = Spans(rigid, k, rigid.obstacles.shapes.thickness, law, system.pace.arrays)
        self._touched = wp.zeros(len(self.body.state.displacements), dtype=wp.int32, device=self.device)

    def prepare(self) -> None:
        """Update to the present surface; not while launches are recorded."""
        self._spans.prepare()

    @property
    def count(self) -> int:
        """Number of surface places of one world."""
        return self._rigid.surface.parts[self._k].nodes

    @property
    def springs(self) -> Springs:
        """All places, with the springs that push there."""
        return self._spans.springs

    # --- launches ----------------------------------------------------------------------------------------------------

    def launch_begin(self, u: wp.array, d: wp.array, blocks: wp.array) -> None:
        self._spans.launch_begin(blocks, d)
        self._spans.launch_located(kernels.FIRST, d, self.changed)

    def launch_imposed(self, d: wp.array) -> None:
        self._spans.launch_located(kernels.AGAIN, d, self.changed)

    def launch_drag(self, x: wp.array, y: wp.array) -> None:
        self._spans.add_products(x, y)

    def launch_friction(self, d: wp.array, r: wp.array) -> None:
        self._spans.update(d)
        self._spans.add_forces(r)

    def launch_couplings(self, couplings: Couplings) -> None:
        self._spans.add_couplings(couplings)

    def add_slopes(
        self, d: wp.array, change: wp.array, search: wp.array, slopes: wp.array, *, apart: bool = False
    ) -> None:
        assert not apart
        self._spans.add_slopes(d, change, search, slopes)

    def launch_judgement(self, b: wp.array, q: wp.array, d: wp.array) -> None:
        self.changed.zero_()
        self._spans.update(d, is_solved=True)

    def launch_going(self, d: wp.array, locates: wp.array, rounds: wp.array, most: int, going: wp.array) -> None:
        self._spans.launch_judgement(d, self.changed, locates, rounds, most, going)

    def launch_end(self, d: wp.array) -> None:
        self._spans.update(d)
        self._spans.launch_end(d)

    def launch_meetings(self, met: wp.array, begins: wp.array) -> None:
        state, surface, obstacles = self.body.state, self._rigid.surface, self._rigid.obstacles
        part = surface.parts[self._k]
        inputs = [part.start, state.rest, state.displacements, state.velocities, self._system.pace.arrays]
        inputs += [obstacles.shapes, obstacles.motions, self._law, surface.arrays, surface.bearers]
        inputs += [self._rigid.forces, self._touched, begins]
        count = surface.worlds * part.nodes
        wp.launch(meetings.find_borne_meetings, count, inputs, device=self.device)
        inputs = [self._touched, met, begins]
        wp.launch(meetings.compare_touched, len(met), inputs, device=self.device)
