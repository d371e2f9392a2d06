"""The surface of one body that contact acts on."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.discretization.changing.transfer import FollowingBinding
from warp_corot.kernels.remesh import derived as kernels
from warp_corot.mesh.forest import TetForest
from warp_corot.mesh.surfaces.bound import BoundPoints, SurfaceMesh
from warp_corot.mesh.surfaces.clustering import Clusters, closer, clustered, departures, longest_edge, resolved, split

if TYPE_CHECKING:
    from warp_corot.body.soft_body import SoftBody
    from warp_corot.mesh import TetMesh

#: The distance between points of a body's own surface, over the edge of a cube of six of the elements there: with
#: fewer points surfaces lose their shape, with more they touch in more places than the nodes can follow.
APART = 1.0

Ints = npt.NDArray[np.int32]
Numbers = npt.NDArray[np.integer]


@dataclass(frozen=True)
class Skin:
    """The surface of one world of a body.

    Attributes:
        nodes: The node at each place, or the first of those that bear it, int32 [n].
        own: The body's own surface, whose points are the places; None: the places are nodes of the tetrahedra.
        triangles: Their corners, as places, int32 [t, 3], counter-clockwise seen from outside.
        edges: The same for their edges, int32 [e, 2].
        sides: The two triangles at each edge, int32 [e, 2].
        opposite: The place of the fourth node of each triangle's tetrahedron, int32 [t]; -1 inside the body, and for
            places that are not nodes.
    """

    nodes: Ints
    own: SurfaceMesh | None
    triangles: Ints
    edges: Ints
    sides: Ints
    opposite: Ints

    @classmethod
    def of(cls, body: SoftBody, *, is_own: bool, is_close: bool) -> Skin:
        """The surface of a body's present mesh: the body's own if there is one and ``is_own``, or the boundary of the
        tetrahedra."""
        own = own_surface(body.mesh, is_close=is_close) if is_own else None
        if own is not None:
            return cls.of_surface(own)
        tets = body.mesh.tets
        faces, parents = body.surface_faces
        nodes, places = np.unique(faces, return_inverse=True)
        triangles = places.reshape(-1, 3).astype(np.int32)
        fourth = tets[parents].sum(axis=1) - faces.sum(axis=1)
        found = np.minimum(np.searchsorted(nodes, fourth), len(nodes) - 1)
        opposite = np.where(nodes[found] == fourth, found, -1).astype(np.int32)
        return cls(nodes.astype(np.int32), None, triangles, *_edges_of(triangles), opposite)

    @classmethod
    def of_surface(cls, own: SurfaceMesh) -> Skin:
        """A body's own surface."""
        opposite = np.full(len(own.triangles), -1, np.int32)
        return cls(own.nodes[:, 0], own, own.triangles, *_edges_of(own.triangles), opposite)

    def on(self, own: SurfaceMesh) -> Skin:
        """The same triangles and edges with other nodes around the points."""
        return replace(self, nodes=own.nodes[:, 0], own=own)

    def points(self, rest: npt.NDArray[np.float32]) -> npt.NDArray[np.floating]:
        """Rest positions of the places [m], [n, 3], from those of the nodes, [N, 3] or more."""
        return rest[self.nodes, :3] if self.own is None else self.own.points

    @property
    def is_thin(self) -> npt.NDArray[np.bool_]:
        """Whether nodes around a triangle bear points of opposite sides of the body, too, bool [t]."""
        if self.own is None:
            return np.zeros(len(self.triangles), bool)
        return np.asarray(self.own.is_thin[self.triangles].all(axis=1))

    @property
    def bearers(self) -> Ints:
        """The nodes that bear places, int32 [b]."""
        if self.own is None:
            return np.zeros(0, np.int32)
        bears = np.zeros(int(self.own.nodes.max(initial=-1)) + 1, bool)
        bears[self.own.nodes[self.own.weights != 0.0]] = True
        return np.flatnonzero(bears).astype(np.int32)


def has_own_surface(mesh: TetForest | TetMesh) -> bool:
    """Whether a mesh has another surface than the boundary of its tetrahedra: it was made from a domain."""
    return isinstance(mesh, TetForest) and mesh.phi is not None


def own_surface(mesh: TetForest | TetMesh, *, is_close: bool) -> SurfaceMesh | None:
    """The marched surface of a mesh, with points about as far apart as its nodes, or closer on coarse meshes; None
    without such a surface."""
    if not isinstance(mesh, TetForest) or mesh.phi is None:
        return None
    whole = mesh.surface()
    sizes = apart(mesh, levels_at(mesh, whole))
    return clustered(whole, resolved(whole, closer(whole, sizes) if is_close else sizes))


def levels_at(mesh: TetForest, points: BoundPoints) -> Ints:
    """The finest level around the node with the largest weight at each point."""
    level = np.zeros(mesh.node_count, np.int32)
    for each in np.unique(mesh.levels):
        level[mesh.tets[mesh.levels == each]] = each  # the finest comes last
    return level[np.take_along_axis(points.nodes, np.argmax(points.weights, axis=1)[:, None], axis=1)[:, 0]]


def apart(mesh: TetForest, levels: npt.NDArray[np.integer]) -> npt.NDArray[np.float64]:
    """How far points should be from one another where elements have these levels [m]."""
    return APART * mesh.cell_size * 2.0 ** (-levels / 3.0)


