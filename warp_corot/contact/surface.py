"""The surface nodes and triangles of all bodies of a simulation, one after another on the device."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, cast

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.kernels.contact import wide_tree
from warp_corot.kernels.contact.motion import Bearing, Surface
from warp_corot.kernels.distributed.exchange import clear_values
from warp_corot.solvers.halo import Halo
from warp_corot.solvers.system import System

from .skin import FollowedSurface, Skin, has_own_surface

if TYPE_CHECKING:
    from warp_corot.body.soft_body import SoftBody
    from warp_corot.mesh import TetForest
    from warp_corot.mesh.surfaces.bound import SurfaceMesh

#: Room for a body whose mesh changes, over the size of its surface when the room is reserved.
ROOM = 1.5
NO_NODE = -1
#: Smaller weights of the nodes around a place are rounding errors.
LEAST_WEIGHT = 1e-6
#: Beside corners that touch, too, and where nodes bear places, a step begins with this fraction of the last step's
#: forces of obstacles on triangles: with more, triangles hold off places around, and bodies seem stiffer. Where nodes
#: bear both sides of a thin wall it begins with all: the iterations of a step do not make up for the rest there.
WARMTH = 0.5

Ints = npt.NDArray[np.int32]


@dataclass
class Part:
    """The place of a body's surface in the common arrays, world after world, and its room in each world.

    Attributes:
        start, triangle_start, edge_start, bearer_start: Its first place, triangle, edge and bearer.
        nodes, triangles, edges, bearers: Number of places for one world; no bearers: places are nodes.
        skin: The surface.
        version: The version of the mesh.
    """

    start: int
    triangle_start: int
    edge_start: int
    bearer_start: int
    nodes: int
    triangles: int
    edges: int
    bearers: int
    skin: Skin = field(kw_only=True)
    version: int = field(kw_only=True)

    @property
    def sizes(self) -> list[int]:
        return [self.nodes, self.triangles, self.edges, self.bearers]


class ContactSurface:
    """The surfaces of bodies, which follow their meshes.

    Args:
        bodies: All bodies, with the same number of worlds.
        are_own: Whether contact acts on bodies' own surfaces, where they have one; otherwise on the boundary of their
            tetrahedra.
        are_close: Whether these have more points on coarse meshes, which pays against obstacles alone.
        device: The device of the surfaces; None: that of the bodies.

    Attributes:
        arrays: The places, as a struct for kernels.
        bearers: The nodes that bear places between nodes, as such a struct.
        triangles: Places of their corners, vec3i [T]; -1 where there is none.
        opposite: For each triangle the fourth node of its tetrahedron, int32 [T]; -1 inside the body.
        warmth: For each triangle the fraction of the last step's force of an obstacle with which a step begins, float32
            [T].
        edges, sides: Places of the ends of edges, and the two triangles of each, vec2i [E]; -1 where there is none.
        corner_starts, corners: For each node, from one start to the next: three times a triangle and which corner.
        parts: The place of each body.
        count, triangle_count, edge_count, bearer_count: Number of places for nodes, triangles, edges and bearers.
        places: For each body the place of each node, or its place among the bearers if the body has these, int32
            [nodes]; -1 for others.
        revision: Changes whenever arrays are replaced.
    """

    #: Whether places of nodes that other ranks move are among them, with all values.
    is_whole = False

    def __init__(
        self,
        bodies: Sequence[SoftBody],
        *,
        are_own: bool = False,
        are_close: bool = False,
        device: wp.Device | None = None,
    ):
        self.bodies, self.worlds, self.device = tuple(bodies), bodies[0].worlds, device or bodies[0].device
        self.are_own, self.are_close = are_own, are_close
        self.revision = 0
        self.parts: list[Part] = []
        self._followed: dict[int, FollowedSurface] = {}
        self._make_room([self._skin(k) for k in range(len(bodies))])

    @property
    def own(self) -> Surface:
        """The places at nodes that this process moves, as a struct for kernels."""
        return self.arrays

    @property
    def own_bearers(self) -> Surface:
        """The bearers that this process moves, as a struct for kernels."""
        return self.bearers

    @property
    def solids(self) -> list[tuple[SoftBody, wp.array]]:
        """The bodies whose elements this process computes, and the place of each of their nodes, int32 [nodes]; -1
        inside."""
        return list(zip(self.bodies, self.places, strict=True))

    @property
    def is_borne(self) -> bool:
        """Whether any places lie between nodes."""
        return self.bearer_count > 0

    @property
    def spread(self) -> float:
        """The largest sum of the absolute weights with which nodes bear a place: how many times as far as the nodes it
        may move."""
        borne = [np.abs(part.skin.own.weights).sum(axis=1).max() for part in self.parts if part.skin.own is not None]
        return float(max(borne, default=1.0))

    def body_of_places(self) -> Ints:
        """The number of the body at each place for a node, int32 [S]."""
        return np.repeat(np.arange(len(self.parts)), [self.worlds * part.nodes for part in self.parts]).astype(np.int32)

    @property
    def is_outdated(self) -> bool:
        """Whether any mesh has changed."""
        return any(body.version != part.version for body, part in zip(self.bodies, self.parts, strict=True))

    def follow(self) -> None:
        """Update to the present meshes."""
        changed = [k for k, body in enumerate(self.bodies) if body.version != self.parts[k].version]
        skins = [self._skin(k) if k in changed else self.parts[k].skin for k in range(len(self.bodies))]
        fits = all(len(body.state.rest) == len(own) for body, own in zip(self.bodies, self.places, strict=True))
        fits = fits and all(
            size <= room
            for skin, part in zip(skins, self.parts, strict=True)
            for size, room in zip(_sizes(skin), part.sizes, strict=True)
        )
        if not fits:
            self._make_room(skins)
            return
        for body, part, skin in zip(self.bodies, self.parts, skins, strict=True):
            part.skin, part.version = skin, body.version
        self._fill()

    @property
    def rooms(self) -> list[list[int]]:
        """Number of places for nodes, triangles, edges and bearers of each body in a world."""
        return [part.sizes for part in self.parts]

    def make_room(self, rooms: Sequence[Sequence[int]]) -> None:
        """Update to the present meshes, with the room of a former ``rooms``."""
        self._make_room([self._skin(k) for k in range(len(self.bodies))], rooms)

    def rebound(self, body: SoftBody) -> Callable[[], SurfaceMesh] | None:
        """What binds a body's own surface to the nodes of its present mesh; None if the mesh does not change."""
        followed = self._followed.get(self.bodies.index(body)) if body in self.bodies else None
        return None if followed is None else followed.last

    def nodes_of(self, k: int) -> tuple[int, int, Surface]:
        """The nodes that carry a body's surface: the first one, how many there are, and their arrays."""
        part = self.parts[k]
        if part.bearers:
            return part.bearer_start, self.worlds * part.bearers, self.own_bearers
        return part.start, self.worlds * part.nodes, self.own

    def places_of(self, k: int) -> slice:
        """The places of a body's nodes."""
        part = self.parts[k]
        return slice(part.start, part.start + self.worlds * part.nodes)

    def nodes_at(
        self, places: npt.NDArray[np.integer], shares: npt.NDArray[np.float64]
    ) -> tuple[int, int, tuple[int, ...], npt.NDArray[np.float64]]:
        """The body at some places of one world, that world, their nodes numbered within it, and the nodes' shares.

        Args:
            shares: The share of each place.
        """
        k = max(number for number, part in enumerate(self.parts) if part.start <= places[0])
        part = self.parts[k]
        world = (int(places[0]) - part.start) // part.nodes
        at = places - part.start - world * part.nodes
        if part.skin.own is None:
            return k, world, tuple(part.skin.nodes[at].tolist()), shares
        nodes, which = np.unique(part.skin.own.nodes[at], return_inverse=True)
        found = np.bincount(which.ravel(), (shares[:, None] * part.skin.own.weights[at]).ravel(), len(nodes))
        used = found != 0.0
        return k, world, tuple(nodes[used].tolist()), found[used]

    # --- pieces ----------------------------------------------------------------------------------------------------

    def _make_room(self, skins: Sequence[Skin], rooms: Sequence[Sequence[int]] | None = None) -> None:
        self.parts, starts = [], [0, 0, 0, 0]
        for k, (body, skin) in enumerate(zip(self.bodies, skins, strict=True)):
            more = ROOM if body.changing is not None else 1.0
            least = _sizes(skin)
            sizes = [int(more * size) for size in least]
            if rooms is not None:
                sizes = [max(int(room), size) for room, size in zip(rooms[k], least, strict=True)]
            self.parts.append(Part(*starts, *sizes, skin=skin, version=body.version))
            starts = [start + self.worlds * size for start, size in zip(starts, sizes, strict=True)]
        self.count, self.triangle_count, self.edge_count, self.bearer_count = starts
        count, device = self.count, self.device
        self.bearers = _places(self.bearer_count, device)
        self.arrays = _places(count, device)
        self.arrays.bearing = self._room_for_bearing(count)
        self.triangles = wp.empty(self.triangle_count, dtype=wp.vec3i, device=device)
        self.opposite = wp.empty(self.triangle_count, dtype=wp.int32, device=device)
        self.warmth = wp.empty(self.triangle_count, dtype=wp.float32, device=device)
        self.edges, self.sides = (wp.empty(self.edge_count, dtype=wp.vec2i, device=device) for _ in range(2))
        self.corner_starts = wp.empty(count + 1, dtype=wp.int32, device=device)
        self.corners = wp.empty(3 * self.triangle_count, dtype=wp.int32, device=device)
        for name in ("triangles", "opposite", "warmth", "edges", "sides", "corner_starts", "corners"):
            setattr(self.arrays, name, getattr(self, name))
        self.arrays.body = wp.array(self.body_of_places(), dtype=wp.int32, device=device)
        self.places = [wp.empty(len(body.state.rest), dtype=wp.int32, device=device) for body in self.bodies]
        self.revision += 1
        self._fill()

    def _skin(self, k: int) -> Skin:
        body = self.bodies[k]
        if body.changing is None or not self.are_own or not has_own_surface(body.changing.forest.source):
            return Skin.of(body, is_own=self.are_own, is_close=self.are_close)
        if body.cut_area > 0.0:
            # Points of both lips must not be made one.
            self._followed.pop(k, None)
            return Skin.of_surface(cast("TetForest", body.mesh).surface())
        if k not in self._followed:
            self._followed[k] = FollowedSurface(body, is_close=self.are_close)
        return self._followed[k].skin()

    def _room_for_bearing(self, count: int) -> Bearing:
        """Room for the bearing of a number of places: up to four nodes bear each."""
        bearing, device, bearers = Bearing(), self.device, len(self.bearers.node)
        borne = count if bearers else 0
        bearing.bearers = wp.empty(borne, dtype=wp.vec4i, device=device)
        bearing.loose = wp.zeros(borne, dtype=wp.float32, device=device)
        bearing.held = wp.zeros(borne, dtype=wp.vec3, device=device)
        bearing.d, bearing.yielding = self.bearers.d, self.bearers.yielding
        bearing.starts = wp.zeros(bearers + 1, dtype=wp.int32, device=device)
        bearing.weights = wp.zeros(borne, dtype=wp.vec4, device=device)
        bearing.places = wp.zeros(4 * borne, dtype=wp.int32, device=device)
        bearing.shares = wp.zeros(4 * borne, dtype=wp.float32, device=device)
        return bearing

    def _fill_bearing(self) -> None:
        """Copy which nodes bear which places to the device."""
        if not self.is_borne:
            return
        node, world = (np.full(self.bearer_count, NO_NODE, np.int32) for _ in range(2))
        bearers, weights = np.full((self.count, 4), -1, np.int32), np.zeros((self.count, 4))
        for body, part in zip(self.bodies, self.parts, strict=True):
            if part.skin.own is None:
                continue
            nodes = part.skin.bearers
            at = np.minimum(np.searchsorted(nodes, part.skin.own.nodes), len(nodes) - 1)
            for w in range(self.worlds):
                first, start = part.start + w * part.nodes, part.bearer_start + w * part.bearers
                node[start : start + len(nodes)] = nodes + w * body.world_node_count
                world[start : start + part.bearers] = w
                bearers[first : first + len(at)] = at + start
                weights[first : first + len(at)] = part.skin.own.weights
        # Nodes with a share that comes from rounding would have to move places by far.
        weights[np.abs(weights) < LEAST_WEIGHT] = 0.0
        places, which = np.nonzero(weights)
        order = np.argsort(bearers[places, which], kind="stable")
        places, which = places[order], which[order]
        starts = np.searchsorted(bearers[places, which], np.arange(self.bearer_count + 1))
        bearing = self.arrays.bearing
        bearing.bearers.assign(bearers)
        bearing.weights.assign(weights.astype(np.float32))
        bearing.starts.assign(starts.astype(np.int32))
        bearing.places[: len(places)].assign(places.astype(np.int32))
        bearing.shares[: len(places)].assign(weights[places, which].astype(np.float32))
        self.bearers.node.assign(node)
        self.bearers.world.assign(world)

    def _fill(self) -> None:
        """Copy the surfaces to the device."""
        node, world = (np.full(self.count, NO_NODE, np.int32) for _ in range(2))
        self._fill_bearing()
        triangles = np.full((self.triangle_count, 3), -1, np.int32)
        opposite = np.full(self.triangle_count, -1, np.int32)
        warmth = np.full(self.triangle_count, WARMTH, np.float32)
        edges, sides = (np.full((self.edge_count, 2), -1, np.int32) for _ in range(2))
        for body, part in zip(self.bodies, self.parts, strict=True):
            for w in range(self.worlds):
                first, first_triangle = part.start + w * part.nodes, part.triangle_start + w * part.triangles
                skin = part.skin
                node[first : first + len(skin.nodes)] = skin.nodes + w * body.world_node_count
                world[first : first + part.nodes] = w
                triangles[first_triangle : first_triangle + len(skin.triangles)] = skin.triangles + first
                own = slice(first_triangle, first_triangle + len(skin.opposite))
                warmth[own][skin.is_thin] = 1.0
                opposite[own] = np.where(skin.opposite < 0, -1, skin.opposite + first)
                own = slice(part.edge_start + w * part.edges, part.edge_start + w * part.edges + len(skin.edges))
                edges[own], sides[own] = skin.edges + first, skin.sides + first_triangle
        for k, own in enumerate(self.places):
            places = np.full(len(own), -1, np.int32)
            part = self.parts[k]
            if part.skin.own is None:
                used = np.flatnonzero(node[self.places_of(k)] >= 0) + part.start
                places[node[used]] = used
            else:
                for w in range(self.worlds):
                    bearers = part.skin.bearers + w * self.bodies[k].world_node_count
                    places[bearers] = part.bearer_start + w * part.bearers + np.arange(len(bearers))
            own.assign(places)
        self.arrays.node.assign(node)
        self.arrays.world.assign(world)
        self.triangles.assign(triangles)
        self.opposite.assign(opposite)
        self.warmth.assign(warmth)
        self.edges.assign(edges)
        self.sides.assign(sides)
        ends = triangles.ravel()
        used = np.flatnonzero(ends >= 0)
        order = used[np.argsort(ends[used], kind="stable")]
        starts = np.searchsorted(ends[order], np.arange(self.count + 1))
        self.corner_starts.assign(starts.astype(np.int32))
        self.corners[: len(order)].assign(order.astype(np.int32))


