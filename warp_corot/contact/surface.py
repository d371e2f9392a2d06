"""The surface nodes and triangles of all bodies of a simulation, one after another on the device."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, cast

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.kernels.contact.motion import Bearing, Surface

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
    skin: Skin
    version: int

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
    def count(self) -> int:
        """Number of places for nodes."""
        last = self.parts[-1]
        return last.start + self.worlds * last.nodes

    @property
    def triangle_count(self) -> int:
        """Number of places for triangles."""
        last = self.parts[-1]
        return last.triangle_start + self.worlds * last.triangles

    @property
    def edge_count(self) -> int:
        """Number of places for edges."""
        last = self.parts[-1]
        return last.edge_start + self.worlds * last.edges

    @property
    def bearer_count(self) -> int:
        """Number of places for bearers."""
        last = self.parts[-1]
        return last.bearer_start + self.worlds * last.bearers

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
        self.parts = []
        start = triangle_start = edge_start = bearer_start = 0
        for k, (body, skin) in enumerate(zip(self.bodies, skins, strict=True)):
            more = ROOM if body.changing is not None else 1.0
            least = _sizes(skin)
            sizes = [int(more * size) for size in least]
            if rooms is not None:
                sizes = [max(int(room), size) for room, size in zip(rooms[k], least, strict=True)]
            nodes, triangles, edges, bearers = sizes
            starts = (start, triangle_start, edge_start, bearer_start)
            self.parts.append(Part(*starts, nodes, triangles, edges, bearers, skin, body.version))
            start += self.worlds * nodes
            triangle_start += self.worlds * triangles
            edge_start += self.worlds * edges
            bearer_start += self.worlds * bearers
        count, device = start, self.device
        self.bearers = _places(bearer_start, device)
        self.arrays = _places(count, device)
        self.arrays.bearing = self._room_for_bearing(count)
        self.triangles = wp.empty(triangle_start, dtype=wp.vec3i, device=device)
        self.opposite = wp.empty(triangle_start, dtype=wp.int32, device=device)
        self.warmth = wp.empty(triangle_start, dtype=wp.float32, device=device)
        self.edges, self.sides = (wp.empty(edge_start, dtype=wp.vec2i, device=device) for _ in range(2))
        self.corner_starts = wp.empty(count + 1, dtype=wp.int32, device=device)
        self.corners = wp.empty(3 * triangle_start, dtype=wp.int32, device=device)
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
