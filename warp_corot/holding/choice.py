"""Where a body is fixed if the user names no nodes: at the part it stands on, if that supports it, else at its largest
flat region or a broad side. Each separate piece is fixed by itself. A body of one piece may lie on a ground instead."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from warp_corot.discretization.elements import Mesh
from warp_corot.mesh.topology import boundary_faces, pieces_of

from .regions import BodyShape, SupportRegion, broad_sides, flat_region, lowest_part

if TYPE_CHECKING:
    from .sag import CoarseBody
    from .sag_mesh import MeshBody

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
        from .sag import CoarseBody
        from .sag_mesh import MOST_TETS, MeshBody

        kind = MeshBody if len(self.tets) <= MOST_TETS else CoarseBody
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
    statics, for large meshes on a coarse grid (`sag_mesh.MeshBody`, `sag.CoarseBody`).

    Args:
        mesh: The body.
        young: Young's modulus [Pa], a number or [T].
        density: Density [kg/m^3], a number or [T].
        gravity: Acceleration [m/s^2], [3].
        surface: A ``SurfaceMesh`` bound to the mesh, if the body ends within its tetrahedra; None: their boundary.
        may_lie: Whether a body may lie on a ground: it does if it has no flat feet or does not stand on them, and all
            pieces but one are small.
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
    may_lie = may_lie and bool(g.any()) and np.count_nonzero(~small) == 1
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