def _sizes(skin: Skin) -> list[int]:
    """Numbers of places, triangles, edges and bearers."""
    counts = [max(len(each), 1) for each in (skin.nodes, skin.triangles, skin.edges)]
    return [*counts, len(skin.bearers)]


def _places(count: int, device: wp.Device) -> Surface:
    """Arrays for a number of places."""
    arrays = Surface()
    arrays.node, arrays.world = (wp.empty(count, dtype=wp.int32, device=device) for _ in range(2))
    for name in ("rest", "x", "d", "f"):
        setattr(arrays, name, wp.zeros(count, dtype=wp.vec3, device=device))
    arrays.yielding = wp.zeros(count, dtype=wp.float32, device=device)
    return arrays


# --- surfaces of bodies whose parts several ranks hold ----------------------------------------------------------------

#: What a surface's struct has besides the nodes.
SHARED = ("world", "rest", "x", "d", "yielding", "f")
#: The arrays of places, or of bearers, that ranks exchange.
EXCHANGED = ("x", "d", "yielding")


class WholeSurface(ContactSurface):
    """The whole surfaces, of which each rank moves some nodes or bearers. All ranks do the same with them.

    Args:
        system: The parts of the bodies that this rank computes.
        are_own, are_close: As for ``ContactSurface``.
    """

    is_whole = True

    def __init__(self, system: System, *, are_own: bool = False, are_close: bool = False):
        self._system = system
        wholes = [system.ranks.owned(body).whole for body in system.bodies]
        super().__init__(wholes, are_own=are_own, are_close=are_close, device=system.device)

    @property
    def own(self) -> Surface:
        return self._own

    @property
    def own_bearers(self) -> Surface:
        return self._own_bearers

    @property
    def solids(self) -> list[tuple[SoftBody, wp.array]]:
        return self._solids

    def complete(self) -> None:
        """Launch the exchange after which every rank has the motion of all places at nodes, and of all bearers."""
        for exchange, arrays in zip(self._exchanges, (self.arrays, self.bearers), strict=True):
            for values in (getattr(arrays, name) for name in EXCHANGED):
                if len(values):
                    exchange(values)

    def _fill(self) -> None:
        super()._fill()
        ranks, self._solids = self._system.ranks, []
        at_places, at_bearers = (_Held(each) for each in (self.arrays, self.bearers))
        for k, (part, whole) in enumerate(zip(self._system.bodies, self.bodies, strict=True)):
            owned = ranks.owned(part)
            numbers, is_own = owned.places, owned.nodes
            number = np.full(whole.node_count, NO_NODE, np.int32)
            number[numbers[is_own]] = np.flatnonzero(is_own)
            rest = whole.state.rest.numpy()[:, :3]
            here = self.parts[k]
            if here.bearers:
                at_bearers.take(here.bearer_start, self.worlds * here.bearers, number, rest)
            else:
                at_places.take(here.start, self.worlds * here.nodes, number, rest)
            of_nodes = np.full(len(part.state.rest), -1, np.int32)
            of_nodes[: len(numbers)] = self.places[k].numpy()[numbers]
            self._solids.append((part, wp.array(of_nodes, dtype=wp.int32, device=self.device)))
        self._own, self._own_bearers = at_places.own(self.device), at_bearers.own(self.device)
        self._exchanges = [ranks.connect(np.arange(len(own)), own) for own in (at_places.moved, at_bearers.moved)]


