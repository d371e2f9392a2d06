"""The own surface of a body that is remeshed: its points stay while the elements around them change."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.discretization.changing.transfer import FollowingBinding
from warp_corot.kernels.remesh import derived as kernels
from warp_corot.mesh.surfaces.bound import BoundPoints, SurfaceMesh
from warp_corot.mesh.surfaces.clustering import Clusters, departures, longest_edge, resolved, split

from .skin import APART, Skin, apart, levels_at

if TYPE_CHECKING:
    from warp_corot.body.soft_body import SoftBody

#: Triangles are split if they have edges longer than this many times the distance that points should have, as long as
#: there are no more points than this.
LONGEST, MOST_POINTS = 3.0, 1 << 17
#: Smaller weights come from rounding: points on edges have two nodes.
LEAST_WEIGHT = 1e-6

Ints = npt.NDArray[np.integer]


class FollowedSurface:
    """The surface of the first mesh, thinned where the present one is coarse, but nowhere so far that it leaves the
    drawn one by more than a fraction of the distance that points of the first mesh have.

    It needs no copy of the present mesh on the host: the device finds the elements that hold the points.

    Args:
        body: A body that is remeshed and has its own surface.
    """

    def __init__(self, body: SoftBody):
        assert body.changing is not None
        self._body = body
        self._known: Skin | None = None
        self._known_levels: Ints = np.zeros(0, np.int32)
        self._kept: Ints = np.zeros(0, np.int64)
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
        resolved_sizes = resolved(surface, sizes)
        fewer = np.rint(3.0 * np.log2(sizes / resolved_sizes))
        self._far = departures(surface, resolved_sizes)
        #: The lowest level at each point with which the surface keeps its shape, of those down to ``_tried``.
        self._least: Ints = levels + np.maximum(fewer, 0.0).astype(np.int32)
        self._tried = int(self._least.max(initial=0))
        self._clusters = Clusters(points, triangles, APART * source.cell_size)
        self._of_points = wp.zeros(len(points), dtype=wp.int32, device=device)
        self._known = None

    def _in_shape(self, levels: Ints) -> Ints:
        """These levels, or higher ones where the surface would lose its shape."""
        below = levels[levels < self._least]
        while self._tried > below.min(initial=self._tried):
            self._tried -= 1
            self._least = self._clusters.lowered(self._least, self._tried, self._far)
        return np.maximum(levels, self._least)

    def _levels(self) -> Ints:
        """Bind the points to the present elements, and return the level at each."""
        assert self._body.changing is not None
        pools, device = self._body.changing.forest.pools, self._body.device
        self._binding.rebind(pools)
        of_nodes = wp.zeros(pools.sink + 1, dtype=wp.int32, device=device)
        wp.launch(kernels.find_node_levels, self._body.changing.forest.capacity, [pools], [of_nodes], device=device)
        inputs = [self._binding.nodes, self._binding.weights, of_nodes]
        wp.launch(kernels.find_point_levels, len(self._points), inputs, [self._of_points], device=device)
        return self._of_points.numpy().copy()

    def _is_coarse(self, levels: Ints) -> bool:
        """Whether triangles are too large for the elements."""
        assert self._body.changing is not None
        sizes = apart(self._body.changing.forest.source, levels)
        return 4 * len(self._points) <= MOST_POINTS and longest_edge(self._points, self._triangles, sizes) > LONGEST

    def _bound(self, triangles: Ints) -> SurfaceMesh:
        nodes, weights = (array.numpy()[self._kept] for array in (self._binding.nodes, self._binding.weights))
        weights = np.where(np.abs(weights) < LEAST_WEIGHT, 0.0, weights.astype(np.float64))
        weights /= weights.sum(axis=1, keepdims=True)
        return SurfaceMesh(self._points[self._kept], nodes.astype(np.int32), weights, triangles)
