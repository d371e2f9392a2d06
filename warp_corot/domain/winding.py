"""How the triangles of a surface are wound: against neighbours, inwards or outwards, around a point."""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import breadth_first_order

from warp_corot.mesh.pieces import linked

from .edges import Edges

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
    # One node more, tied to one triangle of each part, makes a single search of all parts.
    heads = np.unique(parts, return_index=True)[1]
    rows, columns = np.append(a, np.full(len(heads), count)), np.append(b, heads)
    links = coo_array((np.ones(len(rows)), (rows, columns)), shape=(count + 1, count + 1)).tocsr()
    # In 64 bits, since keys are products.
    order, parent = (each.astype(np.int64) for each in breadth_first_order(links, count, directed=False))
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
