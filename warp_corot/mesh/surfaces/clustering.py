"""Finer surfaces of the same shape, in which each triangle becomes four; and coarser ones, in which vertices that are
close together become one of them (vertex clustering, Rossignac and Borrel 1993).

Marched surfaces have triangles of all sizes, many far smaller than the elements that carry them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from warp_corot.mesh.surfaces.bound import SurfaceMesh, distances_from, nearest_faces
from warp_corot.mesh.topology import linked

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.integer]


def split(points: Floats, triangles: Ints) -> tuple[Floats, Ints]:
    """A closed surface with the middles of its edges as further points.

    Args:
        points: [V, 3].
        triangles: [F, 3].

    Returns:
        The points, the given ones first, and triangles [4 F, 3].
    """
    ends = np.sort(triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1).astype(np.int64)
    keys, which = np.unique(ends[:, 0] << 32 | ends[:, 1], return_inverse=True)
    middles = 0.5 * (points[keys >> 32] + points[keys & 0xFFFFFFFF])
    a, b, c = triangles.T
    ab, bc, ca = len(points) + which.reshape(-1, 3).T
    corners = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
    made = np.concatenate([np.column_stack(each) for each in corners])
    return np.concatenate([points, middles]), made.astype(np.int32)


def longest_edge(points: Floats, triangles: Ints, sizes: Floats) -> float:
    """The length of the longest edge, over the smaller one of the sizes at its ends [V]."""
    first, second = triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).T
    once = first < second
    first, second = first[once], second[once]
    lengths = np.linalg.norm(points[first] - points[second], axis=1)
    return float((lengths / np.minimum(sizes[first], sizes[second])).max(initial=0.0))


#: Where vertices would be farther from the coarser surface than this many sizes, or, where the body is not thin, than
#: this fraction of the largest extent of the surface, sizes are halved, this many times.
LOST, HANGING, HALVED = 0.15, 0.005, 2
#: ``closer`` puts vertices no farther apart than this fraction of the largest extent of the surface, and no closer than
#: this fraction of the given sizes.
CLOSE, CLOSEST = 0.02, 0.4
#: The weight of the distance from the middle of a cluster, among squares of distances from planes.
FLAT = 0.1


def clustered(surface: SurfaceMesh, sizes: Floats) -> SurfaceMesh:
    """A surface with vertices about a size apart; each is a vertex of the given one.

    Each stands for the vertices of its cluster: the one nearest to the planes of their triangles, so that edges and
    corners stay. Vertices become one if they are in the same cube of that size and a path of edges within it connects
    them, so that the two sides of a sheet stay two. A closed surface stays closed. Parts smaller than a cube vanish,
    but a piece of the surface that would vanish as a whole stays as it is.

    Args:
        surface: The surface.
        sizes: The size at each of its vertices [m], [V]; vertices of different sizes stay apart.
    """
    quadrics = _quadrics(surface.points, surface.triangles)
    kept, triangles, quadrics = _merged(surface.points, surface.triangles, quadrics, sizes, 0.0)
    # Vertices on both sides of a cube's wall may still be close together.
    again, triangles, _ = _merged(surface.points[kept], triangles, quadrics, 0.5 * sizes[kept], 0.5)
    kept = kept[again]
    pieces = linked(_edges(surface.triangles), len(surface.points))
    lost = np.zeros(len(surface.points), bool)
    lost[surface.triangles] = True
    lost &= ~np.isin(pieces, pieces[kept])
    if lost.any():
        places = np.cumsum(lost) - 1 + len(kept)
        whole = surface.triangles[lost[surface.triangles].all(axis=1)]
        triangles, kept = np.concatenate([triangles, places[whole]]), np.append(kept, np.flatnonzero(lost))
    return replace(
        surface,
        points=surface.points[kept],
        nodes=surface.nodes[kept],
        weights=surface.weights[kept],
        triangles=triangles.astype(np.int32),
        sides=None,
    )


def _merged(
    points: Floats, triangles: Ints, quadrics: Floats, sizes: Floats, shift: float
) -> tuple[Ints, Ints, Floats]:
    """One pass with cubes that are shifted by a fraction of their size: the vertices that are left, triangles of these,
    and their quadrics."""
    cluster, chosen, sums = _clustered(points, _edges(triangles), quadrics, sizes, shift)
    used, corners = np.unique(_distinct(cluster[triangles]), return_inverse=True)
    return chosen[used], corners.reshape(-1, 3), sums[used]


def _clustered(points: Floats, ends: Ints, quadrics: Floats, sizes: Floats, shift: float) -> tuple[Ints, Ints, Floats]:
    """The cluster of each vertex in one such pass, the vertex that stands for each cluster, and sums of quadrics."""
    cubes = np.column_stack([np.floor(points / sizes[:, None] + shift), sizes])
    first, second = ends.T
    together = np.ones(len(first), bool)
    for numbers in cubes.T:
        together &= numbers[first] == numbers[second]
    cluster = linked(ends[together], len(points))
    count = int(cluster.max(initial=-1)) + 1
    sums: Floats = np.column_stack([np.bincount(cluster, each, count) for each in quadrics.T])
    error = _errors(points, cluster, sums)
    order = np.lexsort((error, cluster))
    return cluster, order[np.searchsorted(cluster[order], np.arange(count))], sums


def _quadrics(points: Floats, triangles: Ints) -> Floats:
    """For each vertex the sum, over its triangles, of the area times the products of the plane's four numbers [V, 10]
    (Garland and Heckbert 1997)."""
    a, b, c = np.moveaxis(points[triangles], 1, 0)
    normal = np.cross(b - a, c - a)
    area = np.linalg.norm(normal, axis=1)
    normal /= np.maximum(area, 1e-300)[:, None]
    plane = np.column_stack([normal, -np.einsum("fc,fc->f", normal, a)])
    corners = triangles.ravel()
    rows = [area * plane[:, i] * plane[:, j] for i in range(4) for j in range(i, 4)]
    return np.column_stack([np.bincount(corners, np.repeat(each, 3), len(points)) for each in rows])


def _errors(points: Floats, cluster: Ints, sums: Floats) -> Floats:
    """How far each vertex is from the planes of its cluster's triangles, so that the one on an edge or in a corner
    stands for them; in a plane, how far from the middle: squares times areas."""
    members = np.bincount(cluster)
    middles = np.column_stack([np.bincount(cluster, points[:, axis]) for axis in range(3)]) / members[:, None]
    x = np.column_stack([points, np.ones(len(points))])
    own, error, number = sums[cluster], np.zeros(len(points)), 0
    for i in range(4):
        for j in range(i, 4):
            error += (1.0 if i == j else 2.0) * own[:, number] * x[:, i] * x[:, j]
            number += 1
    areas = own[:, [0, 4, 7]].sum(axis=1)
    return error + FLAT * areas * ((points - middles[cluster]) ** 2).sum(axis=1)


def closer(surface: SurfaceMesh, sizes: Floats) -> Floats:
    """Smaller sizes where they are large for the body: elements that are pressed flat carry what is drawn between the
    points that touch into an obstacle. They are smaller by whole levels, so that remeshed bodies have the same.

    Args:
        surface: The surface.
        sizes: The size at each of its vertices [m], [V].
    """
    extent = max(float(np.ptp(surface.points, axis=0).max(initial=0.0)), 1e-30)
    return sizes * 2.0 ** (np.rint(3.0 * np.log2(np.clip(CLOSE * extent / sizes, CLOSEST, 1.0))) / 3.0)


def resolved(surface: SurfaceMesh, sizes: Floats) -> Floats:
    """Sizes for ``clustered`` that are halved, up to twice, where the surface would lose its shape: where a mesh is
    coarse for its curvature or its thickness.

    Args:
        surface: The surface.
        sizes: The size at each of its vertices [m], [V].
    """
    for _ in range(HALVED):
        thin = clustered(surface, sizes)
        far = distances_from(thin.points, thin.triangles, surface.points, float(sizes.max()))
        lost = far > departures(surface, sizes)
        if not lost.any():
            break
        cubes = np.floor(surface.points / sizes[:, None]).astype(np.int64)
        _, cube = np.unique(np.column_stack([cubes, sizes.view(np.int64)]), axis=0, return_inverse=True)
        in_lost = np.zeros(len(sizes), bool)
        in_lost[cube.ravel()[lost]] = True
        sizes = np.where(in_lost[cube.ravel()], 0.5 * sizes, sizes)
    return sizes


def departures(surface: SurfaceMesh, sizes: Floats) -> Floats:
    """How far each vertex may be from a coarser surface with vertices a size apart [m], [V].

    In thin parts more points would only load the same few nodes from both sides, so there only the sizes count.

    Args:
        surface: The surface.
        sizes: The size at each of its vertices [m], [V].
    """
    extent = np.ptp(surface.points, axis=0).max(initial=0.0)
    return LOST * sizes if not extent else np.minimum(LOST * sizes, np.where(surface.is_thin, np.inf, HANGING * extent))


class Clusters:
    """The clusterings of one surface for sizes that depend on a level, each found when it is first asked for.

    Each vertex has a level of its own, which may change. What stands for a vertex depends on the levels of the vertices
    in its cube only, so that the surface changes only where levels do.

    Args:
        points: The vertices of the surface [m], [V, 3].
        triangles: [F, 3].
        size: The size for level 0 [m]; each level divides it by the cube root of 2.
    """

    def __init__(self, points: Floats, triangles: Ints, size: float):
        self._points, self._triangles, self._size = points, triangles, size
        self._ends = _edges(triangles)
        self._pieces = linked(self._ends, len(points))
        self._quadrics = _quadrics(points, triangles)
        self._known: dict[int, tuple[Ints, Ints]] = {}

    def thinned(self, levels: Ints) -> tuple[Ints, Ints]:
        """The surface with vertices about a size apart.

        Args:
            levels: The level of each vertex, [V].

        Returns:
            The vertices that are left, ascending [n], and triangles of them [f, 3].
        """
        stands_for = np.arange(len(self._points))
        for level in np.flatnonzero(np.bincount(levels)):
            cluster, order = self._at(int(level))
            members = order[levels[order] == level]
            best = np.empty(len(self._points), np.int64)
            # The last of those with the same number counts, which has the least error.
            best[cluster[members]] = members
            stands_for[members] = best[cluster[members]]
        found = _distinct(stands_for[self._triangles])
        stays = np.zeros(len(self._points), bool)
        stays[self._pieces[found[:, 0]]] = True
        if not stays[self._pieces[self._triangles[:, 0]]].all():
            whole = self._triangles[~stays[self._pieces[self._triangles[:, 0]]]]
            found = np.concatenate([found, whole])
        used = np.zeros(len(self._points), bool)
        used[found] = True
        places = np.cumsum(used) - 1
        return np.flatnonzero(used), places[found].astype(np.int32)

    def lowered(self, levels: Ints, level: int, far: Floats) -> Ints:
        """Levels that are this one where they were one above it, as far as the surface keeps its shape.

        Args:
            levels: The level of each vertex, [V].
            level: The new level.
            far: How far each vertex may be from the surface [m], [V].
        """
        lower, (cluster, _) = levels == level + 1, self._at(level)
        first, second = cluster[self._ends].T
        size = 2.0 * float(np.ptp(self._points, axis=0).max())
        while lower.any():
            kept, triangles = self.thinned(np.where(lower, level, levels))
            lost = np.flatnonzero(distances_from(self._points[kept], triangles, self._points, size) > far)
            nearest = nearest_faces(self._points[kept], triangles, self._points[lost], size)
            is_lost = np.zeros(len(cluster), bool)
            is_lost[cluster[lost]] = True
            is_lost[cluster[kept[triangles[nearest]]]] = True
            if not (is_lost[cluster] & lower).any():
                # Clusters beside lower ones have lost the vertices that stood for them.
                around = is_lost[first], is_lost[second]
                is_lost[second[around[0]]] = is_lost[first[around[1]]] = True
            if not (is_lost[cluster] & lower).any():
                break
            lower &= ~is_lost[cluster]
        return np.where(lower, level, levels)

    def _at(self, level: int) -> tuple[Ints, Ints]:
        """The cluster of each vertex, and all vertices, those with the largest errors first."""
        if level not in self._known:
            sizes = np.full(len(self._points), self._size * 2.0 ** (-level / 3.0))
            first, chosen, sums = _clustered(self._points, self._ends, self._quadrics, sizes, 0.0)
            ends = first[self._ends]
            ends = ends[ends[:, 0] != ends[:, 1]]
            second, _, _ = _clustered(self._points[chosen], ends, sums, 0.5 * sizes[chosen], 0.5)
            cluster = second[first]
            sums = np.column_stack([np.bincount(second, each) for each in sums.T])
            self._known[level] = cluster, np.argsort(-_errors(self._points, cluster, sums), kind="stable")
        return self._known[level]


def _edges(triangles: Ints) -> Ints:
    """The edges of a closed surface, each once [E, 2]."""
    ends = triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    return ends[ends[:, 0] < ends[:, 1]]


def _distinct(triangles: Ints) -> Ints:
    """Triangles with three corners, without pairs that lie back to back on one another."""
    a, b, c = triangles.T
    triangles = triangles[(a != b) & (b != c) & (c != a)]
    if not len(triangles):
        return triangles
    # Begin each with its lowest corner, so that the last two say which way it faces.
    first = np.argmin(triangles, axis=1)
    a, b, c = np.take_along_axis(triangles, (first[:, None] + np.arange(3)) % 3, axis=1).T
    low, high = np.minimum(b, c), np.maximum(b, c)
    _, of_pair = np.unique(a.astype(np.int64) << 32 | low, return_inverse=True)
    _, one, which = np.unique(of_pair.astype(np.int64) << 32 | high, return_index=True, return_inverse=True)
    facing = np.bincount(which.ravel(), np.where(b < c, 1.0, -1.0), len(one)).astype(int)
    found = np.repeat(np.column_stack([a, low, high])[one], np.abs(facing), axis=0)
    turned = np.repeat(facing < 0, np.abs(facing))
    found[turned] = found[turned][:, [0, 2, 1]]
    return found
