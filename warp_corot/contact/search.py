"""The search for nearby surfaces, repeated once something has moved far enough since the last one."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING

import warp as wp

from warp_corot.errors import UnstableError
from warp_corot.kernels.contact import beside
from warp_corot.kernels.contact import watch as kernels
from warp_corot.kernels.contact.explicit_rows import FORESEEN, Rigid
from warp_corot.solvers.pace import Mapped

from .surface import ContactSurface

if TYPE_CHECKING:
    from warp_corot.solvers.system import System

    from .obstacles import Obstacles, RigidForces

#: The least motion that is reserved for anything between two searches, as a fraction of the smallest element's size,
#: and how many times as much after something that was hit has moved farther in one step than was reserved.
LEAST, WIDER = 0.05, 4.0
#: A new search is due after this fraction of what is reserved; the rest is for the effect of contact on a step.
SKIN = 0.5
#: Maximum number of threads that process a list on CUDA.
MOST_THREADS = 1 << 18
#: Number of threads of a block, and of resident blocks on each multiprocessor.
BLOCK, BLOCKS_EACH = int(beside.BLOCK), 4
#: The report of the device to the host: see ``kernels.contact.watch.report_search``.
PAIRS, MISSED, SEARCHES = range(3)


class Search:
    """A search finds nearby surfaces with a margin, and is repeated before anything has moved beyond half of it.

    The device knows whether it is due: a search is part of the recorded step, which skips it while it is not due.
    Motion beyond the whole margin in one step is noticed at the end of a run.

    Args:
        surface: The bodies' surfaces.
        obstacles: The obstacles.
        size: The size of the smallest element [m].
        branches: Whether a recorded search may be left out by a branch of the graph; NCCL's launches cannot follow such
            a branch.

    Attributes:
        watch: The places at the last search, as a struct for kernels.
        near: The nodes that have something near them.
        rigid: Forces of obstacles, if there are any.
        find_pairs: The launch of the search for pairs of soft surfaces, if they may touch.
        most: The largest number of pairs so far, int32 [1].
        farthest: The largest value of the least motion that is reserved [m].
    """

    def __init__(self, surface: ContactSurface, obstacles: Obstacles, size: float, *, branches: bool = True):
        self.surface, self.obstacles, self.device = surface, obstacles, surface.device
        self.farthest = float(kernels.STABLE) * size
        self.rigid: RigidForces | None = None
        self.find_pairs: Callable[[], None] | None = None
        self._report = Mapped(3, self.device)
        self.most = wp.zeros(1, dtype=wp.int32, device=self.device)
        watch, device = kernels.Watch(), self.device
        watch.least = wp.full(1, LEAST * size, dtype=wp.float32, device=device)
        watch.fastest = wp.zeros(1 + surface.worlds, dtype=wp.float32, device=device)
        watch.size, watch.most_alone, watch.hit = size, float(kernels.ALONE), float(kernels.HIT_BESIDE)
        watch.alone = 1.0 if device.is_cpu else float(kernels.ALONE)
        # On the CPU, ``Contacts`` leaves a distance for contact, within which steps look at all pairs.
        watch.skin, watch.steps = (1.0, float(FORESEEN)) if device.is_cpu else (SKIN, 1.0)
        watch.due, watch.missed, watch.searches = (wp.zeros(1, dtype=wp.int32, device=device) for _ in range(3))
        self._arrived = wp.zeros(1, dtype=wp.uint32, device=device)
        watch.awake = wp.ones(1, dtype=wp.int32, device=device)
        watch.room, watch.free = (wp.zeros(n, dtype=wp.float32, device=device) for n in (1, 2))
        watch.calm = wp.zeros(3, dtype=wp.float32, device=device)
        watch.published = wp.full(1, -1, dtype=wp.int64, device=device)
        watch.drift, watch.common = (wp.zeros(surface.worlds, dtype=wp.vec3, device=device) for _ in range(2))
        watch.asked = wp.zeros((surface.worlds, 4), dtype=wp.int64, device=device)
        shape = (surface.worlds, obstacles.count)
        watch.poses = wp.zeros(shape, dtype=wp.transform, device=device)
        watch.reach_of = wp.zeros(shape, dtype=wp.float32, device=device)
        self.watch, self.near = watch, kernels.Near()
        self._taken, self._foresees = -1, False
        #: Whether the device can skip recorded launches; otherwise every kernel of a search tests whether it is due.
        self._branches = device.is_cpu or (branches and wp.is_conditional_graph_supported())
        self.follow()

    def threads(self, room: int) -> int:
        """Number of threads for a list with this room."""
        return 1 if self.device.is_cpu else min(max(room, 1), MOST_THREADS)

    # --- what the host sees ----------------------------------------------------------------------------------------

    def follow(self) -> None:
        """Update to the present surfaces."""
        self.watch.spread = self.surface.spread
        if self.surface.revision != self._taken:
            count, device = self.surface.count, self.device
            self.watch.places = wp.zeros(count, dtype=wp.vec3, device=device)
            self.watch.reach = wp.zeros(count, dtype=wp.float32, device=device)
            self._foresee()
            self.near.flags, self.near.nodes = (wp.zeros(count, dtype=wp.int32, device=device) for _ in range(2))
            self.near.count, self.near.touch_count = (wp.zeros(1, dtype=wp.int32, device=device) for _ in range(2))
            pairs = self.obstacles.count * self.surface.triangle_count if self.obstacles.have_edges else 0
            self.near.touches = wp.zeros(pairs, dtype=wp.int32, device=device)
            self._taken = self.surface.revision
        self.forget()

    def forget(self) -> None:
        """Search again before the next step."""
        self.watch.due.fill_(1)
        self.watch.awake.fill_(1)
        self.watch.calm.zero_()

    @property
    def pairs(self) -> int:
        """The largest number of pairs, by the report of the last run."""
        return int(self._report.values[PAIRS])

    @property
    def has_missed(self) -> bool:
        """Whether something moved beyond its margin in the last run."""
        return bool(self._report.values[MISSED] > 0)

    @property
    def count(self) -> int:
        """The number of searches so far, by the report of the last run."""
        return int(self._report.values[SEARCHES])

    def widen(self) -> None:
        """Search with a larger margin from now on, if something has moved too far.

        Raises:
            UnstableError: It moved farther than anything moves in a stable step.
        """
        if not self.has_missed:
            return
        least = float(self.watch.least.numpy()[0])
        self.watch.missed.zero_()
        self._report.values[MISSED] = 0.0
        wider = WIDER * least
        if self._foresees and least < self.farthest:
            wider = min(wider, self.farthest)
        if wider > self.farthest:
            raise UnstableError(f"surfaces that are hit go farther than {1e3 * self.farthest:.3g} mm in one step")
        self.watch.least.fill_(wider)

    def serve_implicit(self, motion: float, extent: float) -> None:
        """Serve implicit steps, each with a search along the way that is expected, from which anything may stray by a
        motion, and at most an extent [m]."""
        self._foresees, self.farthest = True, max(self.farthest, extent)
        self.watch.skin, self.watch.steps = SKIN, 1.0
        self._foresee()
        motion = min(motion, self.farthest / WIDER)
        if motion > float(self.watch.least.numpy()[0]):
            self.watch.least.fill_(motion)

    def _foresee(self) -> None:
        count = self.surface.count if self._foresees else 0
        self.watch.ahead = wp.zeros(count, dtype=wp.vec3, device=self.device)
        self.watch.strayed = wp.zeros(count, dtype=wp.float32, device=self.device)

    def continue_from(self, former: Search) -> None:
        """Take the margins of another search."""
        self.watch.size, self.farthest = former.watch.size, former.farthest
        wp.copy(self.watch.least, former.watch.least)

    # --- launches --------------------------------------------------------------------------------------------------

    @property
    def is_needed(self) -> bool:
        """Whether anything may touch."""
        return self.rigid is not None or self.find_pairs is not None

    @property
    def can_sleep(self) -> bool:
        """Whether the device can leave out contact while nothing is near."""
        return self.device.is_cuda and self._branches and self.is_needed

    def launch(self, offset: int, *, follows: bool = False, sleeps: bool = False) -> None:
        """Launch a search, if it is due in this step.

        Args:
            offset: The number of steps since the clock was last advanced.
            follows: Whether margins count motion relative to a frame, which the steps move; not with obstacles.
            sleeps: Whether contact may sleep after the search.
        """
        if not self.is_needed:
            return
        if offset == 0 or (self.device.is_cpu and not self._foresees):
            self._on_nodes(kernels.watch_nodes, [self.surface.arrays, self.watch])
        search = partial(self._search, follows and not self.obstacles.count, sleeps)
        # A branch takes longer on CUDA than a launch that ends at once, and a search beside obstacles is one launch.
        if not self._branches or (self.find_pairs is None and self.device.is_cuda):
            search()
        elif sleeps:
            wp.capture_while(self.watch.due, search)
        else:
            wp.capture_if(self.watch.due, search)

    def launch_after(self) -> None:
        """Launch the test after a step whether a search is due."""
        if self.is_needed:
            self._on_nodes(kernels.follow_nodes, [self.surface.arrays, self.watch])

    def launch_report(self) -> None:
        """Launch the report to the host after a run."""
        wp.launch(kernels.report_search, 1, [self.watch, self.most, self._report.array], device=self.device)

    def _search(self, is_framed: bool, sleeps: bool) -> None:
        asks = 0 if not is_framed else 2 if len(self.surface.parts) == 1 else 1
        if self.find_pairs is None:
            self._launch(beside.ASK, beside.END, asks, sleeps)
            return
        self._launch(beside.ASK, beside.RESERVE, asks, sleeps)
        self.find_pairs()
        self._launch(beside.BESIDE_OBSTACLES, beside.END, asks, sleeps)

    def _launch(self, first: int, last: int, asks: int, sleeps: bool) -> None:
        """Launch phases of a search."""
        rigid, triangles, threads = Rigid(), 0, 1
        rigid.surface, rigid.motions = self.surface.arrays, self.obstacles.motions
        if self.rigid is not None:
            rigid, triangles = self.rigid.arrays, self.rigid.touch_count
        if self.device.is_cuda:
            blocks = -(-max(self.surface.count + triangles, self.watch.poses.size) // BLOCK)
            threads = BLOCK * min(max(blocks, 1), BLOCKS_EACH * self.device.sm_count)
        inputs = [threads, int(first), int(last), asks, int(sleeps)]
        outputs = [rigid, self.watch, self.near, self._arrived]
        wp.launch(beside.search_near, threads, inputs, outputs, device=self.device, block_dim=min(threads, BLOCK))

    def _on_nodes(self, kernel: wp.Kernel, inputs: list) -> None:
        wp.launch(kernel, self.surface.count, inputs, device=self.device)


# --- sleep ------------------------------------------------------------------------------------------------------------


class Sleep:
    """What steps of awake and of sleeping contact launch.

    Args:
        system: The bodies.
        surface: Their surfaces.
        obstacles: The obstacles.
        search: The search for nearby surfaces.
    """

    def __init__(self, system: System, surface: ContactSurface, obstacles: Obstacles, search: Search):
        self._system, self._surface, self._obstacles = system, surface, obstacles
        self._watch, self._device = search.watch, search.device

    @property
    def is_framed(self) -> bool:
        """Whether margins count motion relative to frames; see ``Search.launch``."""
        return not self._obstacles.count

    def launch(self, offset: int, act: Callable[[], None]) -> None:
        """Launch the motion of obstacles, and what contact does in a step while it is awake.

        Args:
            offset: The number of steps since the clock was last advanced.
            act: Launches that.
        """
        obstacles = self._obstacles
        obstacles.launch_targets()
        for k, body in enumerate(self._system.bodies):
            start, count, nodes = self._surface.nodes_of(k)
            moved = self._system.worlds * obstacles.count if k == 0 else 0
            threads = max(count, moved)
            inputs = [threads, start, count, nodes, int(self.is_framed), moved, obstacles.motions]
            inputs += [body.conditions.world_starts, self._system.pace.arrays, offset]
            inputs += [*self._places(k), body.state.velocities]
            wp.launch(kernels.rouse, threads, inputs, [self._watch], device=self._device)
        # A branch takes longer than launches that end at once.
        act()

    def launch_check(self) -> None:
        """Launch the test after a run whether anything moved too far in its last step."""
        for k in range(len(self._system.bodies)):
            start, count, nodes = self._surface.nodes_of(k)
            inputs = [start, nodes, int(self.is_framed), self._system.pace.arrays, *self._places(k)]
            wp.launch(kernels.check_sleep, count, inputs, [self._watch], device=self._device)

    def _places(self, k: int) -> list[wp.array]:
        """Rest positions and displacements of a body."""
        state = self._system.bodies[k].state
        return [state.rest, state.displacements]
