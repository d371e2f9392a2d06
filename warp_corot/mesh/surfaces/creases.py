"""Marched surfaces with the body's own edges (Kobbelt, Botsch, Schwanecke and Seidel 2001, *Feature
sensitive surface extraction from volume data*).

A vertex of marching tetrahedra lies where the body's surface crosses an edge of an element. If the normals at the
vertices of one element's polygon differ by more than an angle, a crease goes through the element. Then a vertex is
added where the tangent planes meet, and edges between two elements with such vertices are flipped to follow the crease.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from .marching import crossing_polygons, plain_triangles

if TYPE_CHECKING:
    from warp_corot.domain import Domain

Array = np.ndarray

#: Normals that differ by more than this make a crease [°].
ANGLE = 30.0
#: A polygon whose centre is closer to the surface than this fraction of its size has no crease.
NEAR = 5.0e-3
#: Crossings of edges are found in this many steps, or until their error is below this fraction of the edge; normals
#: come from differences over this fraction of a polygon's size.
STEPS, OFF, APART = 6, 5.0e-5, 0.02
#: Tangent planes determine a vertex only in directions in which they differ: singular values below this fraction of the
#: largest one count as zero.
RANK = 0.15
#: How far outside its element a vertex may be, as a barycentric coordinate, and how much nearer to the surface than the
#: polygon's middle it must be.
OUTSIDE, NEARER = -0.2, 0.5
#: Places along a crease at which a vertex is tried, in polygon sizes from the polygon's middle; the middle comes first.
SLIDES = np.array(sorted(np.linspace(-1.5, 1.5, 31), key=abs))
#: Four directions whose differences give a gradient.
_AROUND = np.array([[1.0, 1.0, 1.0], [1.0, -1.0, -1.0], [-1.0, 1.0, -1.0], [-1.0, -1.0, 1.0]]) / np.sqrt(3.0)


def sharpened(points: Array, tets: Array, values: Array, domain: Domain) -> tuple[Array, Array]:
    """The surface of a body in tetrahedra that hold all of it: points [m], float64 [V, 3], and triangles int32 [F, 3].

    Args:
        points: Positions of the nodes [m], float64 [n, 3].
        tets: Nodes of the elements, int32 [T, 4].
        values: Signed function at the nodes, negative inside [n].
        domain: The body.
    """
    ends, polygons, cells = crossing_polygons(points, tets, values)
    x, normals = _crossings(points, ends, values, domain)
    whole = (ends[:, 0] != ends[:, 1])[polygons].all(axis=1)
    chosen, apexes = _apexes(x, normals, polygons, whole, points[tets[cells]], domain)
    triangles = plain_triangles(np.delete(polygons, chosen, axis=0), ends)
    numbers = len(x) + np.arange(len(chosen))
    x = np.concatenate([x, apexes])
    triangles = np.concatenate([triangles, _fans(x, polygons[chosen], numbers, domain)])
    used, corners = np.unique(triangles, return_inverse=True)
    return x[used], corners.reshape(-1, 3).astype(np.int32)


def _phi(domain: Domain, points: Array) -> Array:
    return np.asarray(domain.phi(points.reshape(-1, 3)), np.float64).reshape(points.shape[:-1])


def _crossings(points: Array, ends: Array, values: Array, domain: Domain) -> tuple[Array, Array]:
    """The points where the surface crosses edges from a node inside to one outside [V, 3], and its unit normals there,
    NaN where they are not known.

    They come from the body's triangles if it has any, otherwise from false position (Illinois).
    """
    a, along = points[ends[:, 0]], points[ends[:, 1]] - points[ends[:, 0]]
    share, normals = np.zeros(len(ends)), np.full((len(ends), 3), np.nan)
    going = np.flatnonzero(ends[:, 0] != ends[:, 1])
    found = domain.exits(a[going], points[ends[going, 1]])
    if found is not None:
        known = np.isfinite(found[0])
        share[going[known]], normals[going[known]] = found[0][known], found[1][known]
        going = going[~known]
    low, high = np.zeros(len(ends)), np.ones(len(ends))
    below, above = values[ends[:, 0]].astype(np.float64), values[ends[:, 1]].astype(np.float64)
    close = OFF * np.linalg.norm(along, axis=1)
    for _ in range(STEPS):
        b, c = below[going], above[going]
        share[going] = low[going] + (high[going] - low[going]) * b / np.minimum(b - c, -1e-300)
        off = _phi(domain, a[going] + share[going, None] * along[going])
        inside = off < 0.0
        inner, outer = going[inside], going[~inside]
        low[inner], below[inner] = share[inner], off[inside]
        above[inner] *= 0.5
        high[outer], above[outer] = share[outer], off[~inside]
        below[outer] *= 0.5
        going = going[np.abs(off) > close[going]]
    return a + share[:, None] * along, normals


def _apexes(
    x: Array, known: Array, polygons: Array, whole: Array, corners: Array, domain: Domain
) -> tuple[Array, Array]:
    """Polygons that contain a crease, indices [m], and the points where the tangent planes at their vertices meet [m,
    3].

    Args:
        x: Vertices [V, 3].
        known: Normals at the vertices, NaN if unknown [V, 3].
        polygons: Their vertices [P, 4].
        whole: Which polygons have all of their vertices on edges [P].
        corners: Corners of their elements [P, 4, 3].
        domain: The body.
    """
    # Polygons without known normals may contain a crease.
    bent = np.flatnonzero(whole & ~(_least_cosine(known[polygons]) >= np.cos(np.radians(ANGLE))))
    at = x[polygons[bent]]
    middle = at.mean(axis=1)
    size = np.linalg.norm(at - middle[:, None], axis=2).max(axis=1)
    off = np.abs(_phi(domain, middle))
    away = off > NEAR * size
    chosen, at, middle, size, off = bent[away], at[away], middle[away], size[away], off[away]
    if not len(chosen):
        return chosen, np.empty((0, 3))
    normals = _normals(x, known, polygons[chosen], size, domain)
    bends = _least_cosine(normals) < np.cos(np.radians(ANGLE))
    chosen, normals = chosen[bends], normals[bends]
    at, middle, size, off = at[bends], middle[bends], size[bends], off[bends]
    heights = np.einsum("pic,pic->pi", normals, at - middle[:, None])
    u, s, v = np.linalg.svd(normals, full_matrices=False)
    inverse = np.where(s > RANK * s[:, :1], 1.0 / np.maximum(s, 1e-300), 0.0)
    apexes = middle + np.einsum("pkc,pk,pik,pi->pc", v, inverse, u, heights)
    straight = s[:, 2] <= RANK * s[:, 0]
    apexes, inside = _slid(apexes, np.where(straight, size, 0.0)[:, None] * v[:, 2], corners[chosen])
    good = (inside > OUTSIDE) & (np.abs(_phi(domain, apexes)) < NEARER * off)
    return chosen[good], apexes[good]


def _least_cosine(normals: Array) -> Array:
    """The least cosine of the angles between the normals of each polygon [P, 4, 3]; NaN if one is not known."""
    return np.min([np.einsum("pc,pc->p", normals[:, i], normals[:, j]) for i in range(4) for j in range(i)], axis=0)


def _normals(x: Array, known: Array, polygons: Array, size: Array, domain: Domain) -> Array:
    """The surface's unit normals at the vertices of polygons [P, 4, 3]; unknown ones come from differences over a
    fraction of the size of the largest polygon at each vertex."""
    used, vertices = np.unique(polygons, return_inverse=True)
    apart = np.zeros(len(used))
    np.maximum.at(apart, vertices.ravel(), np.repeat(APART * size, polygons.shape[1]))
    normals = known[used]
    sought = np.flatnonzero(np.isnan(normals[:, 0]))
    found = _phi(domain, x[used[sought]][:, None] + apart[sought, None, None] * _AROUND) @ _AROUND
    normals[sought] = found / np.maximum(np.linalg.norm(found, axis=1, keepdims=True), 1e-300)
    return normals[vertices.reshape(polygons.shape)]


def _slid(points: Array, along: Array, corners: Array) -> tuple[Array, Array]:
    """Points moved along lines to where they are farthest inside their elements, and the least of their barycentric
    coordinates there."""
    edges = np.swapaxes(corners[:, 1:] - corners[:, :1], 1, 2)
    sides = np.stack([points - corners[:, 0], along], axis=2)
    later = np.linalg.solve(edges, sides)
    start, rise = (np.column_stack([k - later[:, :, n].sum(axis=1), later[:, :, n]]) for n, k in ((0, 1.0), (1, 0.0)))
    inside = (start[:, None] + SLIDES[:, None] * rise[:, None]).min(axis=2)
    best = np.argmax(inside, axis=1)
    return points + SLIDES[best, None] * along, inside[np.arange(len(best)), best]


def _fans(x: Array, polygons: Array, apexes: Array, domain: Domain) -> Array:
    """Triangles from apexes to the edges of their polygons; an edge between two apexes is flipped if it is then closer
    to the surface.
    """
    after = np.roll(polygons, -1, axis=1)
    fans = np.stack([np.repeat(apexes, polygons.shape[1]), polygons.ravel(), after.ravel()], axis=1)
    fans = fans[fans[:, 1] != fans[:, 2]]
    if not len(fans):
        return fans
    low, high = fans[:, 1:].min(axis=1), fans[:, 1:].max(axis=1)
    order = np.lexsort((high, low))
    same = (low[order[1:]] == low[order[:-1]]) & (high[order[1:]] == high[order[:-1]])
    one, other = order[:-1][same], order[1:][same]
    now = np.abs(_phi(domain, x[fans[one, 1:]].mean(axis=1)))
    then = np.abs(_phi(domain, 0.5 * (x[fans[one, 0]] + x[fans[other, 0]])))
    one, other = one[then < now], other[then < now]
    apex, apex_other, start, end = fans[one, 0], fans[other, 0], fans[one, 1], fans[one, 2]
    fans[one] = np.stack([apex, start, apex_other], axis=1)
    fans[other] = np.stack([apex_other, end, apex], axis=1)
    return fans
