"""Repair of triangle surfaces so that they enclose a body: welding, orientation, closing; and a record of it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from warp_corot.errors import InputError
from warp_corot.mesh.topology import linked, sorted_keys


class Edges:
    """The edges of triangles, and the half-edges of each.

    Half-edge 3 t + k runs from corner k of triangle t to the next one.

    Args:
        triangles: Point numbers [T, 3].

    Attributes:
        order: Half-edges by edge, ascending within each edge [3 T].
        starts: The place in ``order`` where each edge begins [E]; edges ascend by their lower and then their higher
            point.
        sharers: Number of half-edges of each edge [E].
    """

    def __init__(self, triangles: np.ndarray):
        self.starting = np.ascontiguousarray(triangles).ravel().astype(np.int64)
        self.ending = np.ascontiguousarray(np.roll(triangles, -1, axis=1)).ravel().astype(np.int64)
        count = int(self.starting.max(initial=0)) + 1
        keys, self.order = sorted_keys(
            np.minimum(self.starting, self.ending) * count + np.maximum(self.starting, self.ending), count * count
        )
        self.starts = np.flatnonzero(np.diff(keys, prepend=-1))
        self.sharers = np.diff(self.starts, append=len(keys))

    @cached_property
    def ends(self) -> np.ndarray:
        """The lower and the higher point of each edge, int64 [E, 2]."""
        first = self.order[self.starts]
        ends = np.stack([self.starting[first], self.ending[first]], axis=1)
        ends.sort(axis=1)
        return ends

    @cached_property
    def pairs(self) -> tuple[np.ndarray, np.ndarray]:
        """Half-edges of the same edge: pairs, or chains of pairs for more than two [P], [P]."""
        follows = np.ones(len(self.order), bool)
        follows[self.starts] = False
        at = np.flatnonzero(follows)
        return self.order[at - 1], self.order[at]

    @cached_property
    def twos(self) -> tuple[np.ndarray, np.ndarray]:
        """The half-edges of edges that two share [P], [P]."""
        at = self.starts[self.sharers == 2]
        return self.order[at], self.order[at + 1]

    @cached_property
    def forward(self) -> np.ndarray:
        """Whether half-edges run from the lower to the higher point, bool [3 T]."""
        return self.starting < self.ending

    def net(self) -> tuple[np.ndarray, np.ndarray]:
        """Edges that are not walked as often one way as the other: the boundary of the surface.

        Returns:
            Edges [E, 2], walked the way of the triangles beside them, and how often more, [E].
        """
        if not len(self.starts):
            return np.empty((0, 2), np.int64), np.empty(0, np.int64)
        ways = np.where(self.forward[self.order], np.int8(1), np.int8(-1))
        net = np.add.reduceat(ways, self.starts, dtype=np.int64)
        found = np.flatnonzero(net)
        ends = self.ends[found]
        return np.where((net[found] < 0)[:, None], ends[:, ::-1], ends), np.abs(net[found])


#: Approximate number of corners of a part that are tested to find whether it lies within another.
CORNERS = 16


def net_edges(triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The boundary of a surface; see `Edges.net`."""
    return Edges(triangles).net()


