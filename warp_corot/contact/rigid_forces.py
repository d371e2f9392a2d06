"""Forces of obstacles on soft surfaces: on nodes, and between nodes."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import warp as wp

from warp_corot.kernels.contact import beside, sums, touches, triangles
from warp_corot.kernels.contact.law import Law
from warp_corot.kernels.contact.rows import Meeting, Rows
from warp_corot.kernels.contact.together import BLOCK, push_together
from warp_corot.kernels.contact.together_items import Sums
from warp_corot.kernels.contact.vertices import Rigid
from warp_corot.kernels.stepping.pace import Pace
from warp_corot.solvers.ranks import ALONE, Ranks

from .obstacles import Obstacles
from .pairs import Pairs
from .search import Search
from .surface import ContactSurface

#: With more near nodes or near triangles, or more pairs of soft surfaces, than this for each thread of a block, the
#: whole device is faster than the block.
MOST_EACH = 4
MOST_PAIRS_EACH = 2


class RigidForces:
    """Forces of obstacles.

    Args:
        surface: The bodies' surfaces.
        obstacles: The obstacles.
        search: The search for nearby surfaces.
        law: The law of contact: how far gaps may close in a step.
        pace: The clock.
        ranks: The processes that move the other nodes of the triangles here.
        pairs: The pairs of soft surfaces; None if these cannot touch.

    Attributes:
        forces: The force of each obstacle on each surface node itself in the last step [N], vec3 [O, S].
        totals: The same with the nodes' shares of the forces between them, when they were last published.
        touches: Obstacles at triangles.
        kinds: The state of each surface node with each obstacle in implicit steps; see
            ``kernels.contact.active``, [O, S].
        have_edges: Whether any of the obstacles can pass between the nodes.
        has_rounds: Whether forces depend on one another, so that they are found in rounds.
        together: Whether one block makes all rounds; None: chosen by the number of nodes and triangles that are near.
        revision: Changes whenever launches do.
    """

    def __init__(
        self,
        surface: ContactSurface,
        obstacles: Obstacles,
        search: Search,
        law: Law,
        pace: Pace,
        ranks: Ranks = ALONE,
        pairs: Pairs | None = None,
    ):
        self.surface, self.obstacles, self.search, self.device = surface, obstacles, search, surface.device
        self._law, self._pace, self._ranks, self._taken = law, pace, ranks, -1
        self._pairs = pairs
        self.have_edges = obstacles.have_edges
        self.has_rounds = obstacles.have_edges or surface.is_borne
        self.together: bool | None = None
        self.revision, self._is_together = 0, False
        search.finders.append(self._find)
        self.follow()

    def follow(self) -> None:
        """Update to the present surfaces."""
        if self.surface.revision == self._taken:
            self.forget()
            return
        self._taken, device = self.surface.revision, self.device
        count, obstacles = self.surface.count, self.obstacles.count
        self.forces = wp.zeros((obstacles, count), dtype=wp.vec3, device=device)
        self.totals = wp.zeros_like(self.forces)
        self.kinds = wp.zeros((obstacles, count), dtype=wp.int32, device=device)
        self.anchors = wp.zeros((obstacles, count), dtype=wp.vec4, device=device)
        self._away, self._moved = wp.zeros_like(self.anchors), wp.zeros_like(self.forces)
        self.allowances = wp.zeros((obstacles, count), dtype=wp.float32, device=device)
        self.touches = touches.Touches()
        shape = (obstacles, self.surface.triangle_count if self.have_edges else 0)
        for name in ("shares", "normal", "moved", "force", "more"):
            setattr(self.touches, name, wp.zeros(shape, dtype=wp.vec3, device=device))
        for name in ("gap", "friction", "allowance"):
            setattr(self.touches, name, wp.zeros(shape, dtype=wp.float32, device=device))
        self.touches.warmth = self.surface.warmth
        self.touches.acts = wp.zeros(shape, dtype=wp.int32, device=device)
        self._crowd = wp.zeros(count, dtype=wp.float32, device=device)
        self._sums = Sums()
        self._sums.crowd = wp.zeros(count, dtype=wp.int32, device=device)
        self._sums.added = wp.zeros(count, dtype=wp.vec3l, device=device)
        self._skin = triangles.Skin()
        self._skin.triangles, self._skin.corners = self.surface.triangles, self.surface.corners
        self._skin.corner_starts = self.surface.corner_starts
        self._yielding = self.surface.arrays.yielding

    def prepare(self) -> None:
        """Choose how forces are launched, by the number of nodes and triangles that were near in the last run."""
        together = self.together
        if together is None:
            most = BLOCK * (1.0 if self._is_together else 0.5)
            is_short = (self.has_rounds or self._pairs is not None) and self.search.most_near <= MOST_EACH * most
            # A pair takes longer than a place.
            is_short = is_short and self.search.pairs <= MOST_PAIRS_EACH * most
            together = (self.device.is_cpu or is_short) and self._ranks.is_alone
        self.revision += int(together != self._is_together)
        self._is_together = together

    def forget(self) -> None:
        """Forget the last step."""
        self.anchors.zero_()
        self.kinds.zero_()
        self.touches.force.zero_()
        for allowances in (self.allowances, self.touches.allowance):
            allowances.zero_()
        if self.surface.is_borne:
            # Borne places begin with the forces of the last step.
            self.forces.zero_()

    @property
    def state(self) -> dict[str, wp.array]:
        """The arrays that it keeps from step to step."""
        touches = self.touches
        sides = {"touch_normals": touches.normal.flatten(), "touch_forces": touches.force.flatten()}
        sides |= {"allowances": self.allowances.flatten(), "touch_allowances": touches.allowance.flatten()}
        borne = {"forces": self.forces.flatten()} if self.surface.is_borne else {}
        return {"anchors": self.anchors.flatten(), **sides, **borne}

    # --- launches --------------------------------------------------------------------------------------------------

    def launch(self, rounds: int) -> None:
        """Launch the forces of a step, with those of soft surfaces.

        Args:
            rounds: The number of rounds, in each of which forces between nodes, then those of soft surfaces, and then
                those on nodes are corrected.
        """
        if self._is_together:
            self._launch_together(rounds)
            return
        between: Callable[[], None] | None = None
        if self._pairs is not None:
            self._pairs.launch_begin(self._law)
            between = partial(self._pairs.launch_round, self._law, self._pace)
        self._launch_begin(is_end=rounds == 0)
        for number in range(rounds):
            self._launch_round()
            if between is not None:
                if self.has_rounds:
                    self._push(triangles.ADD)
                between()
            added = triangles.ADD if self.has_rounds and between is None else 0
            self._push(triangles.CORRECT | added | (triangles.END if number == rounds - 1 else 0))

    def _launch_together(self, rounds: int) -> None:
        """Launch them in one block of threads."""
        threads = 1 if self.device.is_cpu else BLOCK
        pairs = self._pairs
        meeting, rows = (Meeting(), Rows()) if pairs is None else (pairs.meeting, pairs.rows)
        inputs = [threads, self.search.near, rounds, int(self.surface.is_borne), self.surface.triangles]
        inputs += [self._pace, meeting]
        outputs = [rows, self.touches, self._rigid, self._sums]
        wp.launch(push_together, threads, inputs, outputs, device=self.device, block_dim=threads)

    def _launch_begin(self, *, is_end: bool) -> None:
        """Launch the first forces: those between nodes from the last step, and those on nodes."""
        parts = triangles.BEGIN | (triangles.END if is_end else 0)
        if self.have_edges:
            self._yielding = self._ranks.completed_yielding(self.surface.arrays.yielding)
            self._on_touches(touches.find_touches, [self._rigid, self.surface.triangles, self.touches])
        if self.has_rounds:
            parts |= triangles.ADD
        self._push(parts)

    def _launch_round(self) -> None:
        """Launch one round of the forces between nodes; their sums at the nodes follow."""
        if not self.has_rounds:
            return
        self._ranks.complete_surface(self.surface.arrays.d)
        inputs = [self._rigid, self._pace, self._skin, self._yielding, self.touches, self._crowd]
        self._on_nodes(triangles.crowd_nodes, inputs)
        self._ranks.complete_surface(self._crowd)
        if self.have_edges:
            inputs = [
                self._law,
                self._pace,
                self.surface.arrays,
                self.surface.triangles,
                self._crowd,
                self._yielding,
                self.touches,
            ]
            self._on_touches(triangles.solve_touches, inputs)

    def launch_totals(self) -> wp.array:
        """Launch the sums of all forces of each obstacle on each node, [O, S]."""
        if not self.have_edges:
            return self.forces
        inputs = [self.surface.corner_starts, self.surface.corners, self.touches, self.forces]
        wp.launch(sums.share_touches, self.forces.shape, inputs, [self.totals], device=self.device)
        return self.totals

    def _find(self) -> None:
        """Launch the search for nodes and triangles near obstacles."""
        watch, near, rigid = self.search.watch, self.search.near, self._rigid
        outputs = [near, rigid, self._crowd]
        wp.launch(beside.find_nodes_beside, self.surface.count, [watch], outputs, device=self.device)
        if self.have_edges:
            dim, inputs = (self.obstacles.count, self.surface.triangle_count), [watch, rigid, self.surface.triangles]
            wp.launch(beside.find_triangles_beside, dim, inputs, [near, self.touches], device=self.device)

    def _push(self, parts: int) -> None:
        """Launch some of the parts that act on one node at a time."""
        inputs = [parts, self._skin, self._pace, self.touches, self._crowd, self._rigid]
        self._on_nodes(triangles.push_nodes, inputs)
        if parts & triangles.ADD and self.surface.is_borne:
            self._on_nodes(triangles.settle_places, [parts, self._rigid])

    @property
    def _rigid(self) -> Rigid:
        """The obstacles, the surfaces and what is between them, as they are now."""
        rigid = Rigid()
        rigid.shapes, rigid.motions, rigid.law = self.obstacles.shapes, self.obstacles.motions, self._law
        rigid.surface, rigid.forces, rigid.anchors = self.surface.arrays, self.forces, self.anchors
        rigid.away, rigid.moved, rigid.allowance = self._away, self._moved, self.allowances
        return rigid

    def _on_nodes(self, kernel: wp.Kernel, inputs: list) -> None:
        among = self.search.at_nodes
        wp.launch(kernel, among[0], [*among, *inputs], device=self.device)

    def _on_touches(self, kernel: wp.Kernel, inputs: list) -> None:
        among = self.search.at_touches
        wp.launch(kernel, among[0], [*among, *inputs], device=self.device)
