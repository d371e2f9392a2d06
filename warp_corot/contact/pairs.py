"""Soft surfaces against one another: nearby pairs, and forces between them."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.errors import UnstableError
from warp_corot.kernels.contact import search as kernels
from warp_corot.kernels.contact import wide_tree
from warp_corot.kernels.contact.crushed import mark_crushed
from warp_corot.kernels.contact.rows import Meeting, OldRows, Rows, begin_rows, end_rows, keep_rows
from warp_corot.kernels.contact.search import pair_finder
from warp_corot.kernels.contact.watch import HIT
from warp_corot.solvers.halo import ALONE, Halo

from .obstacles import rows_of
from .options import Contact
from .search import Search
from .surface import ContactSurface

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
        search.watch.hit = HIT_ON_CPU if self.device.is_cpu else float(HIT)
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
        rows.total = wp.zeros(1, dtype=wp.int32, device=device)
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
        wp.launch(keep_rows, owners, [watch, rows, old], device=device)
        wp.launch(begin_rows, 1, [watch, rows], device=device)
        trees = [self.tree, *([tree.id for tree in self._trees] or (0, 0))]
        threads = owners * (1 if device.is_cpu else int(kernels.LANES))
        inputs = [watch, *trees, self.surface.arrays, self.meeting, old]
        wp.launch(pair_finder(device.is_cpu), threads, inputs, [rows, self.search.near], device=device)
        wp.launch(end_rows, 1, [watch, rows], [self.search.most], device=device)

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


def smallest_size(volumes: list[float]) -> float:
    """The size of the smallest of some elements [m], from their volumes [m^3]."""
    return float(np.min(volumes)) ** (1.0 / 3.0)


# --- the tree of the CPU ----------------------------------------------------------------------------------------------

LANES = int(wide_tree.LANES)
#: Leaves of a root.
OF_ROOT = LANES * LANES

Ints = npt.NDArray[np.integer]
Floats = npt.NDArray[np.float32]


def planted(surface: ContactSurface) -> wide_tree.WideTree:
    """The tree of surfaces whose places at rest are known; boxes are not."""
    tree, corners, sides = wide_tree.WideTree(), surface.triangles.numpy(), surface.sides.numpy()[:, 0]
    used = np.flatnonzero(corners[:, 0] >= 0)
    bodies, parts = surface.body_of_places(), len(surface.parts)
    group = surface.arrays.world.numpy()[corners[used, 0]] * parts + bodies[corners[used, 0]]
    leaf, leaf_group = _leaves(surface.arrays.rest.numpy()[corners[used]], group)
    # Each body in each world begins with a root.
    counts = np.bincount(leaf_group, minlength=surface.worlds * parts)
    roots = -(-counts // OF_ROOT)
    first = np.concatenate([[0], np.cumsum(roots)])
    number = OF_ROOT * first[leaf_group] + np.arange(len(leaf_group)) - (np.cumsum(counts) - counts)[leaf_group]
    of = np.full(len(corners), -1)
    of[used] = number[leaf]
    leaves = OF_ROOT * max(int(first[-1]), 1)
    of_edges = np.where(sides >= 0, of[sides], -1)
    arrays = {"root_starts": first[::parts], "root_bodies": np.repeat(np.arange(len(roots)) % parts, roots)}
    for name, of_items in (("triangle", of), ("edge", of_edges)):
        starts, items = _lanes(of_items, leaves)
        arrays |= {f"{name}_starts": starts, f"{name}s": items}
    arrays["found"] = np.zeros(len(corners) + len(sides))
    sizes = {"triangle_nodes": len(arrays["triangles"]), "edge_nodes": len(arrays["edges"]), "lower_nodes": leaves}
    sizes |= {"upper_nodes": leaves // LANES, "roots": -(-leaves // OF_ROOT // LANES) * LANES}
    for name, values in arrays.items():
        setattr(tree, name, wp.array(values.astype(np.int32), dtype=wp.int32, device=surface.device))
    empty = np.full((int(wide_tree.ROWS), LANES), 0.0, np.float32)
    empty[:3], empty[3:6] = wide_tree.FAR, -wide_tree.FAR
    for name, size in sizes.items():
        values = np.tile(empty.ravel(), size // LANES)
        setattr(tree, name, wp.array(values, dtype=wp.float32, device=surface.device))
    return tree


def _leaves(x: Floats, group: Ints) -> tuple[Ints, Ints]:
    """The leaf of each of some triangles with corners x, [T, 3, 3], and the group of each leaf, in the order of groups:
    halves of halves of each group, across the longest extent of centres and normals."""
    middle, normals = x.mean(axis=1), np.cross(x[:, 1] - x[:, 0], x[:, 2] - x[:, 0])
    areas = np.linalg.norm(normals, axis=1)
    # Triangles that lie back to back differ as much as those a leaf apart.
    across = np.sqrt(LANES * areas.mean()) if len(x) else 1.0
    points = np.concatenate([middle, across * normals / np.maximum(areas, 1e-30)[:, None]], axis=1)
    order = np.argsort(group, kind="stable")
    starts = np.flatnonzero(np.diff(group[order], prepend=-1))
    while True:
        ends = np.append(starts[1:], len(order))
        if (ends - starts).max(initial=0) <= LANES:
            break
        leaf, at = np.repeat(np.arange(len(starts)), ends - starts), points[order]
        extent = np.maximum.reduceat(at, starts) - np.minimum.reduceat(at, starts)
        order = order[np.lexsort((at[np.arange(len(at)), extent.argmax(axis=1)[leaf]], leaf))]
        # Full leaves, but for the last one.
        halves = starts + LANES * -(-(ends - starts) // (2 * LANES))
        starts = np.unique(np.concatenate([starts, halves[ends - starts > LANES]]))
    found = np.empty(len(order), np.int64)
    found[order] = np.repeat(np.arange(len(starts)), ends - starts)
    return found, group[order[starts]]


def _lanes(of: Ints, leaves: int) -> tuple[Ints, Ints]:
    """The first node of each leaf, and what is in the lanes of nodes: the items of each leaf."""
    items = np.flatnonzero(of >= 0)
    items = items[np.argsort(of[items], kind="stable")]
    counts = np.bincount(of[items], minlength=leaves)
    starts = np.concatenate([[0], np.cumsum(-(-counts // LANES))])
    lanes = np.full(LANES * starts[-1], -1)
    lanes[LANES * starts[of[items]] + np.arange(len(items)) - (np.cumsum(counts) - counts)[of[items]]] = items
    return starts, lanes
