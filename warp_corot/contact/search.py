"""The search for nearby surfaces, repeated once something has moved far enough since the last one; and nearby pairs."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from warp_corot.errors import UnstableError
from warp_corot.kernels.contact import beside, wide_tree
from warp_corot.kernels.contact import watch as kernels
from warp_corot.kernels.contact.explicit_rows import FORESEEN, Rigid
from warp_corot.kernels.contact.rows import Meeting, OldRows, Rows, begin_rows, keep_rows
from warp_corot.kernels.contact.search import LANES as WARP
from warp_corot.kernels.contact.search import mark_crushed, pair_finder
from warp_corot.solvers.halo import ALONE, Halo
from warp_corot.solvers.pace import Mapped

from .options import Contact
from .surface import ContactSurface, planted

if TYPE_CHECKING:
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
        total, most: The number of pairs, and the largest before the last search, int32 [1].
        farthest: The largest value of the least motion that is reserved [m].
    """

    def __init__(self, surface: ContactSurface, obstacles: Obstacles, size: float, *, branches: bool = True):
        self.surface, self.obstacles, self.device = surface, obstacles, surface.device
        self.farthest = float(kernels.STABLE) * size
        self.rigid: RigidForces | None = None
        self.find_pairs: Callable[[], None] | None = None
        self._report = Mapped(3, self.device)
        self.total, self.most = (wp.zeros(1, dtype=wp.int32, device=self.device) for _ in range(2))
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
        wp.launch(kernels.report_search, 1, [self.watch, self.total, self.most, self._report.array], device=self.device)

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
        contacts: The contact, a ``Contacts``.
    """

    def __init__(self, contacts: Any):
        self._of, self._watch, self._device = contacts, contacts.search.watch, contacts.device
        #: Whether margins count motion relative to frames; see ``Search.launch``.
        self._is_framed = int(not contacts.obstacles.count)

    def launch(self, offset: int, act: Callable[[], None]) -> None:
        """Launch the motion of obstacles, and what contact does in a step while it is awake.

        Args:
            offset: The number of steps since the clock was last advanced.
            act: Launches that.
        """
        contacts = self._of
        obstacles, system = contacts.obstacles, contacts.system
        obstacles.launch_targets()
        for k, body in enumerate(system.bodies):
            count = contacts.surface.nodes_of(k)[1]
            moved = system.worlds * obstacles.count if k == 0 else 0
            threads = max(count, moved)
            inputs = [threads, count, self._is_framed, moved, obstacles.motions, body.conditions.world_starts]
            inputs += [contacts.part(k, offset)]
            wp.launch(kernels.rouse, threads, inputs, [self._watch], device=self._device)
        # A branch takes longer than launches that end at once.
        act()

    def launch_check(self) -> None:
        """Launch the test after a run whether anything moved too far in its last step."""
        for k in range(len(self._of.system.bodies)):
            inputs = [self._is_framed, self._of.part(k)]
            count = self._of.surface.nodes_of(k)[1]
            wp.launch(kernels.check_sleep, count, inputs, [self._watch], device=self._device)


# --- pairs of soft surfaces -------------------------------------------------------------------------------------------

#: What obstacles' rows and pairs have, by type.
ROWS = {
    wp.int32: ("acts",),
    wp.float32: ("gap", "friction"),
    wp.vec3: ("normal", "moved", "force", "more"),
    wp.vec4: ("weights",),
}
#: Initial room for pairs, over the number of nodes and edges; and its growth if it is too small.
PAIRS_EACH = 2
GROWTH = 2.0
#: Number of searches after which trees of boxes are built again, because neighbours may have changed by then.
REBUILT = 100
#: For so many elements at most motion is reserved while nothing is near, if bodies do not touch themselves, and if they
#: do: then so much of the same body is that near that searches take longer.
CALM, CALM_ITSELF = 8.0, 1.0
#: How many times the largest motion is reserved on the CPU, where pairs that are near take longer than searches.
HIT_ON_CPU = 1.0


class Pairs:
    """Pairs of nodes and triangles, and of edges, of all bodies.

    Args:
        surface: The bodies' surfaces.
        search: The search for nearby surfaces.
        options: The options of contact.
        ranks: The processes that compute other elements.

    Attributes:
        rows: The pairs, as a struct for kernels.
        meeting: The things that may meet, as a struct for kernels.
        tree: What finds their neighbours on the CPU, as a struct for kernels.
        revision: Changes whenever launches do.
    """

    def __init__(
        self,
        surface: ContactSurface,
        search: Search,
        options: Contact,
        ranks: Halo = ALONE,
    ):
        self._ranks = ranks
        self.surface, self.search, self.device = surface, search, surface.device
        self.friction, self.meets_itself, self._flat_edges = options.friction, options.self_contact, options.flat_edges
        self.revision, self._room, self._taken, self._built = 0, 0, -1, 0
        search.watch.most_calm = CALM_ITSELF if self.meets_itself else CALM
        search.watch.hit = HIT_ON_CPU if self.device.is_cpu else float(kernels.HIT)
        if self.meets_itself:
            search.watch.most_alone = 1.0
        search.find_pairs = self.find
        self.follow()

    # --- places and room -------------------------------------------------------------------------------------------

    def follow(self) -> None:
        """Update to the present surfaces."""
        surface, device = self.surface, self.device
        if surface.revision == self._taken:
            if device.is_cpu:
                self._is_planted = False  # leaves are of the triangles that there were
            self.forget()
            return
        self._taken = surface.revision
        count, edges = surface.count, surface.edge_count
        meeting = Meeting()
        meeting.normals = wp.zeros(surface.triangle_count, dtype=wp.vec3, device=device)
        meeting.outs = wp.zeros(edges, dtype=wp.vec3, device=device)
        meeting.reach, meeting.ahead = self.search.watch.reach, self.search.watch.ahead
        meeting.meets_itself, meeting.flat_edges = int(self.meets_itself), int(self._flat_edges)
        meeting.roots = wp.zeros((2, surface.worlds, len(surface.parts)), dtype=wp.int32, device=device)
        self.meeting = meeting
        self.tree, self._is_planted = wide_tree.WideTree(), False
        self._boxes = [
            tuple(wp.zeros(max(number, 1), dtype=wp.vec3, device=device) for _ in range(2))
            for number in (surface.triangle_count, edges)
        ]
        self._trees: list[wp.Bvh] = []
        self._make_room(max(self._room, PAIRS_EACH * (count + edges)))

    def _make_room(self, room: int) -> None:
        """Reserve room for a number of pairs. There are no pairs until the next search.

        Raises:
            UnstableError: There is no memory for them.
        """
        try:
            self.rows, self._old = self._rows_for(room)
        except (MemoryError, RuntimeError) as error:
            raise UnstableError(
                f"{room} pairs of soft surfaces come near one another, and {self.device} has no memory for so many; "
                "elements must be larger where surfaces meet"
            ) from error
        self._room = room
        self.search.forget()
        self.revision += 1

    def _rows_for(self, room: int) -> tuple[Rows, OldRows]:
        device, owners = self.device, self.surface.count + self.surface.edge_count
        rows, old = rows_of(room, device), OldRows()
        rows.friction.fill_(self.friction)
        rows.total = self.search.total
        rows.total.zero_()
        for kept in (rows, old):
            kept.starts, kept.counts = (wp.zeros(owners, dtype=wp.int32, device=device) for _ in range(2))
            kept.other = wp.zeros(room, dtype=wp.int32, device=device)
        old.acts, old.force = wp.zeros_like(rows.acts), wp.zeros_like(rows.force)
        rows.owner = wp.zeros(room, dtype=wp.int32, device=device)
        rows.places = wp.zeros(room, dtype=wp.vec4i, device=device)
        rows.away = wp.zeros(room if device.is_cpu else 0, dtype=wp.float32, device=device)
        return rows, old

    @property
    def room(self) -> int:
        """The number of pairs that there is room for."""
        return self._room

    def take_room(self, room: int) -> None:
        """Reserve room for a number of pairs; there are no pairs until the next search."""
        if room != self._room:
            self._make_room(room)

    # --- what the host sees ----------------------------------------------------------------------------------------

    @property
    def is_full(self) -> bool:
        """Whether the last run needed more room than there is; known after the device has finished it."""
        return self.search.pairs > self._room

    def grow(self) -> None:
        """Reserve the room that the last run needed."""
        if self.is_full:
            self._make_room(int(GROWTH * self.search.pairs))

    @property
    def is_planted(self) -> bool:
        """Whether there are trees of boxes of the present surfaces."""
        return self._is_planted

    def prepare(self) -> None:
        """Make everything that launches need."""
        if not self._is_planted:
            self._is_planted = True
            self.revision += 1
            if self.device.is_cpu:
                self.tree = planted(self.surface)
                return
            self._box()
            self._trees = [
                wp.Bvh(lower, upper, groups=groups)
                for (lower, upper), groups in zip(self._boxes, self._groups(), strict=True)
            ]
            self._find_roots()
        elif self._trees and self.search.count >= self._built + REBUILT:
            # Pairs are the same, and in the same order.
            for tree in self._trees:
                tree.rebuild()
            self._find_roots()

    def _find_roots(self) -> None:
        """Find the roots of trees that have just been built."""
        self._built = self.search.count
        for k, tree in enumerate(self._trees):
            roots = self.meeting.roots[k]
            wp.launch(wide_tree.find_roots, roots.size, [tree.id], [roots.flatten()], device=self.device)

    def forget(self) -> None:
        """Forget the forces of the last step."""
        self.rows.force.zero_()

    # --- launches --------------------------------------------------------------------------------------------------

    def _box(self) -> None:
        inputs = [self.surface.arrays, self.meeting]
        boxed = (wide_tree.box_triangles, wide_tree.box_edges)
        for kernel, (lower, upper) in zip(boxed, self._boxes, strict=True):
            wp.launch(kernel, len(lower), inputs, [lower, upper], device=self.device)

    def find(self) -> None:
        """Launch the search for pairs."""
        watch, rows, old, device = self.search.watch, self.rows, self._old, self.device
        if self.meets_itself:
            self._mark_crushed()
        self._box()
        if device.is_cpu:
            self._fill()
        for tree in self._trees:
            tree.refit()
        owners = len(rows.starts)
        wp.launch(keep_rows, owners, [watch, rows, old], [self.search.most], device=device)
        wp.launch(begin_rows, 1, [watch, rows], device=device)
        trees = [self.tree, *([tree.id for tree in self._trees] or (0, 0))]
        threads = owners * (1 if device.is_cpu else int(WARP))
        inputs = [watch, *trees, self.surface.arrays, self.meeting, old]
        wp.launch(pair_finder(device.is_cpu), threads, inputs, [rows, self.search.near], device=device)

    def _fill(self) -> None:
        """Launch the boxes of the wide tree."""
        tree, watch, leaves = self.tree, self.search.watch, len(self.tree.triangle_starts) - 1
        inputs = [watch, self.surface.arrays, self.meeting, *self._boxes[0], *self._boxes[1]]
        wp.launch(wide_tree.fill_leaves, leaves, inputs, [tree], device=self.device)
        lanes = int(wide_tree.LANES)
        levels = ((tree.lower_nodes, tree.upper_nodes), (tree.upper_nodes, tree.roots))
        for k, (children, nodes) in enumerate(levels):
            wp.launch(wide_tree.fill_nodes, leaves // lanes ** (k + 1), [watch, children], [nodes], device=self.device)

    def _groups(self) -> list[wp.array]:
        """The group of each triangle and of each edge: its body in its world; see ``Meeting``."""
        parts, worlds = self.surface.parts, self.surface.worlds
        found = []
        for name, (lower, _) in zip(("triangles", "edges"), self._boxes, strict=True):
            of_parts = [
                np.repeat(len(parts) * np.arange(worlds) + k, getattr(part, name)) for k, part in enumerate(parts)
            ]
            groups = np.concatenate(of_parts).astype(np.int32)
            found.append(wp.array(np.resize(groups, len(lower)), dtype=wp.int32, device=self.device))
        return found

    def _mark_crushed(self) -> None:
        near, watch = self.search.near, self.search.watch
        surface = self.surface
        for (body, places), part in zip(surface.solids, surface.parts, strict=True):
            kernel, elements = mark_crushed(body.discretization.element_kind), body.discretization.elements
            inputs = [watch, elements, body.state.displacements, places, int(part.bearers > 0), surface.arrays]
            wp.launch(kernel, body.sizes.launch_elements, inputs, [near], device=self.device)
        self._ranks.max(near.flags)


def rows_of(count: int, device: wp.Device) -> Rows:
    """A table of so many rows, without what only pairs have."""
    rows = Rows()
    for dtype, names in ROWS.items():
        for name in names:
            setattr(rows, name, wp.zeros(count, dtype=dtype, device=device))
    return rows


def smallest_size(volumes: list[float]) -> float:
    """The size of the smallest of some elements [m], from their volumes [m^3]."""
    return float(np.min(volumes)) ** (1.0 / 3.0)
