"""Where a body is fixed if the user names no nodes, and the parts at which it can be."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from warp_corot.discretization.elements import Mesh
from warp_corot.mesh.topology import boundary_faces, pieces_of

if TYPE_CHECKING:
    from .sag import CoarseBody, MeshBody


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


#: A patch supports a body whose sag is at most this fraction of its height.
LARGEST_SAG = 0.3
#: A body above its supporting patch leans under its own weight: sideways gravity must move its centre of mass by less
#: than this fraction of the centre's height above the patch. At the full height a slender column buckles (Greenhill
#: 1881). Coarse meshes estimate down to half the lean: a thin bowl toppled at 0.5, and finer meshes give 1.0.
LARGEST_LEAN = 0.4
#: Pieces with fewer tetrahedra, or below this fraction of the largest one, are fixed at their lower half without a
#: check.
SMALL_PIECE, SMALL_SHARE = 12, 0.01
#: Number of pieces that are named one by one.
NAMED = 3


@dataclass(frozen=True, eq=False)
class Support:
    """How a piece is fixed.

    Attributes:
        nodes: Fixed nodes, indices into the mesh's nodes.
        of: Number of nodes of the piece.
        where: The place in words: "its lowest 10 %".
        stands: Whether it stands on its lowest part.
        why_not: The reason why it does not stand, in words; empty if it does.
        sag: How far it sags, by linear statics, as a fraction of its height; 0 if not estimated.
        stiffer: The factor on its stiffness with which the patch would support it; 1 if it does already.
    """

    nodes: npt.NDArray[np.intp]
    of: int
    where: str
    stands: bool
    why_not: str = ""
    sag: float = 0.0
    stiffer: float = 1.0


@dataclass(frozen=True, eq=False)
class Supports:
    """How a body is fixed, piece by piece, the largest first.

    Attributes:
        pieces: One entry for each piece; none if the body lies on a ground.
        count: Number of nodes of the mesh.
        lies: The reason why it lies on a ground, in words; empty if it does not.
    """

    pieces: Sequence[Support]
    count: int
    lies: str = ""

    @property
    def nodes(self) -> npt.NDArray[np.bool_]:
        """Fixed nodes, bool [N]."""
        mask = np.zeros(self.count, bool)
        for hold in self.pieces:
            mask[hold.nodes] = True
        return mask

    @property
    def stiffer(self) -> float:
        """The factor on the body's stiffness with which every patch would support its piece."""
        return max(hold.stiffer for hold in self.pieces)

    @property
    def words(self) -> str:
        """In words: "standing on its lowest 10 %"."""
        named = [_words_of(hold) for hold in self.pieces[:NAMED]]
        if len(self.pieces) == 1:
            return named[0]
        left = len(self.pieces) - NAMED
        each = [f"piece {number} {words}" for number, words in enumerate(named, start=1)]
        return ", ".join(each) + (f", and {left} more" if left > 0 else "")

    def reasons(self) -> list[str]:
        """What a user should know about each piece, a line for each."""
        several = len(self.pieces) > 1
        lines = []
        for number, hold in enumerate(self.pieces[: NAMED if several else 1], start=1):
            name = f"piece {number}" if several else "the body"
            held = f"{len(hold.nodes)} of {hold.of} nodes"
            if hold.stands:
                lines.append(f"{name} stands on {hold.where}, {held}")
            else:
                lines.append(f"{name} is held by {hold.where}, {held}: {hold.why_not}")
        if len(self.pieces) > NAMED:
            lines.append(f"{len(self.pieces) - NAMED} more pieces are held by themselves")
        return lines


def _words_of(hold: Support) -> str:
    return f"{'standing on' if hold.stands else 'held by'} {hold.where}"


