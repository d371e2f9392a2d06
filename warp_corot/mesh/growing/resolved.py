"""A forest finer than the mesh: what tetrahedra of all levels hold of a body, and meshes that are part of it."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np
import warp as wp
from scipy.spatial import cKDTree

from warp_corot.kernels.meshing import coarsening as kernels
from warp_corot.mesh.lattice import volume_shares
from warp_corot.mesh.tree import LIVE, VOID, Tree

from .cut import connected, inside_shares
from .growth import lattice_spacing
from .judging import FARTHER, GAP_ELEMENTS, ROUGH
from .surface_points import surface_points

if TYPE_CHECKING:
    from warp_corot.domain import Domain

    from .adapt import Grown

#: Below the mesh, in place of a first child.
BELOW = -3


#: Pieces of less than this share of the body are none, and more of them are crumbs of what is not resolved.
LEAST_PIECE, MOST_PIECES = 1.0e-4, 16
#: About so many points in all.
MOST_POINTS = 250_000
#: A leaf with a corner inside the body counts as filled to at least this share.
LEAST = 1.0e-6


class Resolved:
    """What the tetrahedra of a grown forest hold, from its leaves up.

    Args:
        grown: The forest.
        cell_size: Edge of a root cube [m].
        domain: Where it is off too far for its leaves' corners to tell what they hold, the body is asked once more.

    Attributes:
        grown: The forest.
        held: Share of the body in each tetrahedron, over a root cube's volume, float64 [M].
        volume: Of each, likewise.
        leaves: Its leaves that hold something, indices.
        shares: What share of themselves they hold.
    """

    def __init__(self, grown: Grown, cell_size: float, domain: Domain | None = None):
        tree = grown.tree
        self.grown = grown
        self.cell_size = cell_size
        inner = np.flatnonzero(tree.first_child >= 0)
        inner = inner[np.argsort(tree.level[inner], kind="stable")]
        counts = np.bincount(tree.level[inner]) if len(inner) else np.zeros(1, int)
        self._by_level = np.split(inner, np.cumsum(counts)[:-1])
        leaves = np.flatnonzero(tree.first_child == LIVE)
        shares = inside_shares(grown.phi[tree.tets[leaves]])
        if domain is not None:
            rough = self._rough(leaves)
            shares[rough] = _sampled_shares(grown, leaves[rough], cell_size, domain, shares[rough])
        self.leaves, self.shares = leaves[shares > 0.0], shares[shares > 0.0]
        self.volume = volume_shares(tree.level)
        held = np.zeros(len(tree.level))
        held[self.leaves] = self.shares * self.volume[self.leaves]
        self.held = self.summed(held)

    @property
    def lengths(self) -> np.ndarray:
        """Edge of a cube whose eighth levels below is as large, for each tetrahedron [m]: halves in three levels."""
        return self.cell_size * 0.5 ** (self.grown.tree.level / 3.0)

    def _rough(self, leaves: np.ndarray) -> np.ndarray:
        """Which leaves are off too far for their corners to tell what they hold, bool [n]. Where this was not looked
        at, as nothing is bisected there, it is taken from their parents."""
        tree, need, lengths = self.grown.tree, self.grown.need, self.lengths
        parents = np.maximum(tree.parent[leaves], 0)
        unknown = (need[leaves] == 0.0) & (tree.level[leaves] >= self.grown.deepest)
        near = (np.abs(self.grown.phi[tree.tets[leaves]]) < lengths[leaves, None]).any(axis=1)
        looked_at = np.where(unknown & near, parents, leaves)
        return need[looked_at] > ROUGH * lengths[looked_at]

    def summed(self, values: np.ndarray) -> np.ndarray:
        """Values of leaves added up to all that lies above them."""
        return self._upwards(values, np.add)

    def largest(self, values: np.ndarray) -> np.ndarray:
        """For each tetrahedron the largest value in it and below."""
        return self._upwards(values, np.maximum)

    def smallest(self, values: np.ndarray) -> np.ndarray:
        """For each tetrahedron the smallest value in it and below."""
        return self._upwards(values, np.minimum)

    def owners(self, child: np.ndarray) -> np.ndarray:
        """Which leaf of a mesh in the forest each tetrahedron lies in, -1 above the mesh's leaves; int32 [M].

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
        """A mesh in the forest as a tree of its own, and which of the forest's tetrahedra are in it, ascending."""
        tree = self.grown.tree
        there = child != BELOW
        number = np.cumsum(there, dtype=np.int32) - 1
        stays = np.flatnonzero(there)
        parent, first = tree.parent[stays], child[stays]
        parent = np.where(parent < 0, np.int32(-1), number[parent])
        first = np.where(first < 0, first, number[np.maximum(first, 0)]).astype(np.int32)
        return Tree(tree.tets[stays], tree.level[stays], parent, first), stays

    def as_wished(self) -> np.ndarray:
        """The mesh that was wished for before the body was looked at more closely, as its first children [M]."""
        wished = self.grown.wished
        child = np.full(len(self.held), BELOW, np.int32)
        child[: len(wished)] = wished
        leaf = np.flatnonzero(child == LIVE)
        child[leaf[self.held[leaf] <= 0.0]] = VOID
        return child

    def thin(self, domain: Domain, layers: float) -> np.ndarray:
        """How thick the body is where each tetrahedron holds some of its surface, the least of it, float64 [M] [m]."""
        grown, found = self.grown, np.full(len(self.held), np.inf)
        cut = self.leaves[self.shares < 1.0]
        if len(cut):
            tets, spacing = grown.tree.tets[cut], lattice_spacing(self.cell_size)
            phi = wp.array(grown.phi, dtype=wp.float32, device=grown.growth.device)
            x, inward = surface_points(grown.growth.lattice, phi, tets, grown.origin, spacing)
            found[cut] = domain.thickness(x, inward, FARTHER * layers * self.cell_size)
        return self.smallest(found)

    def gaps(self) -> np.ndarray | None:
        """How far it is, where each tetrahedron holds some of the surface, to the nearest other piece of the body, the
        least of it, float64 [M] [m]; None where there is one piece, or too many to be true."""
        grown = self.grown
        tets = grown.tree.tets[self.leaves]
        if not len(tets):
            return None
        piece = connected(np.where(grown.phi[tets] < 0, tets, np.int32(-1)))
        sizes = np.bincount(piece, self.shares * self.volume[self.leaves])
        real = np.flatnonzero(sizes > LEAST_PIECE * sizes.sum())
        if not 1 < len(real) <= MOST_PIECES:
            return None
        at_surface = (grown.phi[tets] >= 0).any(axis=1)
        x = grown.lattice[tets].mean(axis=1) * lattice_spacing(self.cell_size)
        found, reach = np.full(len(self.held), np.inf), GAP_ELEMENTS * self.cell_size
        for number in real:
            own = np.flatnonzero(at_surface & (piece == number))
            other = np.flatnonzero(at_surface & (piece != number) & np.isin(piece, real))
            own, other = own[_near(x[own], x[other], reach)], other[_near(x[other], x[own], reach)]
            if len(own) and len(other):
                tree = cKDTree(x[other], compact_nodes=False, balanced_tree=False)
                found[self.leaves[own]], _ = tree.query(x[own], distance_upper_bound=reach)
        return self.smallest(found)

    def _upwards(self, values: np.ndarray, ufunc: np.ufunc) -> np.ndarray:
        values, first = values.copy(), self.grown.tree.first_child
        for elements in self.deepest_first():
            below = ufunc(values[first[elements]], values[first[elements] + 1])
            values[elements] = ufunc(values[elements], below)
        return values

    def deepest_first(self) -> Iterator[np.ndarray]:
        return reversed(self._by_level)