class _Held:
    """Places of a surface, or its bearers, and which of them this rank moves.

    Args:
        whole: All of them.
    """

    def __init__(self, whole: Surface):
        self._whole, self._node = whole, whole.node.numpy()
        self._found = np.full(len(self._node), NO_NODE, np.int32)
        self._rest = whole.rest.numpy()

    def take(self, start: int, count: int, number: npt.NDArray[np.int32], rest: npt.NDArray[np.float32]) -> None:
        """Take those of a body.

        Args:
            start, count: Where they are.
            number: The number in this rank's part of each node of the whole body, -1 for those of other ranks.
            rest: The rest positions of the nodes [m].
        """
        used = start + np.flatnonzero(self._node[start : start + count] >= 0)
        self._found[used] = number[self._node[used]]
        self._rest[used] = rest[self._node[used]]

    @property
    def moved(self) -> npt.NDArray[np.bool_]:
        """Which of them this rank moves, bool."""
        return self._found >= 0

    def own(self, device: wp.Device) -> Surface:
        """The same arrays with only the nodes that this rank moves, by their numbers in its parts."""
        self._whole.rest.assign(self._rest)
        made = Surface()
        for name in SHARED:
            setattr(made, name, getattr(self._whole, name))
        made.node = wp.array(self._found, dtype=wp.int32, device=device)
        return made


