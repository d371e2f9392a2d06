"""Measurements of a body before it is meshed: its volume, its pieces, and points spread over its surface."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import scipy

from .closing import areas
from .domain import Domain
from .labels import LabelDomain, piece_of_voxels
from .surface import SurfaceDomain

#: Number of points along the longest side at which a function is first evaluated, and of halvings of cells at the
#: surface.
CELLS, HALVINGS = 24, 2
#: Number of lines through a body that measure its volume, and the relative difference from its surface's volume above
#: which the surface overlaps itself.
LINES, COUNTED_TWICE = 60_000, 5.0e-3
#: Distance from a triangle at which the body's side is tested, over the body's length.
ASIDE = 1.0e-5


@dataclass(frozen=True)
class Reference:
    """The given body.

    Attributes:
        volume: [m^3].
        points: Points of its surface, evenly spread, float64 [n, 3] [m].
        piece: The connected piece of each point, int32 [n].
        pieces: Number of pieces.
    """

    volume: float
    points: np.ndarray
    piece: np.ndarray
    pieces: int


def reference_of(domain: Domain, count: int) -> Reference:
    """The measurements of a domain, without meshing it.

    Args:
        domain: Any domain. Results for surfaces and voxels are exact; for others volume and pieces come from samples.
        count: Approximate number of points.
    """
    if isinstance(domain, SurfaceDomain):
        return _of_surface(domain, count)
    if isinstance(domain, LabelDomain):
        return _of_voxels(domain, count)
    return _of_samples(domain, count)


def _of_surface(domain: SurfaceDomain, count: int) -> Reference:
    points, triangles = domain.closed.points, domain.closed.triangles.astype(np.int64)
    pieces, piece, crossing = domain.joined
    # At least one point of each piece, however small it is.
    spread, chosen = spread_points(points, triangles, count, np.unique(piece, return_index=True)[1])
    corners, own = points[triangles[chosen]], piece[chosen]
    volume = domain.closed.volume
    if crossing or domain.overlapping or domain.reversed:
        held = volume_along_lines(domain)
        crossing |= abs(held - volume) > COUNTED_TWICE * volume
        volume = held if crossing else volume
    if crossing:
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
        aside = ASIDE * float(np.ptp(domain.bounds, axis=0).max()) * normal
        bounds = ~domain.holds(spread + aside) & domain.holds(spread - aside)
        spread, own = spread[bounds], own[bounds]
    return Reference(volume, spread, own, pieces)


def spread_points(
    points: np.ndarray, triangles: np.ndarray, count: int, first: Sequence[int] | np.ndarray = ()
) -> tuple[np.ndarray, np.ndarray]:
    """Points evenly spread over triangles, float64 [n, 3], and the triangle of each; one in each of ``first``, too."""
    rng, area = np.random.default_rng(0), areas(points, triangles)
    chosen = rng.choice(len(triangles), count, p=area / area.sum())
    chosen = np.concatenate([np.asarray(first, chosen.dtype), chosen])
    u, v = np.sqrt(rng.random(len(chosen))), rng.random(len(chosen))
    weights = np.stack([1.0 - u, u * (1.0 - v), u * v], axis=1)
    return np.einsum("nc,ncx->nx", weights, points[triangles[chosen]]), chosen


def volume_along_lines(domain: SurfaceDomain) -> float:
    """The volume of the body [m^3] by lines through it; regions where parts of its surface overlap count once."""
    lines, (low, high) = domain.lines, domain.bounds
    across = [(lines.axis + 1) % 3, (lines.axis + 2) % 3]
    size = (high - low)[across]
    counts = np.maximum(np.round(size * np.sqrt(LINES / size.prod())), 1).astype(int)
    cells = np.indices(counts).reshape(2, -1).T
    starts = np.empty((len(cells), 3))
    starts[:, across] = low[across] + (cells + np.random.default_rng(0).random(cells.shape)) * (size / counts)
    starts[:, lines.axis] = lines.low
    return float(domain.lengths_inside(starts).mean() * size.prod())


def _of_voxels(domain: LabelDomain, count: int) -> Reference:
    inside = domain.numbers > 0
    numbers = piece_of_voxels(inside)
    rng = np.random.default_rng(0)
    places, owner, weight = map(np.concatenate, zip(*_faces(domain, numbers), strict=True))
    first = np.unique(owner, return_index=True)[1]
    chosen = np.concatenate([first, rng.choice(len(places), count, p=weight / weight.sum())])
    spread = places[chosen] @ domain.affine[:3, :3].T + domain.affine[:3, 3]
    held = float(inside.sum()) * _voxel(domain)
    return Reference(held, spread, owner[chosen].astype(np.int32), int(numbers.max()))


def _voxel(domain: LabelDomain) -> float:
    """The volume of a voxel [m^3]."""
    return abs(float(np.linalg.det(domain.affine[:3, :3])))


def _faces(domain: LabelDomain, numbers: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Faces between a voxel inside and one outside, along each axis: their middles, in voxels, the pieces, of these
    numbers, to which they belong, and their areas [m^2]."""
    for axis in range(3):
        low, high = (np.moveaxis(numbers, axis, 0)[part] for part in (slice(-1), slice(1, None)))
        faces = np.argwhere(np.moveaxis((low > 0) != (high > 0), 0, axis))
        owner = np.maximum(*(np.moveaxis(each, 0, axis)[tuple(faces.T)] for each in (low, high))) - 1
        area = _voxel(domain) / float(np.linalg.norm(domain.affine[:3, axis]))
        yield faces + 0.5 * np.eye(3)[axis], owner, np.full(len(faces), area)