class Coarsening:
    """Meshes out of a forest, by how much its tetrahedra need to be bisected.

    A mesh is what stands in place of first children: those of what is bisected, LIVE or VOID at its leaves, BELOW under
    them.

    Args:
        resolved: The forest.
        needs: How much each of its tetrahedra needs to be bisected [m], float32 [M].
        sliver: Leaves that hold less than this share of themselves are not counted.
    """

    def __init__(self, resolved: Resolved, needs: np.ndarray, sliver: float):
        growth, tree = resolved.grown.growth, resolved.grown.tree
        self.device, count = growth.device, len(tree.level)
        holds = resolved.held > 0.0
        self._holds = wp.array(holds.astype(np.uint8), dtype=wp.uint8, device=self.device)
        self._parent, self._first_child = growth.parent[:count], growth.first_child[:count]
        self._needs = wp.array(needs, dtype=wp.float32, device=self.device)
        of_node = wp.zeros(growth.node_count, dtype=wp.float32, device=self.device)
        for elements in resolved.deepest_first():
            chosen = wp.array(elements, dtype=wp.int32, device=self.device)
            inputs = [chosen, growth.tets, growth.level, self._first_child]
            growth.launch(kernels.gather_needs, len(elements), [*inputs, self._holds], [self._needs, of_node])
            growth.launch(kernels.take_needs, len(elements), [*inputs, of_node], [self._needs])
        # What has no children cannot be bisected, whatever it needs.
        own = np.where(tree.first_child >= 0, self._needs.numpy(), np.float32(0.0))
        counted = holds & (resolved.held >= sliver * resolved.volume)
        roots = np.count_nonzero(counted & (tree.parent < 0))
        above = tree.parent[counted & (tree.parent >= 0)]
        # A tetrahedron is a leaf of the meshes of thresholds from what it needs up to what its parent needs.
        begin, end = np.sort(own[counted]), np.sort(own[above[holds[above]]])
        last = np.append(end[1:] != end[:-1], True) if len(end) else np.empty(0, bool)
        self._thresholds = end[last]
        self._counts = roots + len(end) - 1 - np.flatnonzero(last)
        self._counts -= len(begin) - np.searchsorted(begin, self._thresholds, side="right")
        self._counted = counted

    def threshold(self, target: int, least: float) -> float:
        """The threshold, ``least`` or more, that gives the most elements up to a number."""
        first = int(np.searchsorted(self._thresholds, np.float32(least), side="right"))
        if self.mesh(least)[0] <= target or first == len(self._thresholds):
            return float(least)
        counts = np.where(self._counts[first:] <= target, self._counts[first:], -1)
        return float(self._thresholds[first + int(np.argmax(counts))])

    def mesh(self, least: float) -> tuple[int, np.ndarray]:
        """Bisect all that needs it by more than ``least``: how many leaves are counted, and the mesh, int32 [M]."""
        child = wp.empty(len(self._needs), dtype=wp.int32, device=self.device)
        inputs = [self._parent, self._first_child, self._needs, float(least), self._holds]
        wp.launch(kernels.cut_off, len(child), inputs, [child], device=self.device)
        found = child.numpy()
        return int(np.count_nonzero(self._counted & (found == LIVE))), found