class SurfaceHalo:
    """The exchange of values at the places of a surface.

    A rank has all triangles of the bodies' surfaces around its nodes. It finds the forces of obstacles on them from the
    same numbers as the other ranks that have these triangles. Its sums at nodes of other ranks are incomplete and are
    replaced.

    Args:
        ranks: The ranks; alone, nothing is launched.
        surface: This rank's surfaces.

    Attributes:
        ranks: As given.
        exchange: Launches the exchange of an array over the places, of any numbers or vectors.
    """

    def __init__(self, ranks: Halo, surface: ContactSurface):
        self.ranks = ranks
        node = surface.arrays.node.numpy()
        number, own = np.full(len(node), -1, np.int64), np.ones(len(node), bool)
        first = 0
        for k, body in enumerate(() if ranks.is_alone else surface.bodies):
            owned = ranks.owned(body)
            assert owned.numbers is not None
            here = np.arange(len(node))[surface.places_of(k)]
            here = here[node[here] >= 0]
            number[here], own[here] = first + owned.numbers[node[here]], owned.nodes[node[here]]
            first += owned.node_count
        self.exchange = ranks.connect(number, own & (number >= 0))
        self._ghosts = wp.array(np.flatnonzero(~own).astype(np.int32), dtype=wp.int32, device=surface.device)

    def clear(self, forces: wp.array) -> None:
        """Launch the reset to zero of forces on nodes of other ranks: their own ranks add them."""
        if len(self._ghosts):
            wp.launch(clear_values, len(self._ghosts), [self._ghosts], [forces], device=self._ghosts.device)


# --- the tree of the CPU ----------------------------------------------------------------------------------------------

LANES = int(wide_tree.LANES)
#: Leaves of a root.
OF_ROOT = LANES * LANES

Numbers = npt.NDArray[np.integer]
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


def _leaves(x: Floats, group: Numbers) -> tuple[Numbers, Numbers]:
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


def _lanes(of: Numbers, leaves: int) -> tuple[Numbers, Numbers]:
    """The first node of each leaf, and what is in the lanes of nodes: the items of each leaf."""
    items = np.flatnonzero(of >= 0)
    items = items[np.argsort(of[items], kind="stable")]
    counts = np.bincount(of[items], minlength=leaves)
    starts = np.concatenate([[0], np.cumsum(-(-counts // LANES))])
    lanes = np.full(LANES * starts[-1], -1)
    lanes[LANES * starts[of[items]] + np.arange(len(items)) - (np.cumsum(counts) - counts)[of[items]]] = items
    return starts, lanes
