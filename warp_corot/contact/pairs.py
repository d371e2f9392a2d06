"""Soft surfaces against one another: pairs that are near, found now and then, and forces between them."""

from __future__ import annotations

import numpy as np
import warp as wp

from warp_corot.kernels.contact import pairs as kernels
from warp_corot.kernels.contact import search
from warp_corot.kernels.contact.law import Law
from warp_corot.kernels.stepping.pace import Pace
from warp_corot.solvers.guarding.mapped import Mapped

from .surface import ContactSurface

#: Steps from one search to the next at most.
EVERY = 8
#: Pairs that there is room for at first, over nodes and edges; and growth where that is too few.
PAIRS_EACH = 2
GROWTH = 2.0
#: The least that a node may go between two searches, as a share of the smallest element's size.
LEAST_REACH = 0.05


class Pairs:
    """Pairs of nodes and triangles, and of edges, of all bodies.

    Args:
        surface: The bodies' surfaces.
        friction: Coulomb's coefficient.
        meets_itself: Whether a body touches itself.
        size: Of the smallest element [m].

    Attributes:
        rows: The pairs, as kernels take them.
        revision: Changes whenever launches do.
    """

    def __init__(self, surface: ContactSurface, friction: float, meets_itself: bool, size: float):
        self.surface, self.device, self._size = surface, surface.device, size
        self.friction, self.meets_itself = friction, meets_itself
        self.revision, self._every, self._room, self._taken = 0, EVERY, 0, -1
        self._mapped = Mapped(2, self.device)
        self._most = wp.zeros(1, dtype=wp.float64, device=self.device)
        self._missed = wp.zeros(1, dtype=wp.int32, device=self.device)
        self.follow()

    # --- what is there ---------------------------------------------------------------------------------------------

    def follow(self) -> None:
        """Take the present surfaces."""
        surface, device = self.surface, self.device
        if surface.revision == self._taken:
            self.forget()
            return
        self._taken = surface.revision
        count, edges = surface.count, surface.edge_count
        meeting = kernels.Meeting()
        meeting.body = wp.array(surface.body_of_places(), dtype=wp.int32, device=device)
        meeting.triangles, meeting.edges, meeting.sides = surface.triangles, surface.edges, surface.sides
        meeting.reach = wp.zeros(count, dtype=wp.float32, device=device)
        meeting.meets_itself, meeting.friction = int(self.meets_itself), self.friction
        self._meeting = meeting
        self._counts = wp.zeros(count + edges + 1, dtype=wp.int32, device=device)
        self._crowd = wp.zeros(count, dtype=wp.float32, device=device)
        self._added, self._places = (wp.zeros(count, dtype=wp.vec3, device=device) for _ in range(2))
        self._boxes = [
            tuple(wp.zeros(max(number, 1), dtype=wp.vec3, device=device) for _ in range(2))
            for number in (surface.triangle_count, edges)
        ]
        self._trees: list[wp.Bvh] = []
        self._make_room(max(self._room, PAIRS_EACH * (count + edges)))

    def _make_room(self, room: int) -> None:
        self._room, device, owners = room, self.device, self.surface.count + self.surface.edge_count
        rows = kernels.Rows()
        rows.starts, self._old_starts = (wp.zeros(owners + 1, dtype=wp.int32, device=device) for _ in range(2))
        for name in ("owner", "other", "acts"):
            setattr(rows, name, wp.zeros(room, dtype=wp.int32, device=device))
        for name in ("normal", "force", "more"):
            setattr(rows, name, wp.zeros(room, dtype=wp.vec3, device=device))
        rows.places = wp.zeros(room, dtype=wp.vec4i, device=device)
        rows.shares = wp.zeros(room, dtype=wp.vec4, device=device)
        rows.gap = wp.zeros(room, dtype=wp.float32, device=device)
        self._old_other = wp.zeros(room, dtype=wp.int32, device=device)
        self._old_force = wp.zeros(room, dtype=wp.vec3, device=device)
        self.rows = rows
        self.revision += 1

    # --- what the host sees ----------------------------------------------------------------------------------------

    @property
    def is_full(self) -> bool:
        """Whether the last run needed more room than there is; known once the device has come so far."""
        return self._mapped.values[0] > self._room

    def grow(self) -> None:
        """Make room for what the last run needed."""
        self._make_room(int(GROWTH * max(self._mapped.values[0], self._room)))
        self._forget_report()

    @property
    def is_planted(self) -> bool:
        """Whether there are trees of boxes of the present surfaces."""
        return bool(self._trees)

    def prepare(self) -> None:
        """Have all that launches need; look for pairs more often where nodes went farther than they were looked for."""
        if not self._trees:
            self._box()
            self._trees = [wp.Bvh(lower, upper) for lower, upper in self._boxes]
        if self.is_full:
            self.grow()
        if self._mapped.values[1] > 0.0 and self._every > 1:
            self._every //= 2
            self.revision += 1
            self._forget_report()

    def forget(self) -> None:
        """Forget the forces of the last step."""
        self.rows.force.zero_()

    def _forget_report(self) -> None:
        self._most.zero_()
        self._missed.zero_()
        self._mapped.values[:] = 0.0

    # --- launches --------------------------------------------------------------------------------------------------

    def launch_begin(self, offset: int) -> None:
        """Launch the search if it is due in this step, and where all pairs are."""
        if offset % self._every == 0:
            self._search()
        arrays = self.surface.arrays
        self._on_nodes(search.check_reach, [arrays, self._meeting.reach, self._places, self._missed])
        self._on_rows(kernels.locate_rows, [arrays, self._meeting, self.rows, self._added])
        self._on_nodes(kernels.apply_added, [arrays, self._added, self._crowd])

    def launch_round(self, law: Law, pace: Pace) -> None:
        """Launch one round of the forces between pairs."""
        arrays = self.surface.arrays
        self._on_rows(kernels.judge_rows, [law, pace, arrays, self.rows, self._crowd])
        self._on_rows(kernels.solve_rows, [law, pace, arrays, self.friction, self._crowd, self.rows, self._added])
        self._on_nodes(kernels.apply_added, [arrays, self._added, self._crowd])

    def launch_report(self) -> None:
        """Launch what the host sees after a run."""
        wp.launch(search.report_search, 1, [self._missed, self._most, self._mapped.array], device=self.device)

    def _box(self) -> None:
        inputs = [self.surface.arrays, self._meeting]
        for kernel, (lower, upper) in zip((search.box_triangles, search.box_edges), self._boxes, strict=True):
            wp.launch(kernel, len(lower), inputs, [lower, upper], device=self.device)

    def _search(self) -> None:
        arrays, meeting = self.surface.arrays, self._meeting
        self._on_nodes(search.reserve_motion, [self._every, LEAST_REACH * self._size, arrays, meeting.reach])
        self._on_nodes(search.remember_places, [arrays, self._places])
        self._box()
        for tree in self._trees:
            tree.refit()
        old = [self._old_starts, self._old_other, self._old_force]
        dim = max(len(self._counts), self._room)
        wp.launch(search.keep_rows, dim, [self.rows, *old], device=self.device)
        trees = [tree.id for tree in self._trees]
        inputs = [*trees, arrays, meeting, *old]
        owners = len(self._counts) - 1
        outputs = [self._counts, self.rows]
        wp.launch(search.find_pairs, owners, [0, *inputs], outputs, device=self.device)
        wp.utils.array_scan(self._counts, self.rows.starts, inclusive=False)
        wp.launch(search.find_pairs, owners, [1, *inputs], outputs, device=self.device)
        wp.launch(search.note_most, 1, [self.rows, self._most], device=self.device)

    def _on_rows(self, kernel: wp.Kernel, inputs: list) -> None:
        wp.launch(kernel, self._room, inputs, device=self.device)

    def _on_nodes(self, kernel: wp.Kernel, inputs: list) -> None:
        wp.launch(kernel, self.surface.count, inputs, device=self.device)


def smallest_size(volumes: list[float]) -> float:
    """The size of the smallest of some elements [m], from their volumes [m^3]."""
    return float(np.min(volumes)) ** (1.0 / 3.0)
