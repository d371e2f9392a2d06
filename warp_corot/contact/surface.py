"""The surface nodes and triangles of all bodies of a simulation, one after another on the device."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.kernels.contact.motion import Surface

if TYPE_CHECKING:
    from warp_corot.body.soft_body import SoftBody

#: Room for a body whose mesh changes, over the size of its surface when the room is reserved.
ROOM = 1.5
NO_NODE = -1

Ints = npt.NDArray[np.int32]


@dataclass(frozen=True)
class Skin:
    """The surface of one world of a body.

    Attributes:
        nodes: Its nodes, int32 [n].
        triangles: Their places in ``nodes``, int32 [t, 3], counter-clockwise seen from outside.
        edges: The same for their edges, int32 [e, 2].
        sides: The two triangles at each edge, int32 [e, 2].
        opposite: The place of the fourth node of each triangle's tetrahedron, int32 [t]; -1 inside the body.
    """

    nodes: Ints
    triangles: Ints
    edges: Ints
    sides: Ints
    opposite: Ints

    @classmethod
    def of(cls, body: SoftBody) -> Skin:
        """The surface of a body's present mesh."""
        tets = body.mesh.tets
        faces, parents = body.surface_faces
        nodes, places = np.unique(faces, return_inverse=True)
        triangles = places.reshape(-1, 3).astype(np.int32)
        fourth = tets[parents].sum(axis=1) - faces.sum(axis=1)
        found = np.minimum(np.searchsorted(nodes, fourth), len(nodes) - 1)
        opposite = np.where(nodes[found] == fourth, found, -1).astype(np.int32)
        return cls(nodes.astype(np.int32), triangles, *_edges_of(triangles), opposite)


