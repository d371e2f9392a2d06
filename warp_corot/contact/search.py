"""When to look for what is near: once something has gone far enough since it was last looked."""

from __future__ import annotations

from collections.abc import Callable

import warp as wp

from warp_corot.errors import UnstableError
from warp_corot.kernels.contact import near as near_kernels
from warp_corot.kernels.contact import watch as kernels
from warp_corot.solvers.guarding.mapped import Mapped

from .obstacles import Obstacles
from .surface import ContactSurface

#: The least that anything may go between two searches, as a share of the smallest element's size; at first, and at
#: most, where what is hit goes farther in one step than was reserved for it.
LEAST, MOST = 0.05, 4.0
WIDER = 4.0
#: Threads that go through lists on CUDA, at most.
MOST_THREADS = 1 << 18
#: What the device tells the host: see ``kernels.contact.watch.report_search``.
PAIRS, MISSED, SEARCHES = range(3)


class Search:
    """What is near is found with a margin, and again before anything has gone beyond half of it.

    Whether it has is known on the device: a search is part of the recorded step, which leaves it out while there is
    nothing to look for. What goes beyond all of its margin in one step is found out at the end of a run.

    Args:
        surface: The bodies' surfaces.
        obstacles: What is rigid.
        size: Of the smallest element [m].
        branches: Whether a recorded search may be left out by a branch of the graph, which NCCL's launches after it
            do not bear.

    Attributes:
        watch: Where things were at the last search, as kernels take it.
        near: The nodes that something is near.
        finders: What is launched in a search.
        most: How many pairs there were at most, int32 [1].
        farthest: What may be reserved at least for any motion, at most [m].
    """

    def __init__(self, surface: ContactSurface, obstacles: Obstacles, size: float, *, branches: bool = True):
        self.surface, self.obstacles, self.device = surface, obstacles, surface.device
        self.farthest = MOST * size
        self.finders: list[Callable[[], None]] = []
        self._report = Mapped(3, self.device)
        self.most = wp.zeros(1, dtype=wp.int32, device=self.device)
        watch, device = kernels.Watch(), self.device
        watch.least = wp.full(1, LEAST * size, dtype=wp.float32, device=device)
        watch.fastest = wp.zeros(1, dtype=wp.float32, device=device)
        watch.size = size
        watch.due, watch.missed, watch.searches = (wp.zeros(1, dtype=wp.int32, device=device) for _ in range(3))
        shape = (surface.worlds, obstacles.count)
        watch.poses = wp.zeros(shape, dtype=wp.transform, device=device)
        watch.reach_of = wp.zeros(shape, dtype=wp.float32, device=device)
        self.watch, self.near = watch, near_kernels.Near()
        self._taken = -1
        #: Whether a device can leave out what was recorded; else every kernel of a search sees whether it is due.
        self._branches = device.is_cpu or (branches and wp.is_conditional_graph_supported())
        self.follow()

    def threads(self, room: int) -> int:
        """Threads for what is in a list with room for so many."""
        return 1 if self.device.is_cpu else min(max(room, 1), MOST_THREADS)

    @property
    def at_nodes(self) -> list:
        """How many threads are to go through the nodes that something is near, and these."""
        return [self.threads(self.surface.count), self.near]

    @property
    def at_touches(self) -> list:
        """The same of obstacles at triangles."""
        return [self.threads(len(self.near.touches)), self.near]

    # --- what the host sees ----------------------------------------------------------------------------------------

    def follow(self) -> None:
        """Take the present surfaces."""
        if self.surface.revision != self._taken:
            count, device = self.surface.count, self.device
            self.watch.places = wp.zeros(count, dtype=wp.vec3, device=device)
            self.watch.reach = wp.zeros(count, dtype=wp.float32, device=device)
            self.near.flags, self.near.nodes = (wp.zeros(count, dtype=wp.int32, device=device) for _ in range(2))
            self.near.count, self.near.touch_count = (wp.zeros(1, dtype=wp.int32, device=device) for _ in range(2))
            pairs = self.obstacles.count * self.surface.triangle_count if self.obstacles.have_edges else 0
            self.near.touches = wp.zeros(pairs, dtype=wp.int32, device=device)
            self._taken = self.surface.revision
        self.forget()

    def forget(self) -> None:
        """Look again before the next step, wherever things are now."""
        self.watch.due.fill_(1)

    @property
    def pairs(self) -> int:
        """How many pairs there were at most, as the last run has told."""
        return int(self._report.values[PAIRS])

    @property
    def has_missed(self) -> bool:
        """Whether something went farther in the last run than what is near was looked for."""
        return bool(self._report.values[MISSED] > 0)

    @property
    def count(self) -> int:
        """How often it was looked so far, as the last run has told."""
        return int(self._report.values[SEARCHES])

    def widen(self) -> None:
        """Look farther from now on, if something has gone too far.

        Raises:
            UnstableError: It went farther than anything goes in a stable step.
        """
        if not self.has_missed:
            return
        least = WIDER * float(self.watch.least.numpy()[0])
        self.watch.missed.zero_()
        self._report.values[MISSED] = 0.0
        if least > self.farthest:
            raise UnstableError(
                f"surfaces that are hit go farther than {1e3 * self.farthest:.3g} mm in one step; the step must be "
                "shorter, or what hits them slower"
            )
        self.watch.least.fill_(least)

    # --- launches --------------------------------------------------------------------------------------------------

    def launch(self, offset: int) -> None:
        """Launch a search, if it is due in this step."""
        if not self.finders:
            return
        if offset == 0:
            self._on_nodes(kernels.watch_nodes, [self.surface.arrays, self.watch])
        if self.obstacles.count:
            self._on_obstacles(kernels.watch_obstacles)
        if self._branches:
            wp.capture_if(self.watch.due, self._search)
        else:
            self._search()

    def launch_after(self) -> None:
        """Launch after a step whether it is time to look again."""
        if self.finders:
            self._on_nodes(kernels.follow_nodes, [self.surface.arrays, self.watch])

    def launch_report(self) -> None:
        """Launch what the host sees after a run."""
        wp.launch(kernels.report_search, 1, [self.watch, self.most, self._report.array], device=self.device)

    def _search(self) -> None:
        arrays = self.surface.arrays
        self._on_nodes(kernels.find_fastest_node, [arrays, self.watch])
        if self.obstacles.count:
            self._on_obstacles(kernels.find_fastest_obstacle)
            self._on_obstacles(kernels.reserve_obstacles)
        self._on_nodes(near_kernels.reserve_nodes, [arrays, self.watch, self.near])
        for find in self.finders:
            find()
        wp.launch(kernels.end_search, 1, [self.watch], device=self.device)

    def _on_nodes(self, kernel: wp.Kernel, inputs: list) -> None:
        wp.launch(kernel, self.surface.count, inputs, device=self.device)

    def _on_obstacles(self, kernel: wp.Kernel) -> None:
        wp.launch(kernel, self.watch.poses.shape, [self.obstacles.motions, self.watch], device=self.device)