@dataclass(eq=False)
class _BodyPiece:
    """A piece of a body: its shape, its material, and gravity [m/s^2]."""

    shape: BodyShape
    tets: npt.NDArray[np.integer]
    volumes: npt.NDArray[np.float64]
    young: npt.NDArray[np.float64]
    density: npt.NDArray[np.float64]
    gravity: npt.NDArray[np.float64]

    @cached_property
    def body(self) -> CoarseBody | MeshBody:
        from .sag import MOST_SOLVED_TETS, CoarseBody, MeshBody

        kind = MeshBody if len(self.tets) <= MOST_SOLVED_TETS else CoarseBody
        return kind(self.shape.points, self.tets, self.volumes, self.young, self.density)

    def hold(self) -> Support:
        standing = lowest_part(self.shape)
        if len(standing.nodes) == len(self.shape.nodes):
            return self.held_simply()
        needed, sag, why = self._tried(standing, stands=True)
        if needed <= 1.0:
            return self._of(standing, True, "", sag, 1.0)
        best: tuple[float, float, SupportRegion] | None = None
        for patch in self._others():
            needed, sag, _ = self._tried(patch, stands=False)
            if best is None or needed < best[0]:
                best = needed, sag, patch
            if needed <= 1.0:
                break
        if best is None:  # a piece of a few nodes, which every patch contains
            return self.held_simply()
        return self._of(best[2], False, why, best[1], max(best[0], 1.0))

    def held_simply(self) -> Support:
        """Fixed at the lower half of its nodes, at least three, but not all."""
        shape = self.shape
        heights = shape.points[shape.nodes] @ shape.up
        count = min(max(len(heights) // 2, 3), len(heights) - 1)
        nodes = np.sort(shape.nodes[np.argsort(heights, kind="stable")[:count]])
        return Support(nodes, len(heights), "its lower half", True)

    def _others(self) -> Iterator[SupportRegion]:
        flat = flat_region(self.shape)
        for patch in [*([flat] if flat else []), *broad_sides(self.shape)]:
            if len(patch.nodes) < len(self.shape.nodes):
                yield patch

    def _tried(self, patch: SupportRegion, *, stands: bool) -> tuple[float, float, str]:
        """The factor on the piece's stiffness with which a patch would support it; its sag as a fraction of its
        height; and what is wrong with the patch, in words."""
        shape, g = self.shape, float(np.linalg.norm(self.gravity))
        held = shape.points[patch.nodes]
        footprint = shape.footprint(held)
        if stands and g > 0.0 and not footprint.holds(self.body.centre):
            return np.inf, np.inf, f"its centre of mass is not over {patch.where}"
        across = g * shape.across
        down, *sideways = self.body.sag(patch.nodes, [self.gravity, *across])
        sag = down.largest / shape.height
        above = float((self.body.centre - held.mean(axis=0)) @ shape.up)
        lean = max(float(np.linalg.norm(shape.across @ s.centre)) for s in sideways) / above if above > 0.0 else 0.0
        # A piece that hangs, or is fixed at its side, cannot fall over.
        lean *= above > LARGEST_SAG * shape.height or stands
        needed = max(sag / LARGEST_SAG, lean / LARGEST_LEAN)
        if stands and needed <= 1.0 and not footprint.holds(self.body.centre + down.centre):
            return 1.01, sag, f"its centre of mass does not stay over {patch.where}"
        topples = lean / LARGEST_LEAN > sag / LARGEST_SAG
        return needed, sag, f"it would {'topple' if topples else 'sag too far'} on {patch.where}"

    def _of(self, patch: SupportRegion, stands: bool, why: str, sag: float, stiffer: float) -> Support:
        return Support(patch.nodes, len(self.shape.nodes), patch.where, stands, why, sag, stiffer)


def supports_of(
    mesh: Mesh,
    *,
    young: npt.ArrayLike,
    density: npt.ArrayLike,
    gravity: npt.ArrayLike,
    surface: Any = None,
    may_lie: bool = False,
) -> Supports:
    """Fix a body as a person would, so that it neither falls nor topples.

    A piece stands on the lowest tenth of its height if its centre of mass is above that and stays there when the piece
    sags. Otherwise it is fixed at its largest flat region, or at the first of its broad sides that supports it, each
    with at least a tenth of its nodes; if none does, at the one with the smallest sag. Sags are estimated by linear
    statics, for large meshes on a coarse grid (`sag.MeshBody`, `sag.CoarseBody`).

    Args:
        mesh: The body.
        young: Young's modulus [Pa], a number or [T].
        density: Density [kg/m^3], a number or [T].
        gravity: Acceleration [m/s^2], [3].
        surface: A ``SurfaceMesh`` bound to the mesh, if the body ends within its tetrahedra; None: their boundary.
        may_lie: Whether a body may lie on a ground: it does if a piece that is not small has no flat feet or does not
            stand on them, and all such pieces reach down to the lowest tenth of its height.
    """
    g = np.asarray(gravity, dtype=np.float64)
    up = np.eye(3)["XYZ".index(mesh.up_axis)] if not g.any() else -g / np.linalg.norm(g)
    points = np.asarray(mesh.points, dtype=np.float64)
    volumes = np.asarray(mesh.volumes) * (1.0 if getattr(mesh, "fill", None) is None else mesh.fill)  # type: ignore
    if surface is None:
        drawn, triangles = points, boundary_faces(mesh.tets, points)[0]
        bound, elements = np.arange(len(points)), None
    else:
        drawn, triangles, bound, elements = surface.points, surface.triangles, surface.nodes[:, 0], surface.nodes
    of_tet = pieces_of(mesh.tets)
    of_node = piece_of_nodes(mesh, of_tet)
    of_triangle = of_node[bound[triangles[:, 0]]]
    holds, count = [], int(of_tet.max()) + 1
    of_piece = np.bincount(of_tet, volumes)
    small = (np.bincount(of_tet) < SMALL_PIECE) | (of_piece < SMALL_SHARE * of_piece.max())
    if may_lie := may_lie and bool(g.any()):
        heights = drawn @ up
        lows = np.array([heights[triangles[of_triangle == number]].min(initial=np.inf) for number in range(count)])
        may_lie = bool((lows[~small] <= heights.min() + LOWEST * np.ptp(heights)).all())
    for number in range(count):
        inside, around = of_tet == number, triangles[of_triangle == number]
        tets = mesh.tets[inside]
        shape = BodyShape(points, np.unique(tets), drawn, around, up, elements)
        own_young, own_density = (np.broadcast_to(np.ravel(a), len(of_tet))[inside] for a in (young, density))
        piece = _BodyPiece(shape, tets, volumes[inside], own_young, own_density, g)
        if may_lie and not small[number] and not shape.has_flat_feet:
            return Supports([], len(points), "it has no flat feet")
        holds.append(piece.held_simply() if small[number] and count > 1 else piece.hold())
        if may_lie and not holds[-1].stands:
            return Supports([], len(points), holds[-1].why_not)
    return Supports(holds, len(points))


def piece_of_nodes(mesh: Mesh, of_tet: npt.NDArray[np.integer]) -> npt.NDArray[np.intp]:
    """The piece of each node [N]: the largest if several meet there, -1 for nodes in no tetrahedron."""
    none = len(of_tet)
    found = np.full(len(mesh.points), none)
    np.minimum.at(found, mesh.tets.ravel(), np.repeat(of_tet, 4))
    return np.where(found == none, -1, found)
