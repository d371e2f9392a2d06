"""Triangle surfaces made fit to enclose a body: welded, wound alike and outwards, closed; and what that took."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_array
from scipy.sparse.csgraph import breadth_first_order, connected_components
from scipy.spatial import cKDTree

from ..errors import InputError

#: Points closer than this share of the surface's size are welded where it is open.
WELD = 1.0e-6
#: Holes may take this share of the surface's area to close.
LARGEST_HOLES = 1.0 / 3.0
#: A body thinner than this share of its size is no body.
THINNEST = 1.0e-5
#: About how many corners of a part are looked at to see whether it lies within another.
CORNERS = 16


@dataclass(frozen=True)
class ClosedSurface:
    """A closed, outwards wound surface.

    Attributes:
        points: float64 [N, 3].
        triangles: int32 [T, 3]; the last ones close the holes.
        caps: How many close holes.
        open_edges: Edges of holes.
        holes: Connected groups of them.
        cap_share: Area of the caps over that of the surface.
        turned: Triangles that were wound against their neighbours.
        inside_out: Closed parts that were turned round as a whole.
        dropped: Triangles left out: without area, there twice, or facing each other.
        pieces: Parts that enclose something.
        cavities: Parts wound inwards, within another.
        volume: Enclosed volume.
    """

    points: npt.NDArray[np.float64]
    triangles: npt.NDArray[np.int32]
    caps: int
    open_edges: int
    holes: int
    cap_share: float
    turned: int
    inside_out: int
    dropped: int
    pieces: int
    cavities: int
    volume: float


def close_surface(points: np.ndarray, triangles: np.ndarray) -> ClosedSurface:
    """Weld, wind and close a triangle surface.

    Args:
        points: float64 [N, 3], finite.
        triangles: Indices [T, 3], in range.

    Raises:
        InputError: It encloses nothing: all triangles degenerate, open for more than a third of its area, or of zero
            thickness.
    """
    given = len(triangles)
    points, triangles = weld(points, triangles)
    triangles, twofold = drop_useless(points, triangles)
    if not len(triangles):
        raise InputError(f"none of the {given} triangles has an area; the surface is degenerate")
    dropped = given - len(triangles)
    triangles, turned = wind_alike(points, triangles)
    parts = edge_parts(triangles)
    area = float(areas(points, triangles).sum())
    points, caps, cap_parts, open_edges, holes = cones(points, triangles, parts)
    cap_share = float(areas(points, caps).sum()) / area
    if cap_share > LARGEST_HOLES:
        if twofold:
            raise InputError("the surface has zero thickness: its triangles lie on one another, facing both ways")
        raise InputError(
            f"the surface is open: {open_edges} edges in {holes} hole{'s'[: holes != 1]}, and closing takes "
            f"{cap_share:.0%} of its own area; it must be closed but for {LARGEST_HOLES:.0%}"
        )
    closed, all_parts = np.concatenate([triangles, caps]), np.concatenate([parts, cap_parts])
    closed, inside_out, cavities = wind_outwards(points, closed, all_parts)
    volume = float(part_volumes(points, closed, np.zeros(len(closed), int)).sum())
    size = float(np.ptp(points[closed.ravel()], axis=0).max())
    if not volume > 0.5 * THINNEST * size * area:
        raise InputError(
            f"the surface encloses no volume ({volume / size**3:.2g} of its length cubed): it has zero thickness, "
            f"or as much of it is inside out as not"
        )
    pieces = int(all_parts.max()) + 1 - cavities
    return ClosedSurface(
        points, closed.astype(np.int32), len(caps), open_edges, holes, cap_share, turned, inside_out, dropped, pieces,
        cavities, volume,
    )  # fmt: skip


def weld(points: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Make points that lie in one place one; where the surface is still open then, nearly in one place.

    Points that no triangle names are left out.
    """
    used, triangles = np.unique(triangles, return_inverse=True)
    points = points[used] + 0.0
    rows = np.ascontiguousarray(points).view([("", np.float64)] * 3).ravel()
    _, first, place = np.unique(rows, return_index=True, return_inverse=True)
    points, triangles = points[first], place.ravel()[triangles.reshape(-1, 3)]
    rims = np.unique(net_edges(triangles)[0])
    if len(rims):
        near = WELD * float(np.ptp(points, axis=0).max())
        pairs = cKDTree(points[rims]).query_pairs(near, output_type="ndarray")
        if len(pairs):
            a, b = rims[pairs].T
            links = coo_array((np.ones(len(a)), (a, b)), shape=(len(points), len(points)))
            count, place = connected_components(links, directed=False)
            first = np.full(count, len(points))
            np.minimum.at(first, place, np.arange(len(points)))
            points, triangles = points[first], place[triangles]
    return points, triangles