def _edges_of(triangles: Ints) -> tuple[Ints, Ints]:
    """The edges of a closed surface, and two triangles at each."""
    ends = np.sort(triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    order = np.lexsort((ends[:, 1], ends[:, 0]))
    edges, first = np.unique(ends[order], axis=0, return_index=True)
    owners = order // 3
    # If more than two triangles meet in an edge, as where two bodies share one, the first two of them count.
    sides = np.column_stack([owners[first], owners[np.minimum(first + 1, len(owners) - 1)]])
    return edges.astype(np.int32), sides.astype(np.int32)


@dataclass
class Part:
    """The place of a body's surface in the common arrays, world after world, and its room in each world.

    Attributes:
        start, triangle_start, edge_start: Its first place, its first triangle and its first edge.
        nodes, triangles, edges: Number of places for one world.
        skin: The surface.
        version: The version of the mesh.
    """

    start: int
    triangle_start: int
    edge_start: int
    nodes: int
    triangles: int
    edges: int
    skin: Skin
    version: int


class ContactSurface:
    """The surfaces of bodies, which follow their meshes.

    Args:
        bodies: All bodies, with the same number of worlds.

    Attributes:
        arrays: The nodes, as a struct for kernels.
        triangles: Places of their corners, vec3i [T]; -1 where there is none.
        opposite: For each triangle the fourth node of its tetrahedron, int32 [T]; -1 inside the body.
        edges, sides: Places of the ends of edges, and the two triangles of each, vec2i [E]; -1 where there is none.
        corner_starts, corners: For each node, from one start to the next: three times a triangle and which corner.
        parts: The place of each body.
        places: For each body the place of each node, int32 [nodes]; -1 inside.
        revision: Changes whenever arrays are replaced.
    """

    #: Whether places of nodes that other ranks move are among them, with all values.
    is_whole = False

    def __init__(self, bodies: Sequence[SoftBody]):
        self.bodies, self.worlds, self.device = tuple(bodies), bodies[0].worlds, bodies[0].device
        self.revision = 0
        self.parts: list[Part] = []
        self._make_room([Skin.of(body) for body in bodies])

    @property
    def own(self) -> Surface:
        """The nodes that this process moves, as a struct for kernels."""
        return self.arrays

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

    def body_of_places(self) -> Ints:
        """The number of the body at each place for a node, int32 [S]."""
        return np.repeat(np.arange(len(self.parts)), [self.worlds * part.nodes for part in self.parts]).astype(np.int32)

    def follow(self) -> bool:
        """Update to the present meshes; returns whether any has changed."""
        changed = [k for k, body in enumerate(self.bodies) if body.version != self.parts[k].version]
        if not changed:
            return False
        skins = [Skin.of(body) if k in changed else self.parts[k].skin for k, body in enumerate(self.bodies)]
        fits = all(len(body.state.rest) == len(own) for body, own in zip(self.bodies, self.places, strict=True))
        fits = fits and all(
            len(skin.nodes) <= part.nodes and len(skin.triangles) <= part.triangles and len(skin.edges) <= part.edges
            for skin, part in zip(skins, self.parts, strict=True)
        )
        if not fits:
            self._make_room(skins)
            return True
        for body, part, skin in zip(self.bodies, self.parts, skins, strict=True):
            part.skin, part.version = skin, body.version
        self._fill()
        return True

    @property
    def rooms(self) -> list[list[int]]:
        """Number of places for nodes, triangles and edges of each body in a world."""
        return [[part.nodes, part.triangles, part.edges] for part in self.parts]

    def make_room(self, rooms: Sequence[Sequence[int]]) -> None:
        """Update to the present meshes, with the room of a former ``rooms``."""
        self._make_room([Skin.of(body) for body in self.bodies], rooms)

    def places_of(self, k: int) -> slice:
        """The places of a body's nodes."""
        part = self.parts[k]
        return slice(part.start, part.start + self.worlds * part.nodes)

    def nodes_at(self, places: npt.NDArray[np.integer]) -> tuple[int, int, tuple[int, ...]]:
        """The body at some places of one world, that world, and their nodes numbered within it."""
        k = max(number for number, part in enumerate(self.parts) if part.start <= places[0])
        part = self.parts[k]
        world = (int(places[0]) - part.start) // part.nodes
        own = places - part.start - world * part.nodes
        return k, world, tuple(int(node) for node in part.skin.nodes[own])

    # --- pieces ----------------------------------------------------------------------------------------------------

    def _make_room(self, skins: Sequence[Skin], rooms: Sequence[Sequence[int]] | None = None) -> None:
        self.parts = []
        start = triangle_start = edge_start = 0
        for k, (body, skin) in enumerate(zip(self.bodies, skins, strict=True)):
            more = ROOM if body.changing is not None else 1.0
            sizes = (len(skin.nodes), len(skin.triangles), len(skin.edges))
            nodes, triangles, edges = (int(more * max(size, 1)) for size in sizes)
            if rooms is not None:
                nodes, triangles, edges = (max(int(room), size) for room, size in zip(rooms[k], sizes, strict=True))
            self.parts.append(Part(start, triangle_start, edge_start, nodes, triangles, edges, skin, body.version))
            start += self.worlds * nodes
            triangle_start += self.worlds * triangles
            edge_start += self.worlds * edges
        count, device = start, self.device
        arrays = Surface()
        arrays.node, arrays.world = (wp.empty(count, dtype=wp.int32, device=device) for _ in range(2))
        for name in ("rest", "x", "d", "f"):
            setattr(arrays, name, wp.zeros(count, dtype=wp.vec3, device=device))
        arrays.yielding = wp.zeros(count, dtype=wp.float32, device=device)
        self.arrays = arrays
        self.triangles = wp.empty(triangle_start, dtype=wp.vec3i, device=device)
        self.opposite = wp.empty(triangle_start, dtype=wp.int32, device=device)
        self.edges, self.sides = (wp.empty(edge_start, dtype=wp.vec2i, device=device) for _ in range(2))
        self.corner_starts = wp.empty(count + 1, dtype=wp.int32, device=device)
        self.corners = wp.empty(3 * triangle_start, dtype=wp.int32, device=device)
        self.places = [wp.empty(len(body.state.rest), dtype=wp.int32, device=device) for body in self.bodies]
        self.revision += 1
        self._fill()

    def _fill(self) -> None:
        """Copy the surfaces to the device."""
        node, world = (np.full(self.count, NO_NODE, np.int32) for _ in range(2))
        triangles = np.full((self.triangle_count, 3), -1, np.int32)
        opposite = np.full(self.triangle_count, -1, np.int32)
        edges, sides = (np.full((self.edge_count, 2), -1, np.int32) for _ in range(2))
        for body, part in zip(self.bodies, self.parts, strict=True):
            for w in range(self.worlds):
                first, first_triangle = part.start + w * part.nodes, part.triangle_start + w * part.triangles
                skin = part.skin
                node[first : first + len(skin.nodes)] = skin.nodes + w * body.world_node_count
                world[first : first + part.nodes] = w
                triangles[first_triangle : first_triangle + len(skin.triangles)] = skin.triangles + first
                own = slice(first_triangle, first_triangle + len(skin.opposite))
                opposite[own] = np.where(skin.opposite < 0, -1, skin.opposite + first)
                own = slice(part.edge_start + w * part.edges, part.edge_start + w * part.edges + len(skin.edges))
                edges[own], sides[own] = skin.edges + first, skin.sides + first_triangle
        for k, own in enumerate(self.places):
            places = np.full(len(own), -1, np.int32)
            used = np.flatnonzero(node[self.places_of(k)] >= 0) + self.parts[k].start
            places[node[used]] = used
            own.assign(places)
        self.arrays.node.assign(node)
        self.arrays.world.assign(world)
        self.triangles.assign(triangles)
        self.opposite.assign(opposite)
        self.edges.assign(edges)
        self.sides.assign(sides)
        ends = triangles.ravel()
        used = np.flatnonzero(ends >= 0)
        order = used[np.argsort(ends[used], kind="stable")]
        starts = np.searchsorted(ends[order], np.arange(self.count + 1))
        self.corner_starts.assign(starts.astype(np.int32))
        self.corners[: len(order)].assign(order.astype(np.int32))