def edge_parts(triangles: np.ndarray, edges: Edges | None = None) -> np.ndarray:
    """The connected part of each triangle; triangles that share an edge are connected."""
    one, other = (Edges(triangles) if edges is None else edges).pairs
    return linked(np.stack([one // 3, other // 3], axis=1), len(triangles))


def wind_alike(triangles: np.ndarray, edges: Edges) -> tuple[np.ndarray, int]:
    """Reverse triangles that traverse an edge in the same direction as the neighbour across it; return how many (the
    minority of each part).

    Edges of three or more triangles bind nothing. On a surface with one side only, some edges stay as they are.
    """
    one, other = edges.twos
    against = edges.forward[one] == edges.forward[other]
    if not against.any():
        return triangles, 0
    a, b = one // 3, other // 3
    count = len(triangles)
    parts = linked(np.stack([a, b], axis=1), count)
    # Two of each triangle, one for each way to wind it: those that fit are linked.
    fits = np.concatenate([np.stack([a, b + count * against]), np.stack([a + count, b + count * ~against])], axis=1)
    side = linked(fits.T, 2 * count)
    turned = side[:count] > side[count:]
    turned ^= np.bincount(parts, weights=np.where(turned, 1, -1))[parts] > 0
    return np.where(turned[:, None], triangles[:, ::-1], triangles), int(turned.sum())


def wind_outwards(
    points: np.ndarray, triangles: np.ndarray, parts: np.ndarray, two_sided: np.ndarray
) -> tuple[np.ndarray, int, int]:
    """Reverse parts that are inside out; return their number, and the number of cavities: parts within another that are
    wound inwards, and are not among those that were given both ways round.
    """
    volumes = part_volumes(points, triangles, parts)
    flip = np.zeros(len(volumes), bool)
    if volumes.sum() < 0.0:
        flip[:] = True
    inward = np.flatnonzero(volumes * np.where(flip, -1.0, 1.0) < 0.0)
    groups = SurfaceParts(points, triangles, parts)
    cavities = 0
    for part in inward:
        if part not in two_sided and groups.is_within_others(int(part)):
            cavities += 1
        else:
            flip[part] = not flip[part]
    turned = flip[parts]
    return np.where(turned[:, None], triangles[:, ::-1], triangles), int(flip.sum()), cavities


class SurfaceParts:
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
        return all(len(self.holders(corner, part)) for corner in own[:: max(1, len(own) // CORNERS)])

    def holders(self, at: np.ndarray, but: int) -> np.ndarray:
        """Which parts but one hold a point."""
        near = np.flatnonzero(((self.lows <= at) & (at <= self.highs)).all(axis=1))
        inside = [abs(winding_number(self.corners[self.slices[part]], at)) > 0.5 for part in near]
        return near[np.array(inside, bool) & (near != but)]


def part_volumes(points: np.ndarray, triangles: np.ndarray, parts: np.ndarray) -> np.ndarray:
    """Signed volume that each closed part encloses, positive if it is wound outwards."""
    a, b, c = (points - points.mean(axis=0))[triangles].transpose(1, 0, 2)
    return np.bincount(parts, weights=np.einsum("ij,ij->i", a, np.cross(b, c))) / 6.0


def winding_number(corners: np.ndarray, at: np.ndarray) -> float:
    """Winding number of triangles [T, 3, 3] around a point, by solid angles (Van Oosterom and Strackee 1983)."""
    a, b, c = (corners - at).transpose(1, 0, 2)
    x, y, z = (np.linalg.norm(v, axis=1) for v in (a, b, c))
    dot = np.einsum
    below = x * y * z + dot("ij,ij->i", a, b) * z + dot("ij,ij->i", b, c) * x + dot("ij,ij->i", c, a) * y
    return float(np.arctan2(dot("ij,ij->i", a, np.cross(b, c)), below).sum()) / (2.0 * np.pi)


#: Where the surface is open, points closer than this share of its size are welded.
WELD = 1.0e-6
#: The caps that close holes may have at most this share of the surface's area.
LARGEST_HOLES = 1.0 / 3.0
#: A body must be thicker than this share of its size.
THINNEST = 1.0e-5


@dataclass(frozen=True)
class ClosedSurface:
    """A closed, outwards wound surface.

    Attributes:
        points: float64 [N, 3].
        triangles: int32 [T, 3]; the last ones close the holes.
        edges: The edges of these.
        parts: The part of each triangle, of those connected by edges [T].
        caps: Number of triangles that close holes.
        open_edges: Number of edges of holes.
        holes: Number of connected groups of these edges.
        cap_share: Area of the caps over that of the surface.
        turned: Triangles that were wound against their neighbours and were reversed.
        inside_out: Closed parts that were inside out and were reversed.
        dropped: Triangles left out: without area, repeated, or facing each other.
        crowded: Edges that three or more triangles share, so that one of these has the body on both sides.
        was_inwards: Whether each given triangle was wound inwards, bool.
        pieces: Parts that enclose something.
        cavities: Parts inside another that are wound inwards.
        volume: Enclosed volume.
    """

    points: npt.NDArray[np.float64]
    triangles: npt.NDArray[np.int32]
    edges: Edges
    parts: npt.NDArray[np.int32]
    caps: int
    open_edges: int
    holes: int
    cap_share: float
    turned: int
    inside_out: int
    dropped: int
    crowded: int
    was_inwards: npt.NDArray[np.bool_]
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
    points, welded, edges = weld(points, triangles)
    given = len(welded)
    kept, place, two_sided = drop_useless(welded, edges)
    if not len(kept):
        raise InputError(
            "the surface has zero thickness: its triangles lie on one another, facing both ways"
            if two_sided.any()
            else f"none of the {given} triangles has an area; the surface is degenerate"
        )
    triangles, dropped = welded[kept], given - len(kept)
    edges = Edges(triangles) if dropped else edges
    triangles, turned = wind_alike(triangles, edges)
    edges = Edges(triangles) if turned else edges
    parts = edge_parts(triangles, edges)
    area = float(areas(points, triangles).sum())
    if not area > 0.0:  # lengths whose squares are too small for a number
        raise InputError(f"none of the {given} triangles has an area; the surface is degenerate")
    points, caps, cap_parts, open_edges, holes = cones(points, triangles, parts, edges)
    cap_share = float(areas(points, caps).sum()) / area
    crowded = int(np.count_nonzero((edges.sharers > 2) & (edges.sharers % 2 == 1)))
    if cap_share > LARGEST_HOLES:
        repaired = f", after {dropped} triangles without area or there twice were left out" if dropped else ""
        if crowded == open_edges:
            raise InputError(
                f"the surface has walls inside it, which cannot be told from it: {crowded} edges join three or more "
                f"triangles{repaired}; it must be without them, or closed around each part"
            )
        raise InputError(
            f"the surface is open: {open_edges} edges in {holes} hole{'s'[: holes != 1]}, and closing takes "
            f"{cap_share:.0%} of its own area{repaired}; it must take at most {LARGEST_HOLES:.0%}"
        )
    closed, all_parts = np.concatenate([triangles, caps]), np.concatenate([parts, cap_parts])
    two_sided_parts = np.flatnonzero(np.bincount(parts, weights=~two_sided[kept]) == 0)
    closed, inside_out, cavities = wind_outwards(points, closed, all_parts, two_sided_parts)
    edges = Edges(closed) if len(caps) or inside_out else edges
    volume = float(part_volumes(points, closed, np.zeros(len(closed), int)).sum())
    size = float(np.ptp(points[closed.ravel()], axis=0).max())
    if not volume > 0.5 * THINNEST * size * area:
        raise InputError(
            f"the surface encloses no volume ({volume / size**3:.2g} of its length cubed): it has zero thickness, "
            f"or as much of it faces inwards as outwards"
        )
    pieces = int(all_parts.max()) + 1 - cavities
    return ClosedSurface(
        points, closed.astype(np.int32), edges, all_parts.astype(np.int32), len(caps), open_edges, holes, cap_share,
        turned, inside_out, dropped, crowded, _runs_back(welded, closed[place]) & (place >= 0), pieces, cavities,
        volume,
    )  # fmt: skip


def turned_inwards(points: np.ndarray, triangles: np.ndarray) -> tuple[npt.NDArray[np.bool_], bool]:
    """Which triangles [T] of a surface are wound inwards, bool [T], and whether it has holes.

    A surface that encloses no body has no inside, and counts as wound well.
    """
    try:
        closed = close_surface(np.asarray(points, np.float64), np.asarray(triangles, np.int64))
    except InputError:
        return np.zeros(len(triangles), bool), True
    return closed.was_inwards, closed.caps > 0


def _runs_back(triangles: np.ndarray, others: np.ndarray) -> npt.NDArray[np.bool_]:
    """Whether triangles [T, 3] name the points of others in the opposite order, bool [T]."""
    after = (np.argmax(others == triangles[:, :1], axis=1) + 1) % 3
    return others[np.arange(len(others)), after] != triangles[:, 1]


def weld(points: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray, Edges]:
    """Merge points in the same place, and then, where the surface is still open, points in nearly the same place.

    Points that no triangle names are left out.

    Returns:
        The points, in ascending order, the triangles, and their edges.
    """
    used = np.zeros(len(points), bool)
    used[triangles] = True
    points = points[used] + 0.0
    points, place = _without_twins(points)
    named = np.zeros(len(used), np.int64)
    named[used] = place
    triangles = named[triangles]
    edges = Edges(triangles)
    rims = np.unique(edges.net()[0])
    if len(rims):
        near = WELD * float(np.ptp(points, axis=0).max())
        pairs = cKDTree(points[rims]).sparse_distance_matrix(cKDTree(points), near, output_type="ndarray")
        a, b = rims[pairs["i"]], pairs["j"]
        if (a != b).any():
            place = linked(np.stack([a, b], axis=1), len(points))
            first = np.full(int(place.max()) + 1, len(points))
            np.minimum.at(first, place, np.arange(len(points)))
            points, triangles = points[first], place[triangles]
            edges = Edges(triangles)
    return points, triangles, edges


def _without_twins(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points in ascending order, each once, and the place of each given point among them."""
    order = np.argsort(points[:, 0], kind="stable")
    along = points[order, 0]
    if (along[1:] == along[:-1]).any():
        order = np.lexsort(points.T[::-1])
    ordered = points[order]
    new = np.append(True, (ordered[1:] != ordered[:-1]).any(axis=1))
    place = np.empty(len(points), np.int64)
    place[order] = np.cumsum(new) - 1
    return ordered[new], place


def drop_useless(triangles: np.ndarray, edges: Edges) -> tuple[np.ndarray, np.ndarray, npt.NDArray[np.bool_]]:
    """Choose the triangles that matter: none that names a point twice, and one of those with the same three points.

    Of a patch whose triangles are there both ways round, nothing stays if its rim lies within the rest, as that of a
    wall between two bodies or of a fin does; one of each stays if the patch fills a hole of the rest or is closed.

    Returns:
        The chosen triangles, ascending [K]; the place among them of the one with the same points as each triangle, -1
        for none [T]; and whether each triangle is there both ways round, bool [T].
    """
    every = np.arange(len(triangles))
    a, b, c = triangles.T
    good = np.flatnonzero((a != b) & (b != c) & (c != a))
    place, two_sided = np.full(len(triangles), -1), np.zeros(len(triangles), bool)
    if len(good) == len(triangles) and not _coincide(triangles, edges):
        return every, every, two_sided
    if not len(good):
        return good, place, two_sided
    order = np.argsort(triangles[good], axis=1)
    key = np.take_along_axis(triangles[good], order, axis=1)
    # Even permutations of three: 012, 120, 201.
    parity = np.where((order[:, 1] - order[:, 0]) % 3 == 1, 1, -1)
    _, first, same = np.unique(key, axis=0, return_index=True, return_inverse=True)
    first, same = good[first], same.ravel()
    both = np.bincount(same, weights=parity) == 0
    two_sided[good] = both[same]
    stays = ~both
    stays[both] = _fill(triangles[first[both]], Edges(triangles[first[~both]]))
    kept = np.sort(first[stays])
    place[good] = np.where(stays, np.searchsorted(kept, first), -1)[same]
    return kept, place, two_sided


def _fill(patches: np.ndarray, rest: Edges) -> npt.NDArray[np.bool_]:
    """Whether the patch of each triangle, of those connected by edges, is closed or fills a hole of the rest, bool."""
    edges = Edges(patches)
    parts = edge_parts(patches, edges)
    rim, holes = edges.sharers % 2 == 1, rest.ends[rest.sharers % 2 == 1]
    count = 1 + max(int(edges.ending.max(initial=0)), int(rest.ending.max(initial=0)))
    fits = np.isin(edges.ends[rim] @ [count, 1], holes @ [count, 1])
    of_part = parts[edges.order[edges.starts[rim]] // 3]
    return (np.bincount(of_part, np.where(fits, 1.0, -1.0), len(patches)) >= 0.0)[parts]


def _coincide(triangles: np.ndarray, edges: Edges) -> bool:
    """Whether some triangles may have the same three points: two at one edge do, or more than two share an edge."""
    if (edges.sharers > 2).any():
        return True
    one, other = edges.twos
    sums = triangles.sum(axis=1)
    return bool((sums[one // 3] == sums[other // 3]).any())


def cones(
    points: np.ndarray, triangles: np.ndarray, parts: np.ndarray, edges: Edges
) -> tuple[np.ndarray, np.ndarray, np.ndarray, int, int]:
    """Close every hole by a cone from its rim to the rim's centre.

    The boundary of a surface is a sum of cycles, even where more than two triangles meet. A cone over it has the same
    boundary, so together they have none.

    Returns:
        Points with the centres appended, caps [C, 3], the part of each, number of open edges, number of holes.
    """
    if not len(edges.net()[0]):
        return points, np.empty((0, 3), np.int64), np.empty(0, np.int64), 0, 0
    # A rim runs through points of one part: a point that several parts share counts once for each.
    count = len(points)
    places, nodes = np.unique(parts[:, None] * count + triangles, return_inverse=True)
    ends, often = Edges(nodes.reshape(-1, 3)).net()
    rim = np.unique(ends)
    a, b = np.searchsorted(rim, ends).T
    owner, ends = places[ends[:, 0]] // count, places[ends] % count
    hole = linked(np.stack([a, b], axis=1), len(rim))[a]
    holes = int(hole.max()) + 1
    lengths = np.linalg.norm(points[ends[:, 0]] - points[ends[:, 1]], axis=1)
    weights = np.maximum(lengths, 1e-30) / np.bincount(hole, weights=np.maximum(lengths, 1e-30))[hole]
    centres = np.zeros((holes, 3))
    np.add.at(centres, hole, weights[:, None] * points[ends].mean(axis=1))
    caps = np.stack([ends[:, 1], ends[:, 0], len(points) + hole], axis=1)
    return np.concatenate([points, centres]), np.repeat(caps, often, axis=0), np.repeat(owner, often), len(ends), holes


def areas(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Areas of triangles [T]."""
    a, b, c = points[triangles].transpose(1, 0, 2)
    crossed = np.cross(b - a, c - a)
    return 0.5 * np.sqrt(np.einsum("ij,ij->i", crossed, crossed))
