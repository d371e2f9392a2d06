"""The triangles of a closed surface that have the body behind them and the outside in front everywhere."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warp_corot.inputs.cpu_threads import launch_side_by_side
from warp_corot.kernels.meshing import domain as kernels
from warp_corot.kernels.meshing import measuring
from warp_corot.kernels.meshing.windings import Lines

from .edges import Edges
from .winding import linked

if TYPE_CHECKING:
    from .closing import ClosedSurface

#: Winding numbers are evaluated this far off a triangle, over its own size and, at least, over the surface's.
ASIDE, LEAST_ASIDE = 1.0e-3, 2.0e-6
#: If more than this share of the edges crosses triangles of their own part, no triangle is sure. For five tubes and
#: lumps that cross themselves in up to this share, no sign was wrong at 100,000 points near each.
MESSY = 0.1
#: Two triangles whose unit normals add up to less nearly coincide.
FOLDED = 0.05
#: A triangle whose height is below this share of its longest edge, or ``LEAST_ASIDE``, has an uncertain normal.
NEEDLE = 1.0e-4
#: Winding numbers are computed for at most this many patches; more are not worth the time.
MOST_PATCHES = 20_000
#: Normals of two triangles that differ by more than this make a sharp edge [°].
SHARP = 30.0
#: Points near the surface at which the result is tested.
TRIED = 4096


@dataclass(frozen=True)
class Sides:
    """Data that tell inside from outside at the triangle that is closest to a point.

    Attributes:
        known: BOUNDARY, BURIED or UNSURE, uint8 [T].
        edge_normals: Sums of the unit normals of the two triangles at each edge, the one across from each corner,
            float32 [T, 3, 3].
        corner_normals: Of all triangles around each point, weighted by their angles, float32 [N, 3].
    """

    known: np.ndarray
    edge_normals: np.ndarray
    corner_normals: np.ndarray

    def arrays(self, device: wp.Device) -> list[wp.array]:
        """The three arrays on a device."""
        return [
            wp.array(self.known, dtype=wp.uint8, device=device),
            wp.array(self.edge_normals, dtype=wp.vec3, device=device),
            wp.array(self.corner_normals, dtype=wp.vec3, device=device),
        ]


def sides_of(closed: ClosedSurface, mesh: wp.Mesh, lines: Lines) -> Sides:
    """Find what is on the two sides of each triangle.

    If the triangles of a patch meet others only along common edges, all of them have the same sides, and two winding
    numbers decide. Triangles that cross others are unsure, and so are those around edges that are not shared by two and
    around needles. Finally, signs are compared at random points near the surface. If any is wrong, or if the surface
    crosses itself in many places, no triangle is sure.

    Args:
        closed: The surface.
        mesh: The same surface on the device.
        lines: The lines along which winding numbers are found.
    """
    points, triangles, edges = closed.points, closed.triangles.astype(np.int64), closed.edges
    count = len(triangles)
    one, other = edges.twos
    a, b = one // 3, other // 3

    corners = points[triangles]
    crossed = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    double_area = np.sqrt(np.einsum("ij,ij->i", crossed, crossed))
    normal = crossed / np.maximum(double_area, 1e-300)[:, None]
    edge_normals = np.zeros((3 * count, 3), np.float32)
    # The half-edge from corner k is the edge across from corner k + 2.
    across = np.array([2, 0, 1])
    edge_normals[3 * a + across[one % 3]] = edge_normals[3 * b + across[other % 3]] = normal[a] + normal[b]
    corner_normals = _corner_normals(corners, triangles, normal, double_area, len(points))
    unknown = np.full(count, kernels.UNSURE, np.uint8)

    def with_sides(known: np.ndarray) -> Sides:
        return Sides(known, edge_normals.reshape(count, 3, 3), corner_normals)

    touched = _touched(edges.ends, mesh)
    hit = np.flatnonzero(touched >= 0)
    owner = edges.order[edges.starts[hit]] // 3
    crosses_itself = closed.parts[owner] == closed.parts[touched[hit]]
    if np.count_nonzero(crosses_itself) + np.count_nonzero(touched < -1) > MESSY * len(touched):
        return with_sides(unknown)
    doubtful: np.ndarray = np.zeros(count, bool)
    doubtful[edges.order[np.repeat((touched != -1) | (edges.sharers != 2), edges.sharers)] // 3] = True
    doubtful[touched[hit]] = True
    folded = np.linalg.norm(normal[a] + normal[b], axis=1) < FOLDED
    doubtful[a[folded]] = doubtful[b[folded]] = True
    doubtful |= _needles(corners, double_area, LEAST_ASIDE * float(np.ptp(points, axis=0).max()))
    near = _pinched(triangles, one, other, len(points))[triangles].any(axis=1) | doubtful
    # And their neighbours, because in float32 a crossing does not end at a triangle's edge.
    of_doubtful = np.zeros(len(points), bool)
    of_doubtful[triangles[near]] = True
    doubtful = np.asarray(of_doubtful[triangles].any(axis=1))
    linking = ~(doubtful[a] | doubtful[b])
    patches, patch = linked(a[linking], b[linking], count)
    sure = np.unique(patch[~doubtful])
    if not len(sure) or len(sure) > MOST_PATCHES:
        return with_sides(unknown)
    largest = np.zeros(patches, np.int64)
    by_size = np.argsort(double_area)
    largest[patch[by_size]] = by_size
    chosen = largest[sure]
    aside = np.maximum(ASIDE * np.sqrt(double_area[chosen]), LEAST_ASIDE * np.ptp(points, axis=0).max())
    middle = corners[chosen].mean(axis=1)
    off = aside[:, None] * normal[chosen]
    outside, inside = (_signed(mesh, lines, x, with_sides(unknown)) < 0.0 for x in (middle + off, middle - off))
    of_patch = np.full(patches, kernels.UNSURE, np.uint8)
    of_patch[sure[~outside & inside]] = kernels.BOUNDARY
    of_patch[sure[outside & inside]] = kernels.BURIED
    known = np.where(doubtful, np.uint8(kernels.UNSURE), of_patch[patch])
    points_near = _near(corners, double_area)
    quick, slow = (_signed(mesh, lines, points_near, with_sides(one)) for one in (known, unknown))
    noise = 1e-6 * float(np.ptp(points, axis=0).max())
    differ = ((quick < 0.0) != (slow < 0.0)) & (np.abs(slow) >= noise)
    return with_sides(unknown if differ.any() else known)


def _needles(corners: np.ndarray, double_area: np.ndarray, least: float) -> np.ndarray:
    """Triangles so thin that rounding may turn them over, bool [T].

    Args:
        corners: [T, 3, 3] [m].
        double_area: Twice their areas [T] [m^2].
        least: Height below which a triangle counts as one [m].
    """
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    return double_area < np.maximum(least, NEEDLE * longest) * longest


def _corner_normals(
    corners: np.ndarray, triangles: np.ndarray, normal: np.ndarray, double_area: np.ndarray, count: int
) -> np.ndarray:
    found = np.zeros((count, 3))
    for n in range(3):
        u, v = corners[:, (n + 1) % 3] - corners[:, n], corners[:, (n + 2) % 3] - corners[:, n]
        angle = np.arctan2(double_area, np.einsum("ij,ij->i", u, v))
        for axis in range(3):
            found[:, axis] += np.bincount(triangles[:, n], angle * normal[:, axis], count)
    return found.astype(np.float32)


def _pinched(triangles: np.ndarray, one: np.ndarray, other: np.ndarray, count: int) -> np.ndarray:
    """Mask of the points around which triangles are not all linked by common edges, bool [count].

    Args:
        triangles: [T, 3].
        one, other: The half-edges of edges that two triangles share.
        count: Number of points.
    """
    of_corner = triangles.ravel()
    start, end = one, 3 * (one // 3) + (one + 1) % 3
    # Half-edges start at their own corner; the other triangle's run the same way or back.
    start_other, end_other = other, 3 * (other // 3) + (other + 1) % 3
    alike = of_corner[start] == of_corner[start_other]
    links = [start, np.where(alike, start_other, end_other)], [end, np.where(alike, end_other, start_other)]
    a, b = np.concatenate(links, axis=1)
    fans, fan = linked(a, b, len(of_corner))
    point_of = np.empty(fans, np.int64)
    point_of[fan] = of_corner
    return np.bincount(point_of, minlength=count) > 1


def _touched(edges: np.ndarray, mesh: wp.Mesh) -> np.ndarray:
    touched = wp.empty(len(edges), dtype=wp.int32, device=mesh.device)
    given = wp.array(edges.astype(np.int32), dtype=wp.vec2i, device=mesh.device)
    launch_side_by_side(
        measuring.find_touched_triangles,
        len(edges),
        lambda own: ([mesh.points, own(given), mesh.id, mesh.indices], [own(touched)]),
        mesh.device,
    )
    return touched.numpy()


def _signed(mesh: wp.Mesh, lines: Lines, points: np.ndarray, sides: Sides) -> np.ndarray:
    given = wp.array(points, dtype=wp.vec3, device=mesh.device)
    phi = wp.empty(len(points), dtype=wp.float32, device=mesh.device)
    inputs = [given, mesh.id, mesh.indices, lines, *sides.arrays(mesh.device)]
    wp.launch(kernels.evaluate_surface, len(points), inputs, [phi], device=mesh.device)
    return phi.numpy()


def _near(corners: np.ndarray, area: np.ndarray) -> np.ndarray:
    """Points near the surface, at all distances from it."""
    rng = np.random.default_rng(0)
    chosen = rng.choice(len(corners), TRIED, p=area / area.sum())
    size = float(np.ptp(corners.reshape(-1, 3), axis=0).max())
    apart = size * 10.0 ** rng.uniform(-4.0, -1.0, (TRIED, 1)) * rng.standard_normal((TRIED, 3))
    return np.einsum("nc,ncx->nx", rng.dirichlet([1.0, 1.0, 1.0], TRIED), corners[chosen]) + apart


def corner_points(points: np.ndarray, triangles: np.ndarray, edges: Edges, bounds: np.ndarray) -> np.ndarray:
    """Numbers of the points where three or more sharp edges meet.

    Args:
        points: float64 [N, 3].
        triangles: Closed, int64 [T, 3].
        edges: Their edges.
        bounds: Mask of the triangles with the body on one side and the outside on the other, bool [T]; points of others
            do not count.
    """
    corners = points[triangles]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.maximum(np.sqrt(np.einsum("ij,ij->i", normal, normal)), 1e-300)[:, None]
    one, other = edges.pairs
    sharp = one[np.einsum("nc,nc->n", normal[one // 3], normal[other // 3]) < np.cos(np.radians(SHARP))]
    meeting = [np.bincount(ends[sharp], minlength=len(points)) for ends in (edges.starting, edges.ending)]
    found = meeting[0] + meeting[1] >= 3
    found[triangles[~bounds].ravel()] = False
    return np.flatnonzero(found)