def drop_useless(points: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, bool]:
    """Without triangles that name a point twice, repeat another, or lie on one facing the other way.

    Where at least half the triangles lie on one facing the other way, they are two sides of one sheet: one of each
    stays, and the second value is True.
    """
    a, b, c = triangles.T
    triangles = triangles[(a != b) & (b != c) & (c != a)]
    if not len(triangles):
        return triangles, False
    order = np.argsort(triangles, axis=1)
    key = np.take_along_axis(triangles, order, axis=1)
    # Even permutations of three: 012, 120, 201.
    parity = np.where((order[:, 1] - order[:, 0]) % 3 == 1, 1, -1)
    _, first, place = np.unique(key, axis=0, return_index=True, return_inverse=True)
    net = np.bincount(place.ravel(), weights=parity)
    twofold = bool((net == 0).sum() * 2 >= len(net))
    return triangles[np.sort(first if twofold else first[net != 0])], twofold


def net_edges(triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Edges that are not walked as often one way as the other: the boundary of the surface.

    Returns:
        Edges [E, 2], walked the way of the triangles beside them, and how often more, [E].
    """
    edges = triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).astype(np.int64)
    forward = edges[:, 0] < edges[:, 1]
    count = int(triangles.max()) + 1
    keys = edges.min(axis=1) * count + edges.max(axis=1)
    unique, place = np.unique(keys, return_inverse=True)
    net = np.bincount(place.ravel(), weights=np.where(forward, 1, -1)).astype(np.int64)
    found = net != 0
    low, high = unique[found] // count, unique[found] % count
    turned = net[found] < 0
    return np.stack([np.where(turned, high, low), np.where(turned, low, high)], axis=1), np.abs(net[found])


def edge_pairs(triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pairs of triangles that share an edge, chained where more than two do.

    Returns:
        ``pairs`` [P, 2], ``against`` bool [P] (both walk the edge the same way: one must be turned), ``alone`` bool [P]
        (no third shares the edge).
    """
    edges = triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).astype(np.int64)
    keys = edges.min(axis=1) * (int(triangles.max()) + 1) + edges.max(axis=1)
    order = np.argsort(keys, kind="stable")
    ordered = keys[order]
    same = np.flatnonzero(ordered[1:] == ordered[:-1])
    sharers = np.unique(ordered, return_inverse=True, return_counts=True)
    alone = sharers[2][sharers[1].ravel()[same]] == 2
    forward = edges[:, 0] < edges[:, 1]
    a, b = order[same], order[same + 1]
    return np.stack([a // 3, b // 3], axis=1), forward[a] == forward[b], alone


def edge_parts(triangles: np.ndarray) -> np.ndarray:
    """Which connected part each triangle belongs to; those that share an edge are connected."""
    a, b = edge_pairs(triangles)[0].T
    links = coo_array((np.ones(len(a)), (a, b)), shape=(len(triangles), len(triangles)))
    return connected_components(links, directed=False)[1]


def wind_alike(points: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, int]:
    """Turn triangles that walk an edge the same way as the neighbour across it; how many (the fewer of each part).

    Edges of three or more triangles bind nothing. On a surface with one side only, some edges stay as they are.
    """
    pairs, against, alone = edge_pairs(triangles)
    if not (against & alone).any():
        return triangles, 0
    (a, b), against = pairs[alone].T, against[alone]
    count = len(triangles)
    links = coo_array((np.ones(len(a)), (a, b)), shape=(count, count)).tocsr()
    parts = connected_components(links, directed=False)[1]
    # One node more, tied to one triangle of each part, makes a single search of all parts.
    heads = np.unique(parts, return_index=True)[1]
    rows, columns = np.append(a, np.full(len(heads), count)), np.append(b, heads)
    links = coo_array((np.ones(len(rows)), (rows, columns)), shape=(count + 1, count + 1)).tocsr()
    order, parent = breadth_first_order(links, count, directed=False)
    keys = np.minimum(a, b) * (count + 1) + np.maximum(a, b)
    sort = np.argsort(keys)
    here, above = order[1:], parent[order[1:]]
    wanted = np.minimum(here, above) * (count + 1) + np.maximum(here, above)
    found = sort[np.minimum(np.searchsorted(keys[sort], wanted), len(keys) - 1)]
    differs = np.zeros(count + 1, bool)
    differs[here] = against[found] & (above != count)
    turned = _along(order, parent, differs)[:count]
    majority = np.bincount(parts, weights=np.where(turned, 1, -1))[parts] > 0
    turned ^= majority
    triangles = np.where(turned[:, None], triangles[:, ::-1], triangles)
    return triangles, int(turned.sum())


def _along(order: np.ndarray, parent: np.ndarray, differs: np.ndarray) -> np.ndarray:
    """Parity of the differences on the way from the root of a tree, by doubling the step up."""
    up = np.where(np.arange(len(parent)) == order[0], order[0], parent)
    parity = differs.copy()
    while True:
        further = parity ^ parity[up]
        if (up == order[0]).all():
            return parity
        parity, up = further, up[up]


def cones(
    points: np.ndarray, triangles: np.ndarray, parts: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, int, int]:
    """Close every hole by a cone from its rim to the rim's centre.

    The boundary of a surface is a sum of cycles, also where more than two triangles meet; a cone over it has the same
    boundary, so with it the surface has none.

    Returns:
        Points with the centres appended, caps [C, 3], the part of each, number of open edges, number of holes.
    """
    # A rim runs through points of one part: a point that several parts share counts once for each.
    count = len(points)
    places, nodes = np.unique(parts[:, None] * count + triangles, return_inverse=True)
    edges, often = net_edges(nodes.reshape(-1, 3))
    if not len(edges):
        return points, np.empty((0, 3), np.int64), np.empty(0, np.int64), 0, 0
    rim = np.unique(edges)
    a, b = np.searchsorted(rim, edges).T
    owner, edges = places[edges[:, 0]] // count, places[edges] % count
    links = coo_array((np.ones(len(a)), (a, b)), shape=(len(rim), len(rim)))
    holes, hole = connected_components(links, directed=False)
    hole = hole[a]
    lengths = np.linalg.norm(points[edges[:, 0]] - points[edges[:, 1]], axis=1)
    weights = np.maximum(lengths, 1e-30) / np.bincount(hole, weights=np.maximum(lengths, 1e-30))[hole]
    centres = np.zeros((holes, 3))
    np.add.at(centres, hole, weights[:, None] * points[edges].mean(axis=1))
    caps = np.stack([edges[:, 1], edges[:, 0], len(points) + hole], axis=1)
    return np.concatenate([points, centres]), np.repeat(caps, often, axis=0), np.repeat(owner, often), len(edges), holes


def wind_outwards(points: np.ndarray, triangles: np.ndarray, parts: np.ndarray) -> tuple[np.ndarray, int, int]:
    """Turn what is inside out; how many parts were, and how many are cavities: wound inwards, within another part."""
    volumes = part_volumes(points, triangles, parts)
    flip = np.zeros(len(volumes), bool)
    if volumes.sum() < 0.0:
        flip[:] = True
    inward = np.flatnonzero(volumes * np.where(flip, -1.0, 1.0) < 0.0)
    groups = Parts(points, triangles, parts)
    cavities = 0
    for part in inward:
        if groups.is_within_others(int(part)):
            cavities += 1
        else:
            flip[part] = not flip[part]
    turned = flip[parts]
    return np.where(turned[:, None], triangles[:, ::-1], triangles), int(flip.sum()), cavities


class Parts:
    """Closed parts, each with its triangles and its box."""

    def __init__(self, points: np.ndarray, triangles: np.ndarray, parts: np.ndarray):
        order = np.argsort(parts, kind="stable")
        starts = np.flatnonzero(np.diff(parts[order], prepend=-1))
        self.corners = points[triangles[order]]
        self.slices = [slice(a, b) for a, b in zip(starts, [*starts[1:], len(order)], strict=True)]
        self.lows = np.minimum.reduceat(self.corners.min(axis=1), starts, axis=0)
        self.highs = np.maximum.reduceat(self.corners.max(axis=1), starts, axis=0)

    def is_within_others(self, part: int) -> bool:
        """Whether some corners of a part, spread over it, all lie within other parts."""
        own = self.corners[self.slices[part], 0]
        return all(self._holds(corner, part) for corner in own[:: max(1, len(own) // CORNERS)])

    def _holds(self, at: np.ndarray, but: int) -> bool:
        """Whether some part but one holds a point."""
        near = np.flatnonzero(((self.lows <= at) & (at <= self.highs)).all(axis=1))
        return any(abs(winding(self.corners[self.slices[part]], at)) > 0.5 for part in near if part != but)


def part_volumes(points: np.ndarray, triangles: np.ndarray, parts: np.ndarray) -> np.ndarray:
    """Signed volume that each closed part encloses, positive where it is wound outwards."""
    a, b, c = (points - points.mean(axis=0))[triangles].transpose(1, 0, 2)
    return np.bincount(parts, weights=np.einsum("ij,ij->i", a, np.cross(b, c))) / 6.0


def winding(corners: np.ndarray, at: np.ndarray) -> float:
    """Winding number of triangles [T, 3, 3] around a point, by solid angles (Van Oosterom and Strackee 1983)."""
    a, b, c = (corners - at).transpose(1, 0, 2)
    x, y, z = (np.linalg.norm(v, axis=1) for v in (a, b, c))
    dot = np.einsum
    below = x * y * z + dot("ij,ij->i", a, b) * z + dot("ij,ij->i", b, c) * x + dot("ij,ij->i", c, a) * y
    return float(np.arctan2(dot("ij,ij->i", a, np.cross(b, c)), below).sum()) / (2.0 * np.pi)


def areas(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Areas of triangles [T]."""
    a, b, c = points[triangles].transpose(1, 0, 2)
    return 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
