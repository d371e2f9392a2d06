"""Parts at which a body can be fixed: its lowest part, its largest flat region, its broad sides."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

#: Fraction of the height that counts as the lowest part.
LOWEST = 0.1
#: Smallest fraction of a piece's nodes in a patch.
LEAST_NODES = 0.1
#: A region is flat if its triangles face the same direction within this angle, in a layer of this fraction of the
#: body's size, and if it is at least this fraction of the surface.
SAME_WAY, LAYER, LEAST_FLAT = np.cos(np.radians(15.0)), 0.03, 0.08
#: A body has flat feet if its surface within this fraction of its height from the lowest point spans at least this
#: fraction of the area that it covers; of a ball it is 4 %.
FEET, LEAST_SPAN = 0.01, 0.25
#: Nodes whose distances to it differ by less than this fraction are in one layer.
SAME_LAYER = 1.0e-6
#: Directions in which regions are searched.
WAYS = 200
#: About this many triangles choose the directions to check.
MOST_FACES = 20_000
#: Number of directions that are checked closely.
CLOSELY = 8

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class SupportRegion:
    """Nodes of a body, by index, and their place in words."""

    nodes: Indices
    where: str


@dataclass(frozen=True)
class Footprint:
    """The convex hull of points on the ground, as half-planes a x + b y + c <= 0, [E, 3], empty if it has no area, and
    its area [m^2]."""

    across: Array
    edges: Array
    area: float

    def holds(self, point: Array) -> bool:
        """Whether a point is above it."""
        x, y = self.across @ point
        return len(self.edges) > 0 and bool((self.edges @ [x, y, 1.0] <= 0.0).all())


@dataclass(frozen=True, eq=False)
class BodyShape:
    """A body, or a piece of one.

    Attributes:
        points: Nodes of the mesh at rest [m], [N, 3].
        nodes: Nodes of the piece, by index.
        drawn: Points of the surface [m], [V, 3].
        triangles: Triangles of the piece's surface, [F, 3].
        up: Unit vector against gravity.
        bound: Nodes of the element to which each surface point is bound, [V, 4]; None: the point is a node itself.
    """

    points: Array
    nodes: Indices
    drawn: Array
    triangles: npt.NDArray[np.integer]
    up: Array
    bound: npt.NDArray[np.integer] | None = None

    @cached_property
    def skin(self) -> Array:
        """Points of the piece's surface [m]."""
        return self.drawn[np.unique(self.triangles)] if len(self.triangles) else self.points[self.nodes]

    @cached_property
    def lowest(self) -> float:
        return float((self.skin @ self.up).min())

    @cached_property
    def height(self) -> float:
        return float(np.ptp(self.skin @ self.up))

    @cached_property
    def size(self) -> float:
        return float(np.linalg.norm(np.ptp(self.skin, axis=0)))

    @cached_property
    def across(self) -> Array:
        """Two directions on the ground, [2, 3]."""
        first = np.cross(self.up, np.eye(3)[np.argmin(np.abs(self.up))])
        first /= np.linalg.norm(first)
        return np.stack([first, np.cross(self.up, first)])

    @cached_property
    def faces(self) -> tuple[Array, Array, Array]:
        """Centroids [F, 3], unit normals [F, 3] and areas [F] of the triangles."""
        a, b, c = np.moveaxis(self.drawn[self.triangles], 1, 0)
        normals = np.cross(b - a, c - a)
        doubled = np.linalg.norm(normals, axis=1)
        unit = np.divide(normals, doubled[:, None], out=np.zeros_like(normals), where=doubled[:, None] > 0.0)
        return (a + b + c) / 3.0, unit, 0.5 * doubled

    def around(self, drawn: Indices) -> Indices:
        """Nodes of the elements that contain points of the surface."""
        return drawn if self.bound is None else np.unique(self.bound[drawn])

    def footprint(self, points: Array) -> Footprint:
        """The area that points cover on the ground."""
        from scipy.spatial import ConvexHull, QhullError

        try:
            hull = ConvexHull(points @ self.across.T)
        except (QhullError, ValueError):
            return Footprint(self.across, np.empty((0, 3)), 0.0)
        return Footprint(self.across, hull.equations, float(hull.volume))

    @property
    def has_flat_feet(self) -> bool:
        """Whether it touches the ground with more than a rounded underside."""
        feet = self.skin[self.skin @ self.up <= self.lowest + FEET * self.height]
        return self.footprint(feet).area >= LEAST_SPAN * self.footprint(self.skin).area

    def beyond(self, direction: Array, share: float, *, least: float = 0.0) -> Indices:
        """Nodes of the piece in the outermost fraction of its extent along a direction, at least a fraction of them."""
        along = self.skin @ direction
        reach = along.max() - share * np.ptp(along)
        of_nodes = self.points[self.nodes] @ direction
        if least > 0.0:
            rank = max(int(np.ceil(least * len(of_nodes))), 1)
            reach = min(reach, np.partition(of_nodes, len(of_nodes) - rank)[len(of_nodes) - rank])
        return self.nodes[of_nodes >= reach]