def _near(points: np.ndarray, others: np.ndarray, reach: float) -> np.ndarray:
    """Which points are within a reach of the box around others, bool [n]."""
    if not len(others):
        return np.zeros(len(points), bool)
    return ((points >= others.min(axis=0) - reach) & (points <= others.max(axis=0) + reach)).all(axis=1)


#: Corners of the eight tetrahedra of one size that a tetrahedron is made of, as barycentric coordinates [8, 4, 4].
_ENDS = {n: np.eye(4)[n] for n in range(4)}
_MIDDLES = {(i, j): 0.5 * (np.eye(4)[i] + np.eye(4)[j]) for i in range(4) for j in range(4) if i != j}
_EIGHTHS = np.array(
    [[_ENDS[n], *(_MIDDLES[n, m] for m in range(4) if m != n)] for n in range(4)]
    + [
        [_MIDDLES[0, 2], _MIDDLES[1, 3], _MIDDLES[a], _MIDDLES[b]]
        for a, b in (((0, 1), (1, 2)), ((1, 2), (2, 3)), ((2, 3), (0, 3)), ((0, 3), (0, 1)))
    ]
)


def points_within(
    grown: Grown, elements: np.ndarray, cell_size: float, each: int, rng: np.random.Generator
) -> np.ndarray:
    """Random points in tetrahedra, spread evenly over their eighths [n, each, 3] [m]."""
    eighths = rng.integers(0, 8, len(elements))[:, None] + np.arange(each) * max(8 // each, 1)
    weights = rng.standard_exponential((len(elements), each, 4), dtype=np.float32)
    weights /= weights.sum(axis=2, keepdims=True)
    corners = grown.lattice[grown.tree.tets[elements]] * lattice_spacing(cell_size)
    return np.einsum("nek,nekc->nec", weights, _EIGHTHS[eighths % 8]) @ corners + np.asarray(grown.origin)


def _sampled_shares(
    grown: Grown, elements: np.ndarray, cell_size: float, domain: Domain, shares: np.ndarray
) -> np.ndarray:
    """What share of elements is inside, by a point in each of their eighths, or in some of these where there are many
    elements; a little at least where a corner is."""
    rng = np.random.default_rng(0)
    found = np.zeros(len(elements))
    some = int(np.clip(MOST_POINTS // max(len(elements), 1), 1, 8))
    for part in np.array_split(np.arange(len(elements)), len(elements) // 100_000 + 1):
        within = points_within(grown, elements[part], cell_size, some, rng)
        inside = np.asarray(domain.phi(within.reshape(-1, 3))) < 0.0
        found[part] = inside.reshape(-1, some).mean(axis=1)
    return np.where(shares > 0.0, np.maximum(found, LEAST), found)