def _edges_of(triangles: Ints) -> tuple[Ints, Ints]:
    """The edges of a closed surface, and two triangles at each."""
    ends = np.sort(triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1).astype(np.int64)
    keys = ends[:, 0] << 32 | ends[:, 1]
    order = np.argsort(keys, kind="stable")
    keys, owners = keys[order], order // 3
    first = np.flatnonzero(np.append(True, keys[1:] != keys[:-1])[: len(keys)])
    # If more than two triangles meet in an edge, as where two bodies share one, the first two of them count.
    sides = np.column_stack([owners[first], owners[np.minimum(first + 1, len(owners) - 1)]])
    return np.column_stack([keys[first] >> 32, keys[first] & 0xFFFFFFFF]).astype(np.int32), sides.astype(np.int32)


# --- of a body that is remeshed ---------------------------------------------------------------------------------------

#: Triangles are split if they have edges longer than this many times the distance that points should have, as long as
#: there are no more points than this.
LONGEST, MOST_POINTS = 3.0, 1 << 17
#: Smaller weights come from rounding: points on edges have two nodes.
LEAST_WEIGHT = 1e-6


class FollowedSurface:
    """The surface of the first mesh, thinned where the present one is coarse, but nowhere so far that it leaves the
    drawn one by more than a fraction of the distance that points of the first mesh have.

    It needs no copy of the present mesh on the host: the device finds the elements that hold the points.

    Args:
        body: A body that is remeshed and has its own surface.
        is_close: Whether points are closer on coarse meshes.
    """

    def __init__(self, body: SoftBody, *, is_close: bool):
        assert body.changing is not None
        self._body, self._is_close = body, is_close
        self._known: Skin | None = None
        self._known_levels: Numbers = np.zeros(0, np.int32)
        self._kept: Numbers = np.zeros(0, np.int64)
        self._last = whole = body.changing.forest.source.surface()
        self._version = -1
        self._take(whole.points, whole.triangles)

    def skin(self) -> Skin:
        """The surface on the present mesh. Where levels are as they were, it has the same points; if they are so
        everywhere, it has the same arrays of triangles and edges."""
        levels = self._levels()
        while self._is_coarse(levels):
            self._take(*split(self._points, self._triangles))
            levels = self._levels()
        levels = self._in_shape(levels)
        if self._known is None or not np.array_equal(levels, self._known_levels):
            self._known_levels = levels
            self._kept, triangles = self._clusters.thinned(levels)
            self._last = self._bound(triangles)
            self._known = Skin.of_surface(self._last)
        else:
            self._last = self._bound(self._last.triangles)
            self._known = self._known.on(self._last)
        self._version = self._body.version
        return self._known

    def last(self) -> SurfaceMesh:
        """The last ``skin``, bound to the nodes of the present mesh."""
        if self._version != self._body.version:
            assert self._body.changing is not None
            self._binding.rebind(self._body.changing.forest.pools)
            self._last, self._version = self._bound(self._last.triangles), self._body.version
        return self._last

    # --- pieces ------------------------------------------------------------------------------------------------------

    def _take(self, points: npt.NDArray[np.float64], triangles: npt.NDArray[Any]) -> None:
        assert self._body.changing is not None
        source, device = self._body.changing.forest.source, self._body.device
        self._points, self._triangles = points, triangles
        leaves, weights = source.embed(points)
        bound = BoundPoints(points, source.tets[leaves], weights)
        self._binding = FollowingBinding(bound, source, leaves, device)
        levels = levels_at(source, bound)
        sizes = apart(source, levels)
        surface = SurfaceMesh(points, bound.nodes, weights, triangles)
        resolved_sizes = resolved(surface, closer(surface, sizes) if self._is_close else sizes)
        fewer = np.rint(3.0 * np.log2(sizes / resolved_sizes))
        self._far = departures(surface, resolved_sizes)
        #: The lowest level at each point with which the surface keeps its shape, of those down to ``_tried``.
        self._least: Numbers = levels + np.maximum(fewer, 0.0).astype(np.int32)
        self._tried = int(self._least.max(initial=0))
        self._clusters = Clusters(points, triangles, APART * source.cell_size)
        self._of_points = wp.zeros(len(points), dtype=wp.int32, device=device)
        self._known = None

    def _in_shape(self, levels: Numbers) -> Numbers:
        """These levels, or higher ones where the surface would lose its shape."""
        below = levels[levels < self._least]
        while self._tried > below.min(initial=self._tried):
            self._tried -= 1
            self._least = self._clusters.lowered(self._least, self._tried, self._far)
        return np.maximum(levels, self._least)

    def _levels(self) -> Numbers:
        """Bind the points to the present elements, and return the level at each."""
        assert self._body.changing is not None
        pools, device = self._body.changing.forest.pools, self._body.device
        self._binding.rebind(pools)
        of_nodes = wp.zeros(pools.sink + 1, dtype=wp.int32, device=device)
        wp.launch(kernels.find_node_levels, self._body.changing.forest.capacity, [pools], [of_nodes], device=device)
        inputs = [self._binding.nodes, self._binding.weights, of_nodes]
        wp.launch(kernels.find_point_levels, len(self._points), inputs, [self._of_points], device=device)
        return self._of_points.numpy().copy()

    def _is_coarse(self, levels: Numbers) -> bool:
        """Whether triangles are too large for the elements."""
        assert self._body.changing is not None
        sizes = apart(self._body.changing.forest.source, levels)
        return 4 * len(self._points) <= MOST_POINTS and longest_edge(self._points, self._triangles, sizes) > LONGEST

    def _bound(self, triangles: Numbers) -> SurfaceMesh:
        nodes, weights = (array.numpy()[self._kept] for array in (self._binding.nodes, self._binding.weights))
        weights = np.where(np.abs(weights) < LEAST_WEIGHT, 0.0, weights.astype(np.float64))
        weights /= weights.sum(axis=1, keepdims=True)
        return SurfaceMesh(self._points[self._kept], nodes.astype(np.int32), weights, triangles)
