"""A forest finer than the mesh: the parts of a body in tetrahedra of all levels, and the meshes in the forest.

A node is inside if its value is negative; zero counts as outside, so that the surface lies in elements that contain a
part of the body. The share of an element that the surface cuts belongs to the linear interpolant of the values.

Random points miss walls that are thinner than the elements that they pass, so such an element holds a part of the wall
if the point of the body's surface that is nearest to it lies in it. The wall's thickness there says how much; all of
them together hold what random points say."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial import cKDTree

from warp_corot.mesh.bisection import far_end
from warp_corot.mesh.growing.refinement_criteria import FARTHER, GAP_ELEMENTS, ROUGH, THIN_NEED, surface_points
from warp_corot.mesh.lattice import lattice_spacing, volume_shares
from warp_corot.mesh.scattered import spread_over_eighths
from warp_corot.mesh.topology import codes, connected, coordinates_in
from warp_corot.mesh.tree import LIVE, VOID, Tree

if TYPE_CHECKING:
    from warp_corot.domain import Domain
    from warp_corot.mesh.growing.growth import Grown

Array = np.ndarray

#: Node orders that put the inside nodes first, by the set of inside nodes (bit n for node n), and the number of inside
#: nodes.
_INSIDE_FIRST = np.array([sorted(range(4), key=lambda n: 1 - (code >> n & 1)) for code in range(16)])
_COUNT = np.array([code.bit_count() for code in range(16)])


def shares(inside: Array, crossing: Callable[[Array, Array], Array]) -> Array:
    """Share of each element's volume around its inside nodes, float64 [n].

    Args:
        inside: bool [n, 4].
        crossing: A function of a node inside and one outside of each element, both int [n]: the fraction of their edge,
            from the inside node to the border, [n].
    """
    code = codes(inside)
    found = (code == 15).astype(np.float64)
    for count, share in ((1, _share_of_one), (2, _share_of_two), (3, _share_of_three)):
        chosen = np.flatnonzero(_COUNT[code] == count)
        nodes = _INSIDE_FIRST[code[chosen]]

        def at(i: int, j: int, chosen: Array = chosen, nodes: Array = nodes) -> Array:
            return crossing(chosen, nodes[:, [i, j]])

        found[chosen] = share(at)
    return found


def _share_of_one(t: Callable[[int, int], Array]) -> Array:
    return t(0, 1) * t(0, 2) * t(0, 3)


def _share_of_two(t: Callable[[int, int], Array]) -> Array:
    """The wedge from a-ac-ad to b-bc-bd, in three tetrahedra."""
    ac, ad, bc, bd = t(0, 2), t(0, 3), t(1, 2), t(1, 3)
    return ac * ad + (1 - ad) * ac * bd + (1 - ac) * bc * bd


def _share_of_three(t: Callable[[int, int], Array]) -> Array:
    return 1 - (1 - t(0, 3)) * (1 - t(1, 3)) * (1 - t(2, 3))


def inside_shares(values: Array) -> Array:
    """Fraction of each element's volume in which the linear interpolant of its nodes' values [n, 4] is negative."""

    def crossing(elements: Array, ends: Array) -> Array:
        inner, outer = values[elements[:, None], ends].T.astype(np.float64)
        return inner / (inner - outer)

    return shares(values < 0, crossing)


def label_shares(values: Array, labels: Array) -> Array:
    """Share of each element's volume that the label of each of its nodes takes, float64 [n, 4].

    If several inside nodes have a label, its fraction is stored at the first of them. Between nodes of two labels the
    border is halfway; towards the outside it is at the zero of the interpolant. Each label is cut out separately; if
    three labels meet, these cuts leave a gap, which the labels share in proportion.

    Args:
        values: Signed function at the nodes [n, 4].
        labels: int32 [n, 4].
    """
    inside = values < 0

    def crossing(elements: Array, ends: Array) -> Array:
        own, other = values[elements[:, None], ends].T.astype(np.float64)
        return np.divide(own, own - other, out=np.full(len(own), 0.5), where=other >= 0)

    found = np.zeros(values.shape)
    counted = np.zeros(values.shape, bool)
    for node in range(4):
        alike = inside & (labels == labels[:, [node]])
        found[:, node] = np.where(inside[:, node] & ~counted[:, node], shares(alike, crossing), 0.0)
        counted |= alike & inside[:, [node]]
    total = found.sum(axis=1, keepdims=True)
    return np.divide(found * inside_shares(values)[:, None], total, out=np.zeros_like(found), where=total > 0)


#: A body is one of walls if elements without a corner inside hold more than this share of it.
OF_WALLS = 0.2
#: Normals come from differences over this share of the distance to the surface, and at least and at most of an element.
APART, LEAST_APART, MOST_APART = 0.2, 1.0e-3, 0.05
#: How far from the surface a point that was moved there may be, and how thick a wall, over the length of the element.
OFF, THICKEST = 0.02, 0.25
#: How far outside an element the surface may be, as a barycentric coordinate.
OUTSIDE = -1.0e-3


def wall_shares(corners: np.ndarray, points: np.ndarray, sampled: np.ndarray, domain: Domain) -> np.ndarray:
    """The share of each element without a corner inside that is wall, float64 [n].

    Args:
        corners: Corners of the elements [m], float64 [n, 4, 3].
        points: A point in each that is near the body [m], float64 [n, 3].
        sampled: The share of random points in each that are inside [n].
        domain: The body.
    """
    volumes = np.abs(np.linalg.det(corners[:, 1:] - corners[:, :1])) / 6.0
    lengths = np.cbrt(6.0 * volumes)
    value = domain.sampled(points)
    apart = np.clip(APART * np.abs(value), LEAST_APART * lengths, MOST_APART * lengths)
    normal = domain.normals(points, apart)
    at = points - value[:, None] * normal
    within = coordinates_in(corners, at).min(axis=1) > OUTSIDE
    crossed = np.flatnonzero(within & (np.abs(domain.sampled(at)) < OFF * lengths))
    reach = THICKEST * float(lengths[crossed].max(initial=0.0))
    if not reach:
        return sampled
    thickness = domain.thickness(at[crossed], -normal[crossed], reach)
    wall = thickness < THICKEST * lengths[crossed]
    crossed, thickness = crossed[wall], thickness[wall]
    # A plane through an element cuts it in about so large an area.
    weights = thickness * np.cbrt(volumes[crossed]) ** 2
    rest = sampled.copy()
    rest[crossed] = 0.0
    held = float((sampled - rest) @ volumes) if len(crossed) else 0.0
    found = rest
    found[crossed] = np.minimum(held * weights / max(float(weights.sum()), 1e-300) / volumes[crossed], 1.0)
    return found


#: Below the mesh, in place of a first child.
BELOW = -3


#: Pieces below this fraction of the body do not count, and more pieces than this are fragments of unresolved parts.
LEAST_PIECE, MOST_PIECES = 1.0e-4, 16
#: Approximate number of all points.
MOST_POINTS = 250_000
#: A leaf with a corner inside the body counts as filled to at least this share.
LEAST = 1.0e-6


class Resolved:
    """The parts of a body in the tetrahedra of a grown forest, from its leaves up.

    Args:
        grown: The forest.
        cell_size: Edge of a root cube [m].
        domain: The body; it is evaluated again in leaves whose corners do not determine their contents.

    Attributes:
        grown: The forest.
        held: Share of the body in each tetrahedron, over a root cube's volume, float64 [M].
        volume: Volume of each tetrahedron, in the same unit.
        leaves: Indices of the leaves that contain a part of the body.
        shares: The filled fraction of these leaves.
    """

    def __init__(self, grown: Grown, cell_size: float, domain: Domain | None = None):
        tree = grown.tree
        self.grown = grown
        self.cell_size = cell_size
        self._by_level = tree.inner_by_level
        leaves = np.flatnonzero(tree.first_child == LIVE)
        shares = inside_shares(grown.phi[tree.tets[leaves]])
        self.volume = volume_shares(tree.level)
        if domain is not None:
            rough = self._rough(leaves)
            bare = rough & (shares == 0.0)
            shares[rough], nearest = _sampled_shares(grown, leaves[rough], cell_size, domain, shares[rough])
            held = shares * self.volume[leaves]
            if held[bare].sum() > OF_WALLS * held.sum():
                corners = self.points(tree.tets[leaves[bare]])
                shares[bare] = wall_shares(corners, nearest[bare[rough]], shares[bare], domain)
        self.leaves, self.shares = leaves[shares > 0.0], shares[shares > 0.0]
        held = np.zeros(len(tree.level))
        held[self.leaves] = self.shares * self.volume[self.leaves]
        self.held = self.summed(held)

    @property
    def lengths(self) -> np.ndarray:
        """An edge length for each tetrahedron [m]: the cell size, halved every three levels."""
        return self.cell_size * 0.5 ** (self.grown.tree.level / 3.0)

    def points(self, nodes: Any) -> np.ndarray:
        """The places of lattice points [m], float64 [n, 3]."""
        return np.asarray(self.grown.origin) + self.grown.lattice[nodes] * lattice_spacing(self.cell_size)

    def _rough(self, leaves: np.ndarray) -> np.ndarray:
        """Mask of leaves whose corners do not determine their contents, bool [n]. Leaves that were not evaluated,
        because nothing is bisected there, take it from their parents.
        """
        tree, need, lengths = self.grown.tree, self.grown.need, self.lengths
        parents = np.maximum(tree.parent[leaves], 0)
        unknown = (need[leaves] == 0.0) & (tree.level[leaves] >= self.grown.deepest)
        near = (np.abs(self.grown.phi[tree.tets[leaves]]) < lengths[leaves, None]).any(axis=1)
        looked_at = np.where(unknown & near, parents, leaves)
        return need[looked_at] > ROUGH * lengths[looked_at]

    def summed(self, values: np.ndarray) -> np.ndarray:
        """Sums of the leaves' values over all their ancestors."""
        return self._upwards(values, np.add)

    def largest(self, values: np.ndarray) -> np.ndarray:
        """For each tetrahedron the largest value in it and below."""
        return self._upwards(values, np.maximum)

    def smallest(self, values: np.ndarray) -> np.ndarray:
        """For each tetrahedron the smallest value in it and below."""
        return self._upwards(values, np.minimum)

    def owners(self, child: np.ndarray) -> np.ndarray:
        """The leaf of a mesh in the forest that contains each tetrahedron, -1 above the mesh's leaves; int32 [M].

        Args:
            child: The mesh, see `Coarsening`.
        """
        first = self.grown.tree.first_child
        owner = np.where((child == LIVE) | (child == VOID), np.arange(len(child), dtype=np.int32), np.int32(-1))
        for elements in self._by_level:
            below = elements[owner[elements] >= 0]
            owner[first[below]] = owner[first[below] + 1] = owner[below]
        return owner

    def tree_of(self, child: np.ndarray) -> tuple[Tree, np.ndarray]:
        """A mesh in the forest as a separate tree, and its tetrahedra's numbers in the forest, ascending."""
        tree, stays = self.grown.tree, np.flatnonzero(child != BELOW)
        return Tree(tree.tets, tree.level, tree.parent, child).taken(stays), stays

    def as_wished(self) -> np.ndarray:
        """The mesh before the body was sampled more finely, as its first children [M]."""
        wished = self.grown.wished
        child = np.full(len(self.held), BELOW, np.int32)
        child[: len(wished)] = wished
        leaf = np.flatnonzero(child == LIVE)
        child[leaf[self.held[leaf] <= 0.0]] = VOID
        return child

    def thin(self, domain: Domain, layers: float) -> np.ndarray:
        """The smallest thickness of the body at the surface in each tetrahedron, float64 [M] [m]."""
        grown, found = self.grown, np.full(len(self.held), np.inf)
        cut = self.leaves[self.shares < 1.0]
        if len(cut):
            tets = grown.tree.tets[cut]
            x, inward = surface_points(self.points(tets), grown.phi[tets])
            found[cut] = domain.thickness(x, inward, FARTHER * layers * self.cell_size)
        return self.smallest(found)

    def gaps(self) -> np.ndarray | None:
        """The smallest distance from the surface in each tetrahedron to another piece of the body, float64 [M] [m];
        None if there is one piece, or implausibly many.
        """
        grown = self.grown
        tets = grown.tree.tets[self.leaves]
        if not len(tets):
            return None
        piece = connected(np.where(grown.phi[tets] < 0, tets, np.int32(-1)))
        sizes = np.bincount(piece, self.shares * self.volume[self.leaves])
        real = np.flatnonzero(sizes > LEAST_PIECE * sizes.sum())
        if not 1 < len(real) <= MOST_PIECES:
            return None
        at_surface = np.flatnonzero((grown.phi[tets] >= 0).any(axis=1) & np.isin(piece, real))
        piece, x = piece[at_surface], self.points(tets[at_surface]).mean(axis=1)
        found = np.full(len(self.held), np.inf)
        for number in real:
            own, other = piece == number, cKDTree(x[piece != number])
            near = GAP_ELEMENTS * self.cell_size
            found[self.leaves[at_surface[own]]] = other.query(x[own], distance_upper_bound=near)[0]
        return self.smallest(found)

    def _upwards(self, values: np.ndarray, ufunc: np.ufunc) -> np.ndarray:
        values, first = values.copy(), self.grown.tree.first_child
        for elements in self.deepest_first():
            below = ufunc(values[first[elements]], values[first[elements] + 1])
            values[elements] = ufunc(values[elements], below)
        return values

    def deepest_first(self) -> Iterator[np.ndarray]:
        return reversed(self._by_level)