def lowest_part(shape: BodyShape) -> SupportRegion:
    """Nodes in the lowest tenth of the height; the lowest nodes if it contains none."""
    nodes = shape.beyond(-shape.up, LOWEST)
    if not len(nodes):
        heights = shape.points[shape.nodes] @ shape.up
        nodes = shape.nodes[heights <= heights.min() + LOWEST * shape.height]
    return SupportRegion(nodes, f"its lowest {100 * LOWEST:g} %")


def flat_region(shape: BodyShape) -> SupportRegion | None:
    """The nodes next to the largest flat region of the surface, from a tenth to a half of all; None if no region is
    flat."""
    from scipy.spatial import cKDTree

    if not len(shape.triangles):
        return None
    centroids, normals, areas = shape.faces
    way, chosen = _largest_flat(centroids, normals, areas, LAYER * shape.size)
    if not areas[chosen].sum() > LEAST_FLAT * areas.sum():  # also if all faces are points, without area
        return None
    region = np.concatenate([centroids[chosen], shape.drawn[np.unique(shape.triangles[chosen])]])
    x = shape.points[shape.nodes]
    away, nearest = cKDTree(region).query(x)
    off = np.abs((x - region[nearest]) @ way)
    least, most = int(np.ceil(LEAST_NODES * len(x))), max(len(x) // 2, 1)
    near = (away <= LAYER * shape.size) | np.isin(shape.nodes, shape.around(np.unique(shape.triangles[chosen])))
    held = _nearest_layers(off, near, most)
    if np.count_nonzero(held) < least:
        held = np.argsort(np.argsort(away, kind="stable")) < min(least, most)
    return SupportRegion(shape.nodes[held], f"its largest flat region, {_facing(way, shape.up)}")


def _nearest_layers(off: Array, near: npt.NDArray[np.bool_], most: int) -> npt.NDArray[np.bool_]:
    """At most this many of the nodes near a region: whole layers of those closest to it, because a partial layer
    would leave a corner of the region loose."""
    if np.count_nonzero(near) <= most:
        return near
    first_left_out = np.sort(off[near])[most]
    return near & (off < (1.0 - SAME_LAYER) * first_left_out)


def broad_sides(shape: BodyShape) -> Iterator[SupportRegion]:
    """The outermost tenths along the up axis and the body's principal axes, broadest first."""
    x = shape.skin - shape.skin.mean(axis=0)
    principal = np.linalg.eigh(x.T @ x)[1].T
    ways = [shape.up, *principal, *-principal]
    found = []
    for way in ways:
        nodes = shape.beyond(way, LOWEST, least=LEAST_NODES)
        spread = shape.points[nodes] - shape.points[nodes].mean(axis=0)
        spread -= np.outer(spread @ way, way)
        values = np.linalg.eigvalsh(spread.T @ spread / len(nodes))
        found.append((float(values[1] * values[2]), way, nodes))
    for _, way, nodes in sorted(found, key=lambda one: -one[0]):
        yield SupportRegion(nodes, "its top" if way is shape.up else f"its broad side, {_facing(way, shape.up)}")


def _largest_flat(centroids: Array, normals: Array, areas: Array, layer: float) -> tuple[Array, Indices]:
    """The direction that the largest flat region faces, and its triangles."""
    turns = np.arange(WAYS) + 0.5
    z, angle = 1.0 - 2.0 * turns / WAYS, np.pi * (1.0 + np.sqrt(5.0)) * turns
    ring = np.sqrt(1.0 - z * z)
    ways = np.stack([ring * np.cos(angle), ring * np.sin(angle), z], axis=1)
    # The area facing each direction; each triangle counts for the direction nearest to its normal.
    some = slice(None, None, 1 + len(areas) // MOST_FACES)
    gathered = np.bincount(np.argmax(normals[some] @ ways.T, axis=1), areas[some], WAYS)
    facing = np.where(ways @ ways.T > SAME_WAY, gathered, 0.0).sum(axis=1)
    best: tuple[float, Array, Indices] | None = None
    for index in np.argsort(-facing)[:CLOSELY]:
        near = normals @ ways[index] > SAME_WAY
        if not near.any():
            continue
        way = areas[near] @ normals[near]
        way /= np.linalg.norm(way)
        chosen = np.flatnonzero(normals @ way > SAME_WAY)
        along = centroids[chosen] @ way
        chosen, along = chosen[np.argsort(along)], np.sort(along)
        summed = np.concatenate([[0.0], np.cumsum(areas[chosen])])
        ends = np.searchsorted(along, along + layer, side="right")
        inside = summed[ends] - summed[: len(along)]
        first = int(np.argmax(inside))
        if best is None or inside[first] > best[0]:
            best = float(inside[first]), way, chosen[first : ends[first]]
    if best is None:
        return np.zeros(3), np.empty(0, np.intp)
    return best[1], best[2]


def _facing(way: Array, up: Array) -> str:
    """The direction in words: "facing up", "facing -x"."""
    if abs(way @ up) > SAME_WAY:
        return "facing up" if way @ up > 0.0 else "facing down"
    axis = int(np.argmax(np.abs(way)))
    return f"facing {'-' if way[axis] < 0.0 else '+'}{'xyz'[axis]}"