def _of_samples(domain: Domain, count: int) -> Reference:
    volume, points, pieces = _sampled(domain)
    points = _projected(domain, points)
    if len(points) > count:
        points = points[np.random.default_rng(0).choice(len(points), count, replace=False)]
    return Reference(volume, points, np.zeros(len(points), np.int32), pieces)


def _sampled(domain: Domain) -> tuple[float, np.ndarray, int]:
    """Volume, points near the surface, and pieces, of cells that are halved where the surface may be."""
    low, size = domain.bounds[0], np.ptp(domain.bounds, axis=0)
    h = float(size.max()) / CELLS
    cells = np.maximum(np.ceil(size / h).astype(int), 1)
    centres = low + (np.indices(cells).reshape(3, -1).T + 0.5) * (size / cells)
    box = size / cells
    volume = 0.0
    for halving in range(HALVINGS + 1):
        phi = np.asarray(domain.phi(centres), np.float64)
        if halving == 0:
            pieces = scipy.ndimage.label((phi < 0.0).reshape(cells), np.ones((3, 3, 3)))[1]
        reach = 0.5 * domain.lipschitz * float(np.linalg.norm(box))
        near = np.abs(phi) <= reach
        volume += float((phi[~near] < 0.0).sum()) * float(box.prod())
        if halving == HALVINGS:
            # The filled fraction of the last cells comes from points in them, one in each eighth.
            rng = np.random.default_rng(0)
            eighths = (np.indices((2, 2, 2)).reshape(3, -1).T - 1.0)[None] + rng.random((int(near.sum()), 8, 3))
            within = centres[near][:, None] + 0.5 * eighths * box
            share = float((np.asarray(domain.phi(within.reshape(-1, 3))) < 0.0).mean())
            return volume + share * float(near.sum()) * float(box.prod()), centres[near], max(int(pieces), 1)
        parts = (np.indices((2, 2, 2)).reshape(3, -1).T - 0.5) * 0.5
        centres = (centres[near][:, None] + parts * box).reshape(-1, 3)
        box = 0.5 * box
    raise AssertionError


def _projected(domain: Domain, points: np.ndarray) -> np.ndarray:
    """Points near the surface, moved onto it."""
    size = float(np.ptp(domain.bounds, axis=0).max())
    step = 1.0e-4 * size
    for _ in range(4):
        phi = np.asarray(domain.phi(points), np.float64)
        slopes = [domain.phi(points + step * axis) - domain.phi(points - step * axis) for axis in np.eye(3)]
        gradient = np.stack(slopes, axis=1).astype(np.float64) / (2.0 * step)
        points = points - (phi / np.maximum((gradient**2).sum(axis=1), 0.05))[:, None] * gradient
    return points[np.abs(domain.phi(points)) < 1.0e-3 * size / CELLS]


def extent_of(domain: Domain) -> tuple[float, float]:
    """Approximate volume [m^3] and surface area [m^2] of a domain."""
    if isinstance(domain, SurfaceDomain):
        return domain.closed.volume, float(areas(domain.closed.points, domain.closed.triangles).sum())
    if isinstance(domain, LabelDomain):
        inside = domain.numbers > 0
        # A staircase has about 1.5 times the area of the slope that it represents.
        return float(inside.sum()) * _voxel(domain), sum(own.sum() for *_, own in _faces(domain, inside)) / 1.5
    volume, points, _ = _sampled(domain)
    # The layer of cells near the surface is as thick as their diagonal on both sides.
    cell = float(np.ptp(domain.bounds, axis=0).max()) / CELLS * 0.5**HALVINGS
    return volume, len(points) * cell**3 / (domain.lipschitz * np.sqrt(3.0) * cell)