#: Where many elements need bisection alike, so that there are meshes of too few and of too many, the farther ones along
#: the longest side need it more, by up to this share.
FARTHER_FIRST = 0.05
#: The drawn surface is closer to the body's than the mesh's threshold by this factor.
FINER_SURFACE = 0.3


class Coarsening:
    """The meshes in a forest, by the need of its tetrahedra to be bisected.

    A mesh is an array in place of first children: the first child of bisected tetrahedra, LIVE or VOID at leaves, BELOW
    under them.

    Args:
        resolved: The forest.
        needs: The need of each of its tetrahedra to be bisected [m], float32 [M].
        sliver: Leaves filled by less than this fraction are not counted.
        least: The threshold up to which nothing is bisected [m].

    Attributes:
        resolved: The forest.
        count, child, threshold: The number of counted leaves of the chosen mesh, the mesh, and its threshold.
    """

    def __init__(self, resolved: Resolved, needs: np.ndarray, sliver: float, least: float = 0.0):
        self.resolved, self._needs, self._sliver, self._least = resolved, needs, sliver, least
        self.count, self.child, self.threshold = 0, np.empty(0, np.int32), 0.0
        tree, holds = resolved.grown.tree, resolved.held > 0.0
        needs, of_node = needs.copy(), np.zeros(len(resolved.grown.lattice), np.float32)
        # Everything that can be asked for is in the forest: a conforming mesh of some of its tetrahedra needs no other
        # bisections. A tetrahedron is bisected if it is asked for, if a child of it is, or if another with the same
        # refinement edge is; all its other edges are edges of its children. So one sweep from the deepest level up
        # gives each the threshold up to which it is bisected.
        for elements in resolved.deepest_first():
            if not len(elements):
                continue
            below = tree.first_child[elements]
            need = np.maximum(needs[elements], np.maximum(needs[below], needs[below + 1]))
            node = tree.tets[below, far_end(int(tree.level[elements[0]]) % 3)]
            np.maximum.at(of_node, node[holds[elements]], need[holds[elements]])
            needs[elements] = np.maximum(need, of_node[node])
        # A tetrahedron without children cannot be bisected, whatever its need.
        self._own = own = np.where(tree.first_child >= 0, needs, np.float32(0.0))
        # Nor does one outside the body have children in a mesh.
        self._above = np.where(tree.parent < 0, np.float32(np.inf), np.where(holds, needs, -1.0)[tree.parent])
        self._first_child, self._holds = tree.first_child, holds
        counted = holds & (resolved.held >= sliver * resolved.volume)
        roots = np.count_nonzero(counted & (tree.parent < 0))
        above = tree.parent[counted & (tree.parent >= 0)]
        # A tetrahedron is a leaf of meshes with thresholds from its own need up to its parent's.
        begin, end = np.sort(own[counted]), np.sort(own[above[holds[above]]])
        last = np.append(end[1:] != end[:-1], True) if len(end) else np.empty(0, bool)
        self._thresholds = end[last]
        self._counts = roots + len(end) - 1 - np.flatnonzero(last)
        self._counts -= len(begin) - np.searchsorted(begin, self._thresholds, side="right")
        self._counted = counted

    def threshold_of(self, target: int, least: float) -> float:
        """The threshold, at least ``least``, with the largest number of elements up to a limit."""
        first = int(np.searchsorted(self._thresholds, np.float32(least), side="right"))
        if self.mesh(least)[0] <= target or first == len(self._thresholds):
            return float(least)
        counts = np.where(self._counts[first:] <= target, self._counts[first:], -1)
        return float(self._thresholds[first + int(np.argmax(counts))])

    def mesh(self, least: float) -> tuple[int, np.ndarray]:
        """Bisect all tetrahedra with a need above ``least``; return the number of counted leaves and the mesh, int32
        [M].
        """
        limit = np.float32(least)
        found = np.where(self._holds, np.where(self._own > limit, self._first_child, LIVE), VOID).astype(np.int32)
        found[self._above <= limit] = BELOW
        return int(np.count_nonzero(self._counted & (found == LIVE))), found

    def choose(self, target: int) -> int:
        """Choose the largest mesh with at most this many elements, or the coarsest; return its number of elements."""
        self.threshold = self.threshold_of(target, self._least)
        self.count, self.child = self.mesh(self.threshold)
        return self.count

    def told_apart(self, target: int) -> Coarsening:
        """The meshes in the same forest if no two elements need bisection alike: more so the farther along the body's
        longest side; the chosen one is the mesh of at most so many elements."""
        grown = self.resolved.grown
        along = grown.lattice[grown.tree.tets, int(np.argmax(grown.cells))].mean(axis=1)
        needs = self.resolved.largest(self._needs * (1.0 + FARTHER_FIRST * along / along.max())).astype(np.float32)
        found = Coarsening(self.resolved, needs, self._sliver, self._least)
        found.choose(target)
        return found

    @property
    def has_more(self) -> bool:
        """Whether there are meshes with more elements than the chosen one."""
        return self.threshold > self._least

    def surface(self, threshold: float) -> np.ndarray:
        """A mesh of the same forest, finer than that of a threshold, for the drawn surface."""
        resolved, need = self.resolved, self.resolved.grown.need
        # Thin parts that are flat need no finer surface.
        curved = (resolved.held > 0.0) & ~np.isclose(need, THIN_NEED * resolved.lengths, rtol=1.0e-5)
        needs = resolved.largest(np.where(curved, need, 0.0)).astype(np.float32)
        needs = np.maximum(needs, np.where(self._needs > threshold, self._needs, 0.0))
        return Coarsening(resolved, needs, self._sliver).mesh(FINER_SURFACE * threshold)[1]


def points_within(
    grown: Grown, elements: np.ndarray, cell_size: float, each: int, rng: np.random.Generator
) -> np.ndarray:
    """Random points in tetrahedra, spread evenly over their eighths [n, each, 3] [m]."""
    first = rng.integers(0, 8, len(elements))
    weights = rng.standard_exponential((len(elements), each, 4), dtype=np.float32)
    weights /= weights.sum(axis=2, keepdims=True)
    corners = grown.lattice[grown.tree.tets[elements]] * lattice_spacing(cell_size)
    return spread_over_eighths(weights, first) @ corners + np.asarray(grown.origin)


def _sampled_shares(
    grown: Grown, elements: np.ndarray, cell_size: float, domain: Domain, shares: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The filled fraction of elements, by a point in each of their eighths, or in some of these for many elements; at
    least a small fraction if a corner is inside. Also, for elements without such a corner, the point of each that is
    nearest to the body, or deepest inside it [n, 3].
    """
    rng = np.random.default_rng(0)
    found, nearest = np.zeros(len(elements)), np.zeros((len(elements), 3))
    some = int(np.clip(MOST_POINTS // max(len(elements), 1), 1, 8))
    for part in np.array_split(np.arange(len(elements)), len(elements) // 100_000 + 1):
        within = points_within(grown, elements[part], cell_size, some, rng)
        bare = shares[part] <= 0.0
        phi = np.asarray(domain.phi(within[bare].reshape(-1, 3))).reshape(-1, some)
        found[part[bare]] = (phi < 0.0).mean(axis=1)
        nearest[part[bare]] = within[bare][np.arange(len(phi)), np.argmin(phi, axis=1)]
        found[part[~bare]] = domain.holds(within[~bare].reshape(-1, 3)).reshape(-1, some).mean(axis=1)
    return np.where(shares > 0.0, np.maximum(found, LEAST), found), nearest
